"""A hip of the twin, and what a person clicks and draws of it on two images, as pixels; nothing is rendered."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.planning import Aids, Circle, Line, MatchingCurve, Pick, Plan, Procedure, plan
from sightline.studies.scenes import MARGIN_PX, VIEWS
from sightline.twin import SetUp
from sightline.twin.femur import Femur, draw_femur, to_cfcs
from sightline.twin.scene import shown_setup

PICK_PX = 0.5  # a careful click (physics.md, Picks)
RIM_CLICKS = 6
# Places of the clicks on a line or border, of the way from the head's centre to the shaft [ours].
NECK_AXIS, NECK_BORDER = (0.25, 0.75), (0.35, 0.55)
SHAFT_MM, CORTEX_MM = (-8.0, 12.0), 5.0  # caudal of the entry: ends of the shaft's line, click on the lateral cortex
LANDMARKS = ("head-centre", "lesser-trochanter", "greater-trochanter")
Pixels = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class DrawnHip:
    """A femur in a set-up: its side, and the centre of its head (3,), CFCS. Other points are anatomical (3,)."""

    setup: SetUp
    femur: Femur
    side: str
    head_mm: np.ndarray

    @staticmethod
    def drawn(rng: np.random.Generator, frame: Frame) -> "DrawnHip":
        """Draw a hip of either side, and a set-up that shows its ideal wire. Raises SetUpError if none is found."""
        side, femur = str(rng.choice(["right", "left"])), draw_femur(rng)
        setup, head = shown_setup(rng, frame, side, femur)
        return DrawnHip(setup, femur, side, head)

    def pixels(self, wire_mm: np.ndarray) -> dict[str, np.ndarray]:
        """Return the true pixels of all points and drawings for a wire (2, 3): "wire", "landmarks" (2, N, 2) by view,
        "head" (2, RIM_CLICKS, 2), "neck", "shaft" (2, 2, 2), "outline" (2, 2, 2, 2: view, border, click) and "cortex"
        (2,) in the first view. Raises SetUpError where one lies outside its image.
        """
        marks = np.stack([np.zeros(3), self.femur.lesser_trochanter_mm, self.femur.greater_trochanter_mm])
        neck, shaft = (self.femur.base_mm * np.array(NECK_AXIS)[:, None], self._shaft(wire_mm[0], np.array(SHAFT_MM)))
        out = {"landmarks": self.projected(marks), "neck": self.projected(neck), "shaft": self.projected(shaft)}
        out["wire"] = self.projected(wire_mm)
        out["head"] = np.stack([self._shown(view, self._rim(view)) for view in VIEWS])
        out["outline"] = np.stack([self._borders(view) for view in VIEWS])
        (on,) = self._shaft(wire_mm[0], np.array([CORTEX_MM]))
        out["cortex"] = self._shown("pa", self._edge("pa", on, np.array([0.0, 1.0, 0.0]), 1.0)[None])[0]
        return out

    def in_cfcs(self, points_mm: np.ndarray) -> np.ndarray:
        """Convert anatomical points (..., 3) to CFCS."""
        return to_cfcs(points_mm, self.side, self.head_mm)

    def projected(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (2, N, 2) of points (N, 3) in both views. Raises SetUpError where one lies outside."""
        return np.stack([self._shown(view, points_mm) for view in VIEWS])

    def _shaft(self, entry_mm: np.ndarray, caudal_mm: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) of the shaft's axis so far caudal of the entry."""
        base = self.femur.base_mm
        return np.stack([np.array([base[0], entry_mm[1] + down, base[2]]) for down in caudal_mm])

    def _shown(self, view: str, points_mm: np.ndarray) -> np.ndarray:
        uv = self.setup.views[view].project(self.in_cfcs(points_mm))
        if not self.setup.views[view].in_field(uv, MARGIN_PX).all():
            raise SetUpError("a drawing lies outside an image")
        return uv

    def _source(self, view: str) -> np.ndarray:
        """Return the X-ray source (3,), anatomical."""
        return to_cfcs(self.setup.views[view].focal_point_mm - self.head_mm, self.side, np.zeros(3))

    def _rim(self, view: str) -> np.ndarray:
        """Return points (RIM_CLICKS, 3) where lines of sight touch the head."""
        source, radius = self._source(view), self.femur.head_radius_mm
        around = np.linalg.svd(source[None])[2][1:]
        sine = radius / np.linalg.norm(source)
        turns = 2 * np.pi * np.arange(RIM_CLICKS) / RIM_CLICKS
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ around
        return sine**2 * source + radius * np.sqrt(1 - sine**2) * ring

    def _borders(self, view: str) -> np.ndarray:
        """Return the clicks (2, 2, 2) on both borders of the neck: border, click, (u, v)."""
        on = self.femur.base_mm * np.array(NECK_BORDER)[:, None]
        edges = [np.stack([self._edge(view, at, self.femur.towards_head, way) for at in on]) for way in (1.0, -1.0)]
        return np.stack([self._shown(view, edge) for edge in edges])

    def _edge(self, view: str, on_mm: np.ndarray, along: np.ndarray, way: float) -> np.ndarray:
        """Return the surface's point (3,) beside a point of an axis, across it and the ray; `way` 1: lateral first."""
        sideways = np.cross(on_mm - self._source(view), along)
        sideways *= way * (np.sign(sideways[0]) or 1.0) / np.linalg.norm(sideways)
        return self.femur.surface_mm(on_mm, sideways)


def jittered(pixels: Pixels, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the pixels with a careful click's noise."""
    return {name: uv + PICK_PX * rng.standard_normal(uv.shape) for name, uv in pixels.items()}


def plan_of(
    views: Sequence[CalibratedView], pixels: Pixels, procedure: Procedure, side: str, undrawn: Collection[str] = ()
) -> Plan:
    """Return the plan of clicks and drawings, without the aids `undrawn`. Raises SightlineError."""

    def lines(name: str) -> tuple[Line, Line]:
        return Line(pixels[name][0]), Line(pixels[name][1])

    first, second = ((Line(view[0]), Line(view[1])) for view in pixels["outline"])
    aids = Aids(
        head=(Circle.through(pixels["head"][0]), Circle.through(pixels["head"][1])),
        neck=lines("neck"),
        shaft=lines("shaft"),
        cortex=Pick.free(pixels["cortex"]),
        outline=(first, second),
    )
    unasked = {"head", "neck", "shaft", "cortex", "outline"} - {aid.key for aid in procedure.aids}
    wire = pixels["wire"]
    return plan(
        views,
        wire[:, 0],
        wire[:, 1],
        landmarks_uv_px=pixels["landmarks"],
        landmark_names=LANDMARKS,
        kind=procedure,
        side=side,
        aids=replace(aids, **dict.fromkeys({*unasked, *undrawn})),
        curve=_no_curve,
    )


def _no_curve(*_: object) -> MatchingCurve:
    """Return a curve that nothing looks at: drawing one takes most of the time of a plan."""
    nothing, pixels = np.zeros(0), np.zeros((0, 2))
    return MatchingCurve("pa", "lateral", nothing, np.zeros((0, 3)), pixels, pixels, nothing.astype(bool), lambda: None)
