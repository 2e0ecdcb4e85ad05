"""A worked procedure without the demo's robot: two images, a plan on them, two check images of a wire as planned."""

import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import RigidTransform

import sightline as sl
from sightline.cli.demo import SEED
from sightline.imaging import Radiograph, write_dicom
from sightline.rehearsal.patient import CheckImages
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.link.record import SimulatedWire

VIEWS = ("pa", "lateral")


def make_once(folder: Path, name: str, make: Callable[[], object]) -> None:
    """Make something in a folder: once, for all processes of a test run."""
    with closing(sqlite3.connect(folder / f"{name}.lock", timeout=900)) as lock:
        lock.execute("BEGIN EXCLUSIVE")  # a lock between processes that every system has
        if not (folder / f"{name}.made").exists():
            make()
            (folder / f"{name}.made").touch()


def unrendered(take: Callable[..., CheckImages], *given: Any, **options: Any) -> CheckImages:
    """Return set-up and landmarks of check or drilling images without rendering them."""
    with patch("sightline.rehearsal.patient.render_views", return_value={}):
        return take(*given, **options)


@dataclass(frozen=True, eq=False)
class Worked:
    """`folder`: of all processes of a test run; it gets images once they are needed."""

    folder: Path

    @cached_property
    def demo(self) -> Path:
        """The folder out/demo with the images of `sightline demo`."""
        make_once(self.folder, "demo", lambda: self._write("out/demo/demo", self.rehearsal.images))
        return self.folder / "out" / "demo"

    @cached_property
    def check(self) -> list[Path]:
        """Both check images, beside out/demo."""
        take = self.rehearsal.check_images
        make_once(self.folder, "check", lambda: self._write("check", take(self.drilled).images))
        return [self.folder / f"check_{name}.dcm" for name in VIEWS]

    def _write(self, start: str, images: Mapping[str, Radiograph]) -> None:
        (self.folder / start).parent.mkdir(parents=True, exist_ok=True)
        for name in VIEWS:
            write_dicom(images[name], self.folder / f"{start}_{name}.dcm", self.rehearsal.side)

    @cached_property
    def rehearsal(self) -> Rehearsal:
        return Rehearsal.draw(SEED, sl.Frame.load("gamma"))

    @property
    def drilled(self) -> SimulatedWire:
        """A wire where the plan is."""
        wire = self.rehearsal.hip.wire_mm
        axis_mm = np.stack([wire[0], wire.mean(axis=0), wire[1]])
        return SimulatedWire(axis_mm, RigidTransform.identity(), np.zeros(5))

    @cached_property
    def image(self) -> sl.Radiograph:
        return sl.read_image(self.demo / "demo_pa.dcm")

    @cached_property
    def beads(self) -> sl.Detections:
        return sl.detect(self.image)

    @cached_property
    def observations(self) -> sl.Observations:
        return sl.label(self.beads, "gamma")

    @cached_property
    def views(self) -> list[sl.CalibratedView]:
        return [sl.calibrate_image(self.demo / f"demo_{name}.dcm", "gamma", name) for name in VIEWS]

    @cached_property
    def wire_px(self) -> np.ndarray:
        """(2, 2, 2): view, entry and end, (u, v)."""
        return self.rehearsal.pixels(self.rehearsal.hip.wire_mm)

    @cached_property
    def landmarks_px(self) -> np.ndarray:
        return np.stack(list(self.rehearsal.landmarks.values()), axis=1)

    @cached_property
    def points(self) -> sl.SpacePoints:
        return sl.reconstruct(self.views, self.wire_px, np.broadcast_to(0.25 * np.eye(2), (2, 2, 2, 2)))

    @cached_property
    def plan(self) -> sl.Plan:
        types = {aid.key: aid.type for aid in self.rehearsal.document.aids}
        return sl.plan(
            self.views,
            self.wire_px[:, 0],
            self.wire_px[:, 1],
            landmarks_uv_px=self.landmarks_px,
            landmark_names=["-".join(name.split()) for name in self.rehearsal.landmarks],
            side=self.rehearsal.side,
            aids=sl.Aids.clicked(types, self.rehearsal.aids_px),
        )

    @cached_property
    def shot(self) -> sl.CheckShot:
        check = unrendered(self.rehearsal.check_images, self.drilled)
        found = check.landmarks_px(list(self.rehearsal.landmarks), 0.0, np.random.default_rng(0))
        marks = sl.Landmarks(self.landmarks_px, found)
        return sl.check_shot(self.plan, self.views, self.check, "gamma", landmarks=marks)
