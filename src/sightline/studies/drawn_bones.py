"""Bones of the twin, and what a person clicks and draws of them on two images, as pixels; nothing is rendered."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.calibration.view import CalibratedView
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.planning import Aids, MatchingCurve, Plan, Procedure, plan
from sightline.planning.bone.directions import across, anatomical, unit
from sightline.planning.procedures.document import WantedView
from sightline.studies.scenes import MARGIN_PX, VIEWS
from sightline.twin import SetUp, ViewTruth, draw_setup
from sightline.twin.bone_scene import BONES, BoneKind, draw_origin
from sightline.twin.bones import BoneModel
from sightline.twin.drawn_aids import drawn_aids, key_of
from sightline.twin.femur import Femur, draw_femur, to_cfcs
from sightline.twin.scene import shown_setup

PICK_PX = 0.5  # a careful click (physics.md, Picks)
RIM_CLICKS = 6
# Places of the clicks on a line or border, of the way from the head's centre to the shaft [ours].
NECK_AXIS, NECK_BORDER = (0.25, 0.75), (0.35, 0.55)
SHAFT_MM, CORTEX_MM = (-8.0, 12.0), 5.0  # caudal of the entry: ends of the shaft's line, click on the lateral cortex
Pixels = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class DrawnHip:
    """A femur in a set-up: its side, and the centre of its head (3,), CFCS. Other points are anatomical (3,)."""

    setup: SetUp
    bone: Femur
    side: str
    head_mm: np.ndarray

    @staticmethod
    def drawn(rng: np.random.Generator, frame: Frame) -> "DrawnHip":
        """Draw a hip of either side, and a set-up that shows its ideal wire. Raises SetUpError if none is found."""
        side, femur = str(rng.choice(["right", "left"])), draw_femur(rng)
        setup, head = shown_setup(rng, frame, side, femur)
        return DrawnHip(setup, femur, side, head)

    def pixels(self, wire_mm: np.ndarray) -> dict[str, np.ndarray]:
        """Return the true pixels (2, N, 2) in both views of the "wire" (2, 3), the "landmarks", and of the clicks on
        each aid by its key, NaN in a view in which it is not drawn. Raises SetUpError where one lies outside.
        """
        marks = np.stack([np.zeros(3), self.bone.lesser_trochanter_mm, self.bone.greater_trochanter_mm])
        neck, shaft = (self.bone.base_mm * np.array(NECK_AXIS)[:, None], self._shaft(wire_mm[0], np.array(SHAFT_MM)))
        out = {"landmarks": self.projected(marks), "neck": self.projected(neck), "shaft": self.projected(shaft)}
        out["wire"] = self.projected(wire_mm)
        out["head"] = np.stack([self._shown(view, self._rim(view)) for view in VIEWS])
        out["outline"] = np.stack([self._borders(view).reshape(4, 2) for view in VIEWS])
        (on,) = self._shaft(wire_mm[0], np.array([CORTEX_MM]))
        cortex = self._shown("pa", self._edge("pa", on, np.array([0.0, 1.0, 0.0]), 1.0)[None])
        out["cortex"] = np.stack([cortex, np.full((1, 2), np.nan)])
        return out

    def turned(
        self, wanted: Sequence[WantedView], which: int, by_deg: float, about: np.ndarray, rng: np.random.Generator
    ) -> "DrawnHip":
        """Return the hip as `DrawnBone.turned` does. Raises SetUpError."""
        beams = turned_beams(wanted, which, by_deg, about)
        views = {name: to_cfcs(np.array(beam), self.side, np.zeros(3)) for name, beam in beams.items()}
        setup = draw_setup(rng, self.setup.frame, side=self.side, views=views)
        return replace(self, setup=setup.renamed(VIEWS))

    def moved(self, by_mm: np.ndarray) -> "DrawnHip":
        """Return the same bone moved against the frame by (3,), CFCS."""
        return replace(self, head_mm=self.head_mm + by_mm)

    def in_cfcs(self, points_mm: np.ndarray) -> np.ndarray:
        """Convert anatomical points (..., 3) to CFCS."""
        return to_cfcs(points_mm, self.side, self.head_mm)

    def projected(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (2, N, 2) of anatomical points (N, 3). Raises SetUpError where one lies outside."""
        return _projected(self.setup, self.in_cfcs(points_mm))

    def _shown(self, view: str, points_mm: np.ndarray) -> np.ndarray:
        return _shown(self.setup.views[view], self.in_cfcs(points_mm))

    def _shaft(self, entry_mm: np.ndarray, caudal_mm: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) of the shaft's axis so far caudal of the entry."""
        base = self.bone.base_mm
        return np.stack([np.array([base[0], entry_mm[1] + down, base[2]]) for down in caudal_mm])

    def _source(self, view: str) -> np.ndarray:
        """Return the X-ray source (3,), anatomical."""
        return to_cfcs(self.setup.views[view].focal_point_mm - self.head_mm, self.side, np.zeros(3))

    def _rim(self, view: str) -> np.ndarray:
        """Return points (RIM_CLICKS, 3) where lines of sight touch the head."""
        source, radius = self._source(view), self.bone.head_radius_mm
        around = np.linalg.svd(source[None])[2][1:]
        sine = radius / np.linalg.norm(source)
        turns = 2 * np.pi * np.arange(RIM_CLICKS) / RIM_CLICKS
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ around
        return sine**2 * source + radius * np.sqrt(1 - sine**2) * ring

    def _borders(self, view: str) -> np.ndarray:
        """Return the clicks (2, 2, 2) on both borders of the neck: border, click, (u, v)."""
        on = self.bone.base_mm * np.array(NECK_BORDER)[:, None]
        edges = [np.stack([self._edge(view, at, self.bone.towards_head, way) for at in on]) for way in (1.0, -1.0)]
        return np.stack([self._shown(view, edge) for edge in edges])

    def _edge(self, view: str, on_mm: np.ndarray, along: np.ndarray, way: float) -> np.ndarray:
        """Return the surface's point (3,) beside a point of an axis, across it and the ray; `way` 1: lateral first."""
        sideways = np.cross(on_mm - self._source(view), along)
        sideways *= way * (np.sign(sideways[0]) or 1.0) / np.linalg.norm(sideways)
        return self.bone.surface_mm(on_mm, sideways)


@dataclass(frozen=True, eq=False)
class DrawnBone:
    """A bone of `BONES` in a set-up for a procedure, and its origin (3,) in CFCS. Other points are anatomical (3,)."""

    setup: SetUp
    bone: BoneModel
    side: str
    origin_mm: np.ndarray
    procedure: Procedure
    kind: BoneKind

    @staticmethod
    def drawn(rng: np.random.Generator, frame: Frame, name: str, procedure: Procedure) -> "DrawnBone":
        """Draw a bone of either side. Raises SetUpError for plates that do not show its views."""
        side, of = str(rng.choice(["right", "left"])), BONES[name]
        bone, setup = of.draw(rng).bone(), of.setup(rng, frame, side)
        origin = setup.hip_mm + draw_origin(bone, side, rng)
        return DrawnBone(setup.renamed(VIEWS), bone, side, origin, procedure, of)

    def turned(
        self, wanted: Sequence[WantedView], which: int, by_deg: float, about: np.ndarray, rng: np.random.Generator
    ) -> "DrawnBone":
        """Return the bone in another set-up with a solid, whose nominal beams are `turned_beams`. Raises SetUpError."""
        of = replace(self.kind, beams=turned_beams(wanted, which, by_deg, about))
        return replace(self, setup=of.setup(rng, self.setup.frame, self.side).renamed(VIEWS))

    def pixels(self, wire_mm: np.ndarray) -> dict[str, np.ndarray]:
        """Return the true pixels as `DrawnHip.pixels` does; without aids of which a click lies outside."""
        views, wanted = self.setup.views, [view.name for view in self.procedure.document.views]
        asked = {aid.key: [wanted[k] in aid.views for k in range(len(VIEWS))] for aid in self.procedure.aids}
        known = {name: aid for name, aid in self.bone.aids.items() if key_of(name) in asked}
        out = {"wire": self.projected(wire_mm), "landmarks": self._landmarks()}
        for key, each in drawn_aids({name: aid.mapped(self.in_cfcs) for name, aid in known.items()}, views).items():
            if all(views[view].in_field(uv, MARGIN_PX).all() for view, uv in each.items()):
                out[key] = np.stack([each[view] for view in VIEWS])
                out[key][~np.array(asked[key])] = np.nan
        return out

    def _landmarks(self) -> np.ndarray:
        """Return the pixels of the procedure's landmarks."""
        known = {key_of(name): at for name, at in self.bone.landmarks_mm.items()}
        return self.projected(np.stack([known[one.key] for one in self.procedure.landmarks]))

    def moved(self, by_mm: np.ndarray) -> "DrawnBone":
        """Return the same bone moved against the frame by (3,), CFCS."""
        return replace(self, origin_mm=self.origin_mm + by_mm)

    def in_cfcs(self, points_mm: np.ndarray) -> np.ndarray:
        """Convert anatomical points (..., 3) to CFCS."""
        return to_cfcs(points_mm, self.side, self.origin_mm)

    def projected(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (2, N, 2) of anatomical points (N, 3). Raises SetUpError where one lies outside."""
        return _projected(self.setup, self.in_cfcs(points_mm))


def turned_beams(
    wanted: Sequence[WantedView], which: int, by_deg: float, about: np.ndarray
) -> dict[str, tuple[float, float, float]]:
    """Return the nominal beams of two views by name, anatomical, one of them turned by an angle about the part of
    `about` (3,) that is perpendicular to it."""
    beams = {one.name: anatomical(one.orbit_deg, one.tilt_deg) for one in wanted[: len(VIEWS)]}
    beam = beams[wanted[which].name]
    beams[wanted[which].name] = Rotation.from_rotvec(np.deg2rad(by_deg) * unit(across(about, beam))).apply(beam)
    return {name: tuple(beam.tolist()) for name, beam in beams.items()}


def jittered(pixels: Pixels, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the pixels with a careful click's noise."""
    return {name: uv + PICK_PX * rng.standard_normal(uv.shape) for name, uv in pixels.items()}


def plan_of(
    views: Sequence[CalibratedView], pixels: Pixels, procedure: Procedure, side: str, undrawn: Collection[str] = ()
) -> Plan:
    """Return the plan of clicks and drawings, without the aids `undrawn`. Raises SightlineError."""
    types = {aid.key: aid.type for aid in procedure.aids if aid.key in pixels and aid.key not in undrawn}
    clicked = {key: [None if np.isnan(uv).any() else uv for uv in pixels[key]] for key in types}
    wire = pixels["wire"]
    return plan(
        views,
        wire[:, 0],
        wire[:, 1],
        landmarks_uv_px=pixels["landmarks"],
        landmark_names=[one.key for one in procedure.landmarks],
        kind=procedure,
        side=side,
        aids=Aids.clicked(types, clicked),
        curve=_no_curve,
    )


def _projected(setup: SetUp, xyz_mm: np.ndarray) -> np.ndarray:
    return np.stack([_shown(view, xyz_mm) for view in setup.views.values()])


def _shown(view: ViewTruth, xyz_mm: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points (N, 3), CFCS. Raises SetUpError where one lies outside the image."""
    uv = view.project(xyz_mm)
    if not view.in_field(uv, MARGIN_PX).all():
        raise SetUpError("a drawing lies outside an image")
    return uv


def _no_curve(*_: object) -> MatchingCurve:
    """Return a curve that nothing looks at: drawing one takes most of the time of a plan."""
    nothing, pixels = np.zeros(0), np.zeros((0, 2))
    return MatchingCurve("pa", "lateral", nothing, np.zeros((0, 3)), pixels, pixels, nothing.astype(bool), lambda: None)
