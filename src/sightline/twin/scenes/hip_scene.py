"""Scenes for planning: a hip in or beside the frame, and its truth as JSON."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.atomic import write_whole
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.twin.anatomy.femur import BOX_HIGH_MM, LONG_HIGH_MM, Femur, draw_femur, to_cfcs, voxelise
from sightline.twin.objects.things import Scene, SoftTissue, frame_scene, moved
from sightline.twin.xray.distributions import HipPlace
from sightline.twin.xray.setup import SetUp, ViewTruth, draw_setup

TEST_BALLS_MM = np.array([[-18.0, -16.0, -12.0], [20.0, -12.0, 14.0], [-14.0, 20.0, 16.0], [16.0, 18.0, -15.0]])
TEST_BALL_RADIUS_MM = 1.5  # that of a frame's balls [physics.md, Frame]
ATTEMPTS = 100
Points = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class HipScene:
    """A hip in or beside the frame. `still`: frame and body; `bone`: the bone and everything fixed in it, which moves
    rigidly.

    `head_mm` (3,): centre of the femoral head; `wire_mm` (2, 3): entry and end point of the ideal wire
    (`Femur.wire_mm`); `lesser_mm` (3,): tip of the lesser trochanter, `greater_mm` (3,) of the greater. CFCS.
    `motions`: motion of the bone at named moments: when a view is taken (the view's name) or later (any other name,
    such as "drilling"). At other moments it has not moved.
    """

    still: Scene
    bone: Scene
    femur: Femur
    head_mm: np.ndarray
    wire_mm: np.ndarray
    lesser_mm: np.ndarray
    greater_mm: np.ndarray
    motions: Mapping[str, RigidTransform] = field(default_factory=dict)

    @property
    def scene(self) -> Scene:
        """Everything in the beam, with the frame's beads first."""
        return self.still + self.bone

    @property
    def wires_mm(self) -> np.ndarray:
        """Entry and end (1, 2, 3) of the ideal wire, as of other bones."""
        return self.wire_mm[None]

    @staticmethod
    def of(still: Scene, bone: Scene, femur: Femur, side: str, head_mm: np.ndarray) -> "HipScene":
        """Return a hip at rest, with the points of the femur for a head centred at `head_mm` (3,)."""
        points = (np.stack(femur.wire_mm()), femur.lesser_trochanter_mm, femur.greater_trochanter_mm)
        wire, lesser, greater = (to_cfcs(point, side, head_mm) for point in points)
        return HipScene(still, bone, femur, head_mm, wire, lesser, greater)

    @property
    def landmarks_mm(self) -> dict[str, np.ndarray]:
        """Points (3,), CFCS, of the bone that a person can find in both views, by name."""
        return {
            "head centre": self.head_mm,
            "lesser trochanter": self.lesser_mm,
            "greater trochanter": self.greater_mm,
        }

    def at(self, moment: str) -> "HipScene":
        """Return the hip at a moment, with bone, head and wire moved."""
        if moment not in self.motions:
            return replace(self, motions={})
        motion = self.motions[moment]
        return replace(
            self,
            bone=moved(self.bone, motion),
            head_mm=motion.apply(self.head_mm),
            wire_mm=motion.apply(self.wire_mm),
            lesser_mm=motion.apply(self.lesser_mm),
            greater_mm=motion.apply(self.greater_mm),
            motions={},
        )


def hip_scene(setup: SetUp, rng: np.random.Generator) -> HipScene:
    """Draw a hip at its place in or beside the set-up's true frame, centred on its wire as a radiographer would."""
    femur = draw_femur(rng)
    return placed_hip(setup, femur, setup.hip_mm + draw_head(setup.side, femur, rng), rng)


def shown_hip_scene(
    rng: np.random.Generator, frame: Frame, side: str = "right", femur: Femur | None = None, **shown: Any
) -> tuple[SetUp, HipScene]:
    """Draw a set-up and a hip whose whole ideal wire is visible in all views. `shown`: arguments of `shown_setup`.

    Raises SetUpError if none is found.
    """
    femur = femur or draw_femur(rng)
    setup, head = shown_setup(rng, frame, side, femur, **shown)
    return setup, placed_hip(setup, femur, head, rng)


def shown_setup(
    rng: np.random.Generator,
    frame: Frame,
    side: str,
    femur: Femur,
    *,
    also_mm: np.ndarray | None = None,
    wires_mm: np.ndarray | None = None,
    **drawn: Any,
) -> tuple[SetUp, np.ndarray]:
    """Draw a set-up, and the centre (3,), CFCS, of a femur's head, so that all views show its whole ideal wire.

    `wires_mm` (n, 2, 3): wires to show in its place, anatomical. They also show the points `also_mm` (N, 3), CFCS.
    `drawn`: arguments of `draw_setup`. Raises SetUpError if none is found.
    """
    wires = np.stack(femur.wire_mm()) if wires_mm is None else wires_mm

    def drawn_once() -> tuple[SetUp, np.ndarray]:
        setup = draw_setup(rng, frame, side=side, **drawn)
        return setup, setup.hip_mm + draw_head(side, femur, rng)

    return first_shown(drawn_once, wires, also_mm)


def first_shown(
    draw: Callable[[], tuple[SetUp, np.ndarray]], wires_mm: np.ndarray, also_mm: np.ndarray | None = None
) -> tuple[SetUp, np.ndarray]:
    """Return the first drawn set-up, with the origin (3,) of its bone, of which all views show the bone's wires.

    `draw`: draws a set-up and an origin. `wires_mm` (..., 3): anatomical coordinates. They also show the points
    `also_mm` (N, 3), CFCS. Raises SetUpError if none is found.
    """
    also = np.zeros((0, 3)) if also_mm is None else also_mm
    name = ""
    for _ in range(ATTEMPTS):
        setup, origin = draw()
        name, points = setup.frame.name, to_cfcs(wires_mm, setup.side, origin).reshape(-1, 3)
        if setup.shows(np.vstack([points, also]), HipPlace().margin_px):
            return setup, origin
    raise SetUpError(f"none of {ATTEMPTS} set-ups shows the whole wires in all views of frame {name!r}")


def draw_head(side: str, femur: Femur, rng: np.random.Generator) -> np.ndarray:
    """Draw the centre (3,) of the head for a wire that is centred as a radiographer would: from `SetUp.hip_mm`, with
    the axes of CFCS."""
    middle = to_cfcs(np.mean(femur.wire_mm(), axis=0), side, np.zeros(3))
    return rng.normal(0.0, HipPlace().off_centre_sd_mm, 3) - middle


def placed_hip(setup: SetUp, femur: Femur, head_mm: np.ndarray, rng: np.random.Generator) -> HipScene:
    """Return the set-up's true frame and a hip with its head at a given point (3,)."""
    high = BOX_HIGH_MM if setup.frame.solid is None else LONG_HIGH_MM
    bone = Scene(volumes=(voxelise(femur, setup.side, head_mm, rng, high),))
    still = frame_scene(setup.true_frame) + Scene(tissue=SoftTissue().around(setup.hip_mm))
    return HipScene.of(still, bone, femur, setup.side, head_mm)


def truth_document(setup: SetUp, hip: HipScene) -> dict[str, Any]:
    """Return the truth of the images of a hip: wire, landmarks, views, beads. Points in CFCS, mm, and in pixels of the
    images."""
    document: dict[str, Any] = {
        **points_document(setup, hip.landmarks_mm, {name: hip.at(name).landmarks_mm for name in setup.views}),
        "head_mm": hip.head_mm.tolist(),
        "head_radius_mm": hip.femur.head_radius_mm,
        "entry_mm": hip.wire_mm[0].tolist(),
        "end_mm": hip.wire_mm[1].tolist(),
    }
    for name, view in setup.views.items():
        entry, end = view.project(hip.at(name).wire_mm)
        document["views"][name] |= {"entry_uv_px": entry.tolist(), "end_uv_px": end.tolist()}
    if hip.motions:  # the points above are those before any motion
        document["bone_moved"] = {moment: motion.as_matrix().tolist() for moment, motion in hip.motions.items()}
    return document


def points_document(
    setup: SetUp, points_mm: Points, when_seen_mm: Mapping[str, Points] | None = None
) -> dict[str, Any]:
    """Return the truth of any set-up: named points (3,), CFCS, and their pixels, views, beads.

    `when_seen_mm`: the points at the time of each view, if they move. Beads whose centre lies outside a view's field
    have no pixel in it.
    """
    when = when_seen_mm or dict.fromkeys(setup.views, points_mm)
    return {
        "frame": setup.frame.key,
        "coordinates": "CFCS",
        "side": setup.side,
        "points_mm": {name: xyz.tolist() for name, xyz in points_mm.items()},
        "views": {name: _view(setup, view, when[name]) for name, view in setup.views.items()},
        "beads_mm": {bead.id: list(bead.xyz_mm) for bead in setup.true_frame.fiducials},
    }


def write_truth(path: str | Path, setup: SetUp, hip: HipScene) -> Path:
    """Write `truth_document` as JSON. Raises UnusableInputError if the file cannot be written."""
    return write_whole(path, json.dumps(truth_document(setup, hip), indent=1).encode())


def _view(setup: SetUp, view: ViewTruth, points_mm: Points) -> dict[str, Any]:
    beads = setup.frame_in(view.name).fiducials_of(view.name)
    uv = view.project(np.array([bead.xyz_mm for bead in beads]))
    seen = view.in_field(uv)
    return {
        "focal_point_mm": view.focal_point_mm.tolist(),
        "detector": {"origin_mm": view.detector.origin_mm.tolist(), "axes": view.detector.axes.tolist()},
        "points_uv_px": {name: view.project(xyz).tolist() for name, xyz in points_mm.items()},
        "beads_uv_px": {bead.id: at.tolist() for bead, at, kept in zip(beads, uv, seen, strict=True) if kept},
    }
