"""Random scenes for studies and benchmarks: a set-up, the measurements of its beads, and targets.

Poses, distortions and frame errors are those of `sightline.twin.draw_setup` with its defaults. Targets are uniform in a
cube around the hip. They are drawn again unless all images show them and, in a cube of TARGET_REACH_MM or less, unless
they lie inside the convex hull of the visible beads of each plate (the paper's map is undefined outside).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import Delaunay

import sightline as sl
from sightline.calibration import BeadView
from sightline.calibration.lengths import CArm
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.calibration.view import CalibratedView
from sightline.detection import Observations
from sightline.errors import SetUpError
from sightline.frame import Frame, Tolerances
from sightline.imaging import Radiograph
from sightline.studies.bound import BoundData
from sightline.twin import HipScene, SetUp, bead_images, draw_setup, render
from sightline.twin.anatomy.femur import Femur, to_cfcs
from sightline.twin.scenes.specimens import PIG, plastic_hip, porcine_hip
from sightline.twin.xray.setup import shadow_radius_px

VIEWS = ("pa", "lateral")
# Entry and end of a 97 mm wire through a right hip, CFCS (physics.md, Frame: 95 mm at 45°) [ours].
WIRE_ENDS_MM = np.array([[34.0, 34.0, -8.0], [-34.0, -34.0, 8.0]])
TARGET_REACH_MM = 34.0  # half of a 95 mm wire at 45° (physics.md, Frame)
FAR_MM = 55.0  # beyond the convex hull of the beads, which reaches 44 mm at the hip
EXACT = Tolerances(0.0, 0.0, 0.0, 0.0, 0.0)
BEADS_20UM = Tolerances(0.02, 0.0, 0.0, 0.0, 0.0)
WHOLE = Tolerances()  # bead, plate and arm (physics.md, Frame)
FRAMES = {"frame exact": EXACT, "frame beads 0.02 mm": BEADS_20UM, "frame whole": WHOLE}
BEAD_PX = 0.1  # error of a bead's centre (physics.md, Centroid limit: 124 quanta per pixel)
CENTRED_PX, CAREFUL_PX, ORDINARY_PX = 0.1, 0.5, 1.0  # picks (physics.md, Picks)
PAPER_MM, PAPER_DEG = 1.0, 0.6  # the paper's six trials were within these [paper, Fig. 15]
ATTEMPTS = 100
MARGIN_PX = 15.0  # minimum distance of a visible target from the edge of the field


@dataclass(frozen=True, eq=False)
class TargetScene:
    """A set-up, the measurements of its beads, and T targets: `target_mm` (T, 3), true pixels `target_px`
    (V, T, 2) in each view."""

    setup: SetUp
    observations: dict[str, Observations]
    target_mm: np.ndarray
    target_px: np.ndarray

    @staticmethod
    def of(setup: SetUp, observations: dict[str, Observations], target_mm: np.ndarray) -> "TargetScene":
        """Return a scene with targets at given points (T, 3)."""
        return TargetScene(
            setup, observations, target_mm, np.array([view.project(target_mm) for view in setup.views.values()])
        )

    @property
    def frame(self) -> Frame:
        """The nominal frame, known to the software."""
        return self.setup.frame

    def seen(self, pick_px2: np.ndarray, across_px: np.ndarray | None = None) -> dict[str, BoundData]:
        """Return the data of the bound, for picks of one target with covariances (V, 2, 2)."""
        across = np.zeros((len(self.setup.views), 2)) if across_px is None else across_px
        data = {}
        for k, name in enumerate(self.setup.views):
            seen = self.observations[name]
            assert seen.covariance_px2 is not None  # noqa: S101 - `measure` states it
            data[name] = BoundData(seen.ids, seen.covariance_px2, pick_px2[k], across[k])
        return data


def draw_scene(
    rng: np.random.Generator,
    frame: Frame,
    bead_px: float,
    *,
    targets: int,
    reach_mm: float = TARGET_REACH_MM,
    uneven: float = 0.0,
    chain: str | None = None,
    views: Mapping[str, np.ndarray] | None = None,
) -> TargetScene:
    """Draw a scene. `uneven`: the standard deviation of each bead is `bead_px` times exp(uneven * N(0, 1)).

    `chain`, `views`: as in `draw_setup`. A solid surrounds no target.
    """
    setup = draw_setup(rng, frame, chain=chain, views=views)
    observations = measure(rng, setup, bead_px, uneven)
    hulls = {n: _plate_hulls(setup, n, observations[n]) if reach_mm <= TARGET_REACH_MM else [] for n in frame.views}
    return TargetScene.of(
        setup, observations, np.array([draw_target(rng, setup, reach_mm, hulls) for _ in range(targets)])
    )


def draw_showing(
    rng: np.random.Generator, frame: Frame, wire_mm: np.ndarray, *, frame_errors: bool = True, **drawn: Any
) -> SetUp:
    """Draw a set-up that shows a whole wire (2, 3), from the hip, in both views. `drawn`: arguments of `draw_setup`.

    Raises SetUpError if none is found.
    """
    for _ in range(ATTEMPTS):
        setup = draw_setup(rng, frame, frame_errors=frame_errors, **drawn)
        wire = setup.hip_mm + wire_mm
        if all(view.in_field(view.project(wire), MARGIN_PX).all() for view in setup.views.values()):
            return setup
    raise SetUpError(f"none of {ATTEMPTS} set-ups shows the whole wire in both views")


def measure(
    rng: np.random.Generator, setup: SetUp, bead_px: float, uneven: float = 0.0, *, noisy: bool = True
) -> dict[str, Observations]:
    """Draw measurements of the beads of all views, each with the covariance of its noise; of a plate on the detector
    the radii as well, since `bead_images` has the centroids of its shadows. `noisy`: False states the noise alone."""
    observations = {}
    for name in setup.views:
        ids, exact = bead_images(setup, name, rng, sd_px=0.0)
        sd = bead_px * np.exp(uneven * rng.standard_normal(len(ids)))
        measured = exact + sd[:, None] * rng.standard_normal(exact.shape) if noisy else exact
        shape = None if setup.frame.solid is None else setup.views[name].chain.shape  # its calibration needs it
        radius = None if setup.frame.detector is None else _radii_px(setup, name, ids)
        covariance = sd[:, None, None] ** 2 * np.eye(2)
        observations[name] = Observations(name, ids, measured, covariance, image_shape=shape, radius_px=radius)
    return observations


def _radii_px(setup: SetUp, name: str, ids: tuple[str, ...]) -> np.ndarray:
    """Return the radii (N,) of the shadows of a view's balls."""
    known = {fiducial.id: fiducial for fiducial in setup.frame_in(name).fiducials_of(name)}
    xyz, diameter = (np.array([getattr(known[i], what) for i in ids]) for what in ("xyz_mm", "diameter_mm"))
    return shadow_radius_px(setup.views[name], xyz, diameter / 2)


def calibrated_views(
    setup: SetUp, seen: Mapping[str, Observations], frame: Frame | None = None
) -> list[CalibratedView]:
    """Calibrate all views of a set-up, those of a solid together. `frame`: the frame as it is known, by default the
    nominal one. Raises what `calibrate` raises."""
    frame = frame or setup.frame
    if frame.solid is None:
        return [sl.calibrate(observed, frame) for observed in seen.values()]
    arms = [CArm(view.chain.sdd_mm, view.chain.pitch_mm) for view in setup.views.values()]
    return list(calibrate_together(list(seen.values()), frame, arms))


def _plate_hulls(setup: SetUp, name: str, seen: Observations) -> list[Delaunay]:
    view = setup.frame.view(name)
    return [Delaunay(seen.uv_px[np.isin(seen.ids, plate.ids)]) for plate in (view.xrii, view.source)]


def draw_target(
    rng: np.random.Generator, setup: SetUp, reach_mm: float, hulls: Mapping[str, Sequence[Delaunay]]
) -> np.ndarray:
    """Draw a target (3,), CFCS, in a cube around the hip, until all views show it, inside the `hulls` of each view."""
    while True:
        xyz = setup.hip_mm + rng.uniform(-reach_mm, reach_mm, 3)
        uv = {name: view.project(xyz[None]) for name, view in setup.views.items()}
        shown = all(view.in_field(uv[name], MARGIN_PX)[0] for name, view in setup.views.items())
        if shown and all(hull.find_simplex(uv[name])[0] >= 0 for name in hulls for hull in hulls[name]):
            return xyz


SIDE = "right"


@dataclass(frozen=True)
class Phantom:
    """A bone with its ideal wire centred on the origin, and the function that puts it into a set-up."""

    femur: Femur
    build: Callable[[SetUp, np.random.Generator], HipScene]

    @property
    def wire_mm(self) -> np.ndarray:
        """Entry and end (2, 3) of the ideal wire, CFCS."""
        wire = to_cfcs(np.stack(self.femur.wire_mm()), SIDE, np.zeros(3))
        return wire - wire.mean(axis=0)

    def draw(self, rng: np.random.Generator, frame: Frame) -> tuple[SetUp, HipScene]:
        """Draw a set-up that shows the whole wire in both views, and its hip. Raises SetUpError."""
        setup = draw_showing(rng, frame, self.wire_mm)
        return setup, self.build(setup, rng)


PHANTOMS = {
    "plastic, bored": Phantom(Femur(), lambda setup, _: plastic_hip(setup)),
    "porcine": Phantom(PIG, porcine_hip),
}


def image_of(rng: np.random.Generator, setup: SetUp, hip: HipScene, view: str) -> Radiograph:
    """Render one view at the medium dose."""
    return render(setup, view, hip.at(view).scene, rng)


def observed(image: Radiograph, frame: Frame, view: str) -> Observations:
    """Find and label the beads of an image. Raises SightlineError."""
    return sl.label(sl.detect(image), frame, view)


def calibrated_images(rng: np.random.Generator, setup: SetUp, hip: HipScene) -> list[BeadView]:
    """Render and calibrate both views, each from its own image. Raises SightlineError."""
    return [
        sl.calibrate(observed(image_of(rng, setup, hip, name), setup.frame, name), setup.frame, view=name)
        for name in VIEWS
    ]
