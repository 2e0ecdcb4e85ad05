"""Frames of different kinds at equal tolerances: plates around a hip, or a solid beside it.

Every frame is imaged by a C-arm aimed as it needs, in a pose of its own draw that shows it and the whole wire.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

import sightline as sl
from sightline.calibration.view import CalibratedView
from sightline.errors import SightlineError
from sightline.frame import Frame, Tolerances
from sightline.frame.plate import SOURCE_TO_HIP_MM
from sightline.studies.plots import Span, spans
from sightline.studies.scenes import (
    BEADS_20UM,
    WHOLE,
    WIRE_ENDS_MM,
    TargetScene,
    calibrated_views,
    draw_showing,
    measure,
)
from sightline.studies.study import Estimate, EstimateGroup, Plot, Table, Values, rms, share
from sightline.twin.objects.things import SoftTissue
from sightline.twin.xray.distributions import NEAR_PLACE, SolidPlace
from sightline.twin.xray.setup import Variation

PICK_PX = 0.1  # a located target (physics.md, Picks)
BEAD_PX = 0.1  # physics.md, Centroid limit
INTERVAL = "rms (tick) with its 95 % interval (bar)"


def located(views: Sequence[CalibratedView], uv_px: np.ndarray, true_mm: np.ndarray) -> Values:
    """Return the errors of points (N, 3) picked in views (V, N, 2), and the roots of their stated variances, mm.

    Raises SightlineError.
    """
    points = sl.reconstruct(views, uv_px, np.broadcast_to(PICK_PX**2 * np.eye(2), (*uv_px.shape, 2)))
    stated = np.sqrt(np.trace(points.covariance_mm2, axis1=1, axis2=2))
    return {"error": np.linalg.norm(points.xyz_mm - true_mm, axis=1).round(6).tolist(), "stated": stated.tolist()}


@dataclass(frozen=True)
class DesignResult(EstimateGroup):
    """The result of one design: `error` and `stated`, mm rms; how often it was `refused`."""

    error: Estimate
    stated: Estimate
    refused: Estimate

    @staticmethod
    def of(key: str, trials: Sequence[Values]) -> "DesignResult":
        """Return the result over all trials."""
        kept = [trial[key] for trial in trials if trial[key] is not None]
        return DesignResult(
            rms(f"{key}: error", [np.array(errors["error"]) for errors in kept], "mm"),
            rms(f"{key}: stated", [np.array(errors["stated"]) for errors in kept], "mm"),
            share(f"{key}: refused", np.array([trial[key] is None for trial in trials])),
        )

    def span(self, name: str, colour: str = "beads") -> Span:
        """Return the row of the picture: the error with its interval; marked is the stated error."""
        value = self.error.value or 0.0
        return Span(name, self.error.low or value, value, self.error.high or value, self.stated.value, colour)

    @property
    def cell(self) -> str:
        """The table cell: error / stated."""
        if self.error.value is None:
            return "refused"
        refused = f", {self.refused.value:.0%} refused" if self.refused.value else ""
        return f"{self.error.value:.3f} / {self.stated.value:.3f}{refused}"


def error_table(title: str, keys: Sequence[str], results: dict[str, DesignResult]) -> Table:
    """Return the table of some results by name."""
    rows = tuple((key, results[key].cell, str(results[key].error)) for key in keys)
    return Table(title, ("", "error / stated, mm rms", "95 % interval of the error"), rows)


AIM = 0.5  # share of the way from the wire to a solid outside the skin at which the beams are aimed [ours]
MADE = "as made"
EQUAL = {MADE: WHOLE, "balls 0.1 mm": replace(WHOLE, bead_mm=0.1), "plates and arms measured": BEADS_20UM}
COLOURS = dict(zip(EQUAL, ("beads", "map", "balls"), strict=True))
DETECTORS = {"9in-1k": "intensifier", "flat-panel": "panel"}


@dataclass(frozen=True)
class FrameKind:
    """A frame before a detector. `at_mm`: a solid's middle from the wire's, by default the twin's usual place."""

    frame: str
    chain: str
    at_mm: tuple[float, float, float] | None = None

    @property
    def solid(self) -> bool:
        """Whether the frame is a solid: it has no plates or arms to measure."""
        return Frame.load(self.frame).solid is not None

    @property
    def stands(self) -> str:
        """The frame and its distance."""
        distance = f", {np.linalg.norm(self.place.solid_mm):.0f} mm away" if self.solid else ""
        return self.frame.replace("+detector-plate", " with plate") + distance

    @property
    def place(self) -> SolidPlace:
        """Where a solid stands."""
        if self.at_mm is not None:
            return SolidPlace(self.at_mm, AIM)
        return SolidPlace() if self.chain == "flat-panel" else NEAR_PLACE

    @property
    def tolerances(self) -> tuple[str, ...]:
        """The names of those of EQUAL that differ for this frame."""
        return tuple(EQUAL)[: 2 if self.solid else 3]

    def key(self, made: str) -> str:
        """The name of the result with tolerances of EQUAL."""
        return f"{self.stands}, {DETECTORS[self.chain]}, {made}"


# The last two stand at the nearest places outside the skin (block_places.py), the other solids nearer.
KINDS = (
    FrameKind("gamma", "9in-1k"),
    FrameKind("biplane", "9in-1k"),
    FrameKind("block30+detector-plate", "9in-1k"),
    FrameKind("block40+detector-plate", "9in-1k"),
    FrameKind("block60+detector-plate", "9in-1k", (40.0, 0.0, 60.0)),  # nearer, the wire would pass through it
    FrameKind("gamma", "flat-panel"),
    FrameKind("biplane", "flat-panel"),
    FrameKind("block30", "flat-panel"),
    FrameKind("block40", "flat-panel"),
    FrameKind("block60", "flat-panel"),
    FrameKind("block60", "flat-panel", (40.0, 0.0, 130.0)),
    FrameKind("block30", "flat-panel", (80.0, 0.0, 100.0)),
)


def which_to_build(kinds: Sequence[FrameKind], results: dict[str, DesignResult]) -> list[str]:
    """Return for each detector the sentence that orders the frames by their error at equal tolerances."""
    sentences = []
    for chain, detector in DETECTORS.items():
        errors = [(results[kind.key(MADE)].error, kind) for kind in kinds if kind.chain == chain]
        ranked = sorted(((e, kind) for e, kind in errors if e.value is not None), key=lambda pair: pair[0].value or 0.0)
        if ranked:
            best, *others = [f"{kind.stands}: {error}" for error, kind in ranked]
            sentences.append(
                f"Before the {detector} build {best} mm rms at equal tolerances. Others: {'; '.join(others)}."
            )
    return sentences


def kinds_plot(kinds: Sequence[FrameKind], results: dict[str, DesignResult]) -> list[Plot]:
    """Return the picture that compares the kinds, none without kinds."""
    rows = [(kind.key(made), COLOURS[made]) for kind in kinds for made in kind.tolerances]
    drawn = [results[key].span(key, colour) for key, colour in rows if results[key].error.value is not None]
    title, caption = "Which frame to build", f"Ends of the wire: {INTERVAL}; diamond: stated error."
    return [Plot(title, spans(drawn, "mm", title, "stated"), caption)] if drawn else []


def error_of_kind(kind: FrameKind, sd: Tolerances, seed: int) -> Values | None:
    """Return the errors (2) of the wire's ends and the roots of the stated variances, mm; None: refused."""
    rng = np.random.default_rng(seed)
    frame = replace(Frame.load(kind.frame), tolerances=sd)
    setup = draw_showing(rng, frame, WIRE_ENDS_MM, chain=kind.chain, variation=Variation(place=kind.place))
    scene = TargetScene.of(setup, measure(rng, setup, BEAD_PX), setup.hip_mm + WIRE_ENDS_MM)
    picks = scene.target_px + PICK_PX * rng.standard_normal(scene.target_px.shape)
    try:
        return located(calibrated_views(scene.setup, scene.observations), picks, scene.target_mm)
    except SightlineError:
        return None


FIELDS_MM = {
    "9-inch intensifier": 140.0,
    "30 cm panel": 185.0,
}  # at the hip: 9 inches and 298 mm on the detector times 620 / 1000, to 5 mm [calc]
BLOCKS = ("block30", "block40", "block60", "cube120")
MARGIN_MM = 8.0  # aiming error per image, at the hip [ours]
DRAPES_MM = 5.0  # thickness of folded drapes on the skin [ours]
COVER_MM = 3.5  # balls' centres under the solid's faces (frame/designs.py)
CLEAR_MM = 5.0  # minimum distance between an end of the wire and a ball in an image, at the hip [ours]
STEP_MM = 10.0
REACH_MM = ((-40.0, 140.0), (-100.0, 100.0), (0.0, 180.0))  # of the search: lateral, caudal, anterior
BEAM_AXES = ((2, [0, 1]), (0, [1, 2]))  # of CFCS: along the beam, across it


@dataclass(frozen=True)
class Place:
    """Where the middle of a solid may stand: `at_mm` from the middle of the wire (lateral, caudal, anterior)."""

    at_mm: tuple[float, float, float]
    margin_mm: float
    outside: bool

    @property
    def distance_mm(self) -> float:
        """Distance from the middle of the wire."""
        return float(np.linalg.norm(self.at_mm))


def places(frame: Frame, field_mm: float, wire_mm: np.ndarray) -> list[Place]:
    """Return all places, `STEP_MM` apart, of the solid of `frame` beside a wire (2, 3) for a field at the hip."""
    assert frame.solid is not None  # noqa: S101 - chosen by the study
    balls = frame.solid.xyz_mm - (frame.solid.xyz_mm.min(axis=0) + frame.solid.xyz_mm.max(axis=0)) / 2
    half = np.abs(balls).max(axis=0) + COVER_MM
    possible = []
    for at in product(*(np.arange(low, high + STEP_MM, STEP_MM) for low, high in REACH_MM)):
        margin = min(_margin_mm(balls + at, wire_mm, field_mm, axis) for axis in BEAM_AXES)
        if margin >= MARGIN_MM:
            possible.append(Place((float(at[0]), float(at[1]), float(at[2])), margin, _outside(np.array(at), half)))
    return possible


def place_table(blocks: Sequence[str], wire_mm: np.ndarray) -> Table:
    """Return the table of where each solid may stand for each field."""
    rows = []
    for name, (what, field_mm) in product(blocks, FIELDS_MM.items()):
        every = sorted(places(Frame.load(name), field_mm, wire_mm), key=lambda place: place.distance_mm)
        free = [place for place in every if place.outside]
        nearest = f"{' / '.join(f'{mm:g}' for mm in free[0].at_mm)}: {free[0].distance_mm:.0f} mm" if free else "none"
        margin = f"{max(place.margin_mm for place in free):.0f} mm" if free else ""
        farthest = f"{every[-1].distance_mm:.0f} mm" if every else "none"
        rows.append((name, f"{what}, {field_mm:g} mm", nearest, margin, farthest))
    columns = ("solid", "field at the hip", "nearest outside the skin", "its largest margin", "farthest in the images")
    note = (
        "Middle of the solid from that of the wire: lateral / caudal / anterior, mm. Both images show the solid and "
        f"the whole wire even if aimed {MARGIN_MM:g} mm off. Margin: how far off the aim may be at the best place "
        "outside the skin, which is that of the twin's thigh with drapes."
    )
    return Table("Where a solid may stand", columns, tuple(rows), note)


def _margin_mm(balls: np.ndarray, wire: np.ndarray, field_mm: float, axes: tuple[int, list[int]]) -> float:
    """Return the field's radius at the hip less that of the least circle around balls and wire in an image; negative
    infinite where a ball hides an end."""
    along, across = axes
    seen = [xyz[:, across] * (SOURCE_TO_HIP_MM / (SOURCE_TO_HIP_MM + xyz[:, along]))[:, None] for xyz in (balls, wire)]
    if np.linalg.norm(seen[0][:, None] - seen[1], axis=2).min() < CLEAR_MM:
        return -np.inf
    return field_mm / 2 - cv2.minEnclosingCircle(np.concatenate(seen).astype(np.float32))[1]


def _outside(at_mm: np.ndarray, half_mm: np.ndarray) -> bool:
    """Return whether a box lies outside the twin's hip and thigh with drapes."""
    body = SoftTissue()
    middle, reach = np.array(body.centre_mm), np.array(body.half_mm) + DRAPES_MM
    edge = np.linspace(-1.0, 1.0, 13)
    faces = np.array([(x, z) for x, z in product(edge, edge)]) * half_mm[[0, 2]] + at_mm[[0, 2]]
    return bool((((faces - middle) / reach) ** 2).sum(axis=1).min() > 1)
