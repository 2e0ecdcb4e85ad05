"""A case with a block, its images loaded under names that a person gives; for tests with and without a page."""

import asyncio
from pathlib import Path

import numpy as np
from tests.three import POINTS_MM, draw_three, three_images

from sightline.app.plan.marks import END, ENTRY, marks_of
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.case.views import NAMES
from sightline.imaging import write_dicom
from sightline.twin import SetUp
from sightline.twin.xray.setup import BEAMS

LANDMARKS = [spec.name for spec in marks_of("hip-screw") if spec.group == "landmark"]
PICK_PX = 0.5


def drawn() -> SetUp:
    """A set-up with three views."""
    return draw_three(np.random.default_rng(31), "flat-panel-0.3")[0]


def in_plane(three: SetUp) -> np.ndarray:
    """A shift of 2 mm (3,) in the plane of the first two beams, which no pair of images shows."""
    first, second = (three.views[name].detector.normal for name in NAMES)
    across = np.cross(first, second)
    shift = second - first
    shift = shift - across * (shift @ across) / (across @ across)
    return 2.0 * shift / np.linalg.norm(shift)


def load(three: SetUp, folder: Path, worker: WorkerProcess, marks: dict[str, dict[str, tuple[float, float]]]) -> None:
    """Write three images, and make a case in `folder / "case"` with PA and lateral image and these marks in them."""
    images = three_images(three, np.random.default_rng(32))
    files = {name: write_dicom(image, folder / f"{name}.dcm") for name, image in images.items()}

    async def work() -> None:
        session = Session.open(folder / "case", "block60", None, worker)
        for name in NAMES:
            assert await session.planning.take(files[name].read_bytes(), ".dcm", image=name) == name
        place(session, marks, NAMES)
        session.planning.case.close()

    asyncio.run(work())


def clicks(three: SetUp, shift_mm: np.ndarray | float = 0.0) -> dict[str, dict[str, tuple[float, float]]]:
    """Clicks with half a pixel of noise by image: the wire in PA and lateral, landmarks in all; the bone shifts after
    the first image."""
    rng, out = np.random.default_rng(33), {}
    for k, image in enumerate(BEAMS):
        uv = three.views[image].project(three.hip_mm + POINTS_MM + (k > 0) * shift_mm)
        uv = uv + rng.normal(0.0, PICK_PX, uv.shape)
        named = zip((ENTRY, END, *LANDMARKS), uv.tolist(), strict=True)
        out[image] = {name: (u, v) for name, (u, v) in named if image in NAMES or name in LANDMARKS}
    return out


def place(session: Session, marks: dict[str, dict[str, tuple[float, float]]], images: tuple[str, ...]) -> None:
    """Place the clicks of these images."""
    decisions = session.planning.decisions
    for image in images:
        for name, uv in marks.get(image, {}).items():
            decisions = decisions.with_mark(name, decisions.mark(name).placed(image, uv, free=True))
    session.planning.edit(decisions)
