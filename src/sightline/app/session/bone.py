"""The bone's CT or mesh, which a person may drop: its registration with the images of the plan, and the pose that they
accept. Its checks join the verdict."""

import asyncio
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sightline.app.plan.found_bone import FoundBone
from sightline.app.plan.marks import MarkSpec
from sightline.app.session.jobs import sentence_of
from sightline.app.session.planning import Planning
from sightline.calibration import BeadView
from sightline.calibration.exchange.markups import read_points
from sightline.case import stages
from sightline.case.journal import Actor
from sightline.case.views import NAMES
from sightline.common.atomic import scratch_folder, write_whole
from sightline.errors import SightlineError, UnusableInputError
from sightline.imaging import Radiograph
from sightline.imaging.volumes.meshes import FILE_TYPES

if TYPE_CHECKING:
    from sightline.from_images.registration import ScannedBone
    from sightline.from_images.registration.clicks import Clicks

FOLDER = "bone"  # beside the journal
CT_TYPES, POINT_TYPES = (".nii.gz", ".nii", ".nrrd"), (".mrk.json", ".json", ".csv")
MESH_TYPES = tuple(f".{kind}" for kind in FILE_TYPES)
MIN_POINTS, MAX_POINTS = 2, 12  # of landmarks [calc] for an axis; [ours] nobody clicks more in two images
MAX_NAME = 40  # [ours] characters of a landmark, which a row of the page shows
T = TypeVar("T")


class BoneStep:
    """The optional registration of the bone. `volume`: the file of its CT or mesh, `points`: its landmarks (3,) in
    coordinates of the file, mm, by name; both in the case's folder. `found`: its pose, until a person accepts or
    discards it; `refused`: why there is none."""

    def __init__(self, planning: Planning) -> None:
        self._planning, self._folder = planning, planning.case.folder / FOLDER
        self._found: FoundBone | None = None
        self.refused = ""
        kept = sorted(self._folder.glob("*"))
        self.volume = next((file for file in kept if file.name.endswith((*CT_TYPES, *MESH_TYPES))), None)
        self.points: Mapping[str, np.ndarray] = {}
        for file in kept:
            if file.name.endswith(POINT_TYPES):
                try:
                    self.points = _landmarks(file)
                except SightlineError as error:
                    self.refused = sentence_of(error)

    @property
    def asked(self) -> tuple[MarkSpec, ...]:
        """The marks of the landmarks, in the order of their file; none without a CT or mesh, and once it is found."""
        return () if self.volume is None or self.shown is not None else self.specs

    @property
    def specs(self) -> tuple[MarkSpec, ...]:
        """The marks of all landmarks."""
        sentence = "click it where the CT or mesh has it, to about 10 mm."
        return tuple(MarkSpec(_mark(name), name, sentence, "bone", _mark(name)) for name in self.points)

    @property
    def clicked(self) -> "Clicks":
        """The pixels (2,) of the landmarks that are clicked in both images, by name and view."""
        marks = {name: self._planning.decisions.mark(_mark(name)) for name in self.points}
        return {
            name: {view: np.array(mark.at(view)) for view in NAMES} for name, mark in marks.items() if mark.complete()
        }

    @property
    def ready(self) -> bool:
        """True if it can be registered: both views are calibrated, and the landmarks, if any, are clicked."""
        started = not self.points or len(self.clicked) >= MIN_POINTS
        return self.volume is not None and started and self._planning.views() is not None

    @property
    def found(self) -> FoundBone | None:
        """The pose that waits for a person; None without one, and once an image was replaced."""
        return self._found if self._found is not None and self._planning.shows(self._found) else None

    @property
    def accepted(self) -> FoundBone | None:
        """The accepted pose; None without one, and for other images than it was found in."""
        return self._planning.accepted_bone

    @property
    def shown(self) -> FoundBone | None:
        """The pose that waits for a person, else the accepted one."""
        return self.found or self.accepted

    async def take(self, data: bytes, suffix: str) -> None:
        """Take a CT or mesh, or the landmarks in it; the one before stays where this one is refused.

        Raises UnusableInputError."""
        if suffix in POINT_TYPES:
            self.points = await asyncio.to_thread(_keep, self._folder, f"points{suffix}", data, _landmarks)
        else:
            jobs, name = self._planning.jobs, f"volume{suffix}"
            keep = partial(_keep, self._folder, name, data, _holds_bone)
            await jobs.during("reading CT or mesh", lambda: self._planning.worker.do(keep))
            self.volume = self._folder / name
        self._found, self.refused = None, ""
        self._planning.jobs.notify()

    async def register(self) -> None:
        """Find the pose of the bone in the images of the plan. Raises SightlineError, which is kept as `refused`."""
        planning, volume, views = self._planning, self.volume, self._planning.views()
        if volume is None or views is None or not self.ready:
            raise UnusableInputError(
                f"calibrate both views, drop a CT or mesh, and click {MIN_POINTS} of its landmarks or more in both"
            )
        names = planning.names
        shown = [seen for seen in map(planning.seen, names) if seen is not None]
        images, apart = [seen.image for seen in shown], tuple(seen.view for seen in shown if seen.view is not None)
        numbers = {name: planning.decisions.images[name] for name in names}
        clicked = {"points_mm": self.points, "clicks": self.clicked}
        work = partial(registered, volume, images, apart, numbers=numbers, **clicked)
        self._found, self.refused = None, ""
        try:
            self._found = await planning.jobs.during("registering the bone", lambda: planning.worker.do(work))
            if self.found is None:
                raise UnusableInputError("register the bone again: an image has changed meanwhile")
        except SightlineError as error:
            self.refused = sentence_of(error)
            raise
        finally:
            planning.jobs.notify()

    def accept(self) -> None:
        """Keep the pose in the case; from now on its checks are of the verdict. Raises CaseError."""
        if self.found is not None:
            entry = stages.record_changed(self._planning.case, "bone", self.found.document(), by=Actor.SURGEON)
            self._planning.decide(bone=entry.number)
            self._found = None

    def discard(self) -> None:
        """Drop the pose that is shown; one that was accepted can be had again by undo. Raises CaseError."""
        if self.found is None:
            self._planning.decide(bone=None)
        self._found = None
        self._planning.jobs.notify()


def _mark(name: str) -> str:
    return f"bone-{name}"


def _keep(folder: Path, name: str, data: bytes, read: Callable[[Path], T]) -> T:
    """Keep a file in a folder once `read` can read it, instead of the one before, and return what it holds.

    Raises UnusableInputError, which does not name the file: a person knows it by another name.
    """
    with scratch_folder() as scratch:
        file = write_whole(scratch / name, data)
        try:
            held = read(file)
        except UnusableInputError as error:
            raise UnusableInputError(str(error).removeprefix(f"{name}: ").replace(name, "the file")) from error
    folder.mkdir(exist_ok=True)
    kept = write_whole(folder / name, data)
    for other in folder.glob(f"{name.partition('.')[0]}.*"):
        if other != kept:
            other.unlink()
    return held


def _landmarks(file: Path) -> Mapping[str, np.ndarray]:
    """Return the landmarks of a file, as of `read_points`. Raises UnusableInputError."""
    points = read_points(file)
    if not MIN_POINTS <= len(points) <= MAX_POINTS:
        raise UnusableInputError(f"it holds {len(points)} points; give {MIN_POINTS} to {MAX_POINTS} landmarks")
    if any(len(name) > MAX_NAME or not name.isprintable() for name in points):
        raise UnusableInputError(f"give each landmark a name of at most {MAX_NAME} printable characters")
    return points


def _holds_bone(file: Path) -> None:
    """Raise UnusableInputError where a CT or mesh cannot be read or holds no bone."""
    _read_bone(file)


def _read_bone(file: Path) -> "ScannedBone":
    from sightline.from_images.registration import ScannedBone, read_volume

    return ScannedBone.of_ct(read_volume(file))


def registered(
    file: Path,
    images: list[Radiograph],
    views: tuple[BeadView, ...],
    *,
    points_mm: Mapping[str, np.ndarray],
    clicks: "Clicks",
    numbers: Mapping[str, int],
) -> FoundBone:
    """Return the bone of a file registered with images and their views; `numbers`: of the images' entries, by name.

    Runs in the worker. Raises what `register_bone` and `start_of_clicks` raise.
    """
    from sightline.from_images.registration import register_bone
    from sightline.from_images.registration.clicks import start_of_clicks
    from sightline.from_images.registration.pictures import edge_lines

    start = start_of_clicks(points_mm, clicks, views) if points_mm else None
    found = register_bone(_read_bone(file), images, views, start)
    of_views = {check.of_view(view.name) for view in views for check in view.checks}
    edges = {
        name: [line.tolist() for line in edge_lines(shot, found.bone, found.pose)]
        for name, shot in zip(numbers, found.shots, strict=True)
    }
    own = [vars(check) for check in found.checks if check not in of_views]
    return FoundBone(dict(numbers), found.document(), found.error_sentence(), tuple(own), edges)
