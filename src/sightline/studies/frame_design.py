"""Effect of a frame on the error at the target: its kind (plates or a solid), plate distances, pitch, number and size
of balls, tolerances, handling errors.

All designs of the Γ frame are imaged by the same C-arm in the same pose, with errors from the same draws, so that
results differ only by design. Frames of other kinds have poses of their own, aimed as they need, that show them and the
whole wire. Targets are the two ends of a wire, located to 0.1 px; manual picks add the same error to every design.

Balls are points here. The noise of a centre depends on the size of the ball as in physics.md (Centroid limit), from
0.1 px for 3 mm. Not modelled: smaller balls are harder to find, and larger ones hide more. Handling errors affect only
the true frame; the software does not know them.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np

import sightline as sl
from sightline.calibration.view import CalibratedView
from sightline.detection import Observations
from sightline.errors import SightlineError
from sightline.frame import Frame, Tolerances
from sightline.frame.check import reach_mm
from sightline.frame.designs import GAMMA_BEAMS, Balls, FrameDesign
from sightline.frame.drawings.part import COVER_MM, THICKNESS_MM
from sightline.frame.plate import SOURCE_TO_DETECTOR_MM, SOURCE_TO_HIP_MM
from sightline.frame.solid_shape import FIELDS_MM
from sightline.imaging.volumes.beam import attenuation_per_mm
from sightline.studies.runs.plots import Span, spans
from sightline.studies.runs.study import Estimate, EstimateGroup, Plot, Summary, Table, Values, rms, share
from sightline.studies.scenes import (
    BEAD_PX,
    BEADS_20UM,
    CENTRED_PX,
    VIEWS,
    WHOLE,
    WIRE_ENDS_MM,
    TargetScene,
    calibrated_views,
    draw_showing,
    measure,
)
from sightline.twin import SetUp, bead_images
from sightline.twin.objects.things import SoftTissue
from sightline.twin.xray.distributions import NEAR_PLACE, SolidPlace
from sightline.twin.xray.setup import Handling, Variation, displaced, in_use

INTERVAL = "rms (tick) with its 95 % interval (bar)"


def located(views: Sequence[CalibratedView], uv_px: np.ndarray, true_mm: np.ndarray) -> Values:
    """Return the errors of points (N, 3) picked in views (V, N, 2), and the roots of their stated variances, mm.

    Raises SightlineError.
    """
    points = sl.reconstruct(views, uv_px, np.broadcast_to(CENTRED_PX**2 * np.eye(2), (*uv_px.shape, 2)))
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
EQUAL = {"as made": WHOLE, "balls 0.1 mm": replace(WHOLE, bead_mm=0.1), "plates and arms measured": BEADS_20UM}
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
        errors = [(results[kind.key("as made")].error, kind) for kind in kinds if kind.chain == chain]
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
    picks = scene.target_px + CENTRED_PX * rng.standard_normal(scene.target_px.shape)
    try:
        return located(calibrated_views(scene.setup, scene.observations), picks, scene.target_mm)
    except SightlineError:
        return None


BLOCKS = ("block30", "block40", "block60", "cube120")
# Assumed where a solid's place is searched [ours]: aiming error per image, at the hip; thickness of folded drapes on
# the skin; smallest distance between an end of the wire and a ball in an image, at the hip. Less would not hold
# in practice.
MARGIN_MM, DRAPES_MM, CLEAR_MM = 8.0, 5.0, 5.0
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


BEAD_MM = 3.0  # diameter of a ball that BEAD_PX holds for (physics.md, Centroid limit)
MIDDLE_ENERGY = 1  # 60 keV of the beam's three
# The skin of the thigh, drapes, and half of the plate.
NEAREST_MM = SoftTissue().half_mm[1] + DRAPES_MM + THICKNESS_MM / 2
# Room for the intensifier's housing before its input plane: 30 mm [ours], so that no plate touches it.
FARTHEST_MM = SOURCE_TO_DETECTOR_MM - SOURCE_TO_HIP_MM - 30.0 - THICKNESS_MM / 2
MIN_REACH_MM, MIN_IN_FIELD = 10.0, 0.6  # of `check_frame`
MIN_GAIN = 0.10  # a smaller reduction of the error is not worth a new frame [ours]


@dataclass(frozen=True)
class Design:
    """One frame: plate distances from the hip, pitch and ball diameter, mm; rows of the XRII plate."""

    source_mm: float = 150.0
    xrii_mm: float = 300.0
    pitch_mm: float = 22.0
    rows: int = 7
    ball_mm: float = 3.0

    @property
    def name(self) -> str:
        """The design's numbers."""
        return f"{self.source_mm:g}/{self.xrii_mm:g}, {self.rows} x {self.pitch_mm:g}, balls {self.ball_mm:g}"

    def frame(self, tolerances: Tolerances) -> Frame:
        """Return the frame without datum markers, since labels are known here."""
        balls, none = Balls(self.ball_mm, self.ball_mm), dict.fromkeys(GAMMA_BEAMS, ((), ()))
        plates: dict[str, Any] = {
            "rows": self.rows,
            "pitch_mm": self.pitch_mm,
            "xrii_mm": self.xrii_mm,
            "source_mm": self.source_mm,
        }
        design = FrameDesign("gamma", GAMMA_BEAMS, none, **plates, xrii_balls=balls, source_balls=balls)
        return replace(Frame.from_design(design), tolerances=tolerances)


DEFAULT = Design()
GEOMETRIES = (
    DEFAULT,
    Design(120, 220),
    Design(120, 300),
    Design(120, 340),
    Design(150, 220),
    Design(150, 340),
    Design(200, 250),
    Design(200, 340),
    Design(pitch_mm=18),
    Design(pitch_mm=20),
    Design(pitch_mm=24),
    Design(rows=5, pitch_mm=33),
    Design(rows=9, pitch_mm=16.5),
    Design(ball_mm=2),
    Design(ball_mm=4),
)
# With plates and arms measured on the finished frame, only balls have errors, which shows the effect of geometry.
MADE = {"as made": WHOLE, "plates and arms measured": BEADS_20UM}
AS_MADE = f"{DEFAULT.name}, as made"
TOLERANCES = {
    "all a quarter": Tolerances(*(0.25 * sd for sd in asdict(WHOLE).values())),
    "all a half": Tolerances(*(0.5 * sd for sd in asdict(WHOLE).values())),
    "balls 0.05 mm": replace(WHOLE, bead_mm=0.05),
    "plates exact": replace(WHOLE, plate_mm=0.0, plate_rad=0.0),
    "arms exact": replace(WHOLE, arm_mm=0.0, arm_rad=0.0),
    "all twofold": Tolerances(*(2.0 * sd for sd in asdict(WHOLE).values())),
}
AS_MEASURED = Handling()
HANDLINGS = {
    "10 K warmer": Handling(warmer_k=10.0),
    "10 K colder": Handling(warmer_k=-10.0),
    "1 % of water taken up": Handling(water_share=0.01),
    "drapes of 10 N": Handling(drape_n=10.0),
    "drapes of 20 N": Handling(drape_n=20.0),
    "10 K, 1 % of water, 20 N": Handling(10.0, 0.01, 20.0),
}


@dataclass(frozen=True)
class FrameDesignStudy:
    """The study; its fields can be varied."""

    name = "frame-design"
    about = "What a frame's kind, plates, balls, tolerances and handling do to the error at the target"

    geometries: tuple[Design, ...] = GEOMETRIES
    tolerances: tuple[str, ...] = tuple(TOLERANCES)
    handlings: tuple[str, ...] = tuple(HANDLINGS)
    kinds: tuple[FrameKind, ...] = KINDS
    blocks: tuple[str, ...] = BLOCKS

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {
            **asdict(self),
            "made": {name: asdict(sd) for name, sd in {**MADE, **TOLERANCES, **EQUAL}.items()},
            "handled": {name: asdict(HANDLINGS[name]) for name in self.handlings},
            "wire_mm": WIRE_ENDS_MM.tolist(),
            "fields_mm": FIELDS_MM,
            "noise_px": {"bead": BEAD_PX, "pick": CENTRED_PX},
        }

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each design, tolerance and handling the wire ends' errors (2) and their stated values, mm."""
        setup = draw_showing(rng, Frame.load("gamma"), WIRE_ENDS_MM, frame_errors=False)
        seed = int(rng.integers(2**32))
        errors: Values = {}
        for design in self.geometries:
            for made, sd in MADE.items():
                errors[f"{design.name}, {made}"] = error_of(setup, design, sd, AS_MEASURED, seed)
        for name in self.tolerances:
            errors[name] = error_of(setup, DEFAULT, TOLERANCES[name], AS_MEASURED, seed)
        for name in self.handlings:
            for made, sd in MADE.items():
                errors[f"{name}, {made}"] = error_of(setup, DEFAULT, sd, HANDLINGS[name], seed)
        for kind in self.kinds:
            for made in kind.tolerances:
                errors[kind.key(made)] = error_of_kind(kind, EQUAL[made], seed)
        return errors

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return errors by design, tolerance and handling, and the best design of those that fit."""
        results = {key: DesignResult.of(key, trials) for key in trials[0]}
        gains = {design: _gain(design, trials) for design in self.geometries if design != DEFAULT}
        handled = [f"{handling}, {made}" for made in MADE for handling in self.handlings]
        title, kinds = "Error at the ends of the wire", {kind.key(made) for kind in self.kinds for made in EQUAL}
        drawn = [
            result.span(key) for key, result in results.items() if result.error.value is not None and key not in kinds
        ]
        return Summary(
            findings=(*which_to_build(self.kinds, results), *_findings(results, gains)),
            estimates=(*(estimate for result in results.values() for estimate in result.estimates), *gains.values()),
            tables=(
                error_table("Kinds of frames at equal tolerances", [key for key in results if key in kinds], results),
                place_table(self.blocks, WIRE_ENDS_MM),
                self._geometry_table(results, gains),
                error_table("Tolerances of the default frame", [AS_MADE, *self.tolerances], results),
                error_table("Handling of the default frame", handled, results),
            ),
            plots=(
                *kinds_plot(self.kinds, results),
                Plot(title, spans(drawn, "mm", title), f"{INTERVAL}."),
            ),
        )

    def _geometry_table(self, results: dict[str, DesignResult], gains: dict[Design, Estimate]) -> Table:
        rows = []
        for design in self.geometries:
            gain = str(gains[design]) if design in gains else "the default"
            each = (results[f"{design.name}, {made}"].cell for made in MADE)
            covered = f"{100 * covered_share(design):.1f} %"
            rows.append((design.name, *each, gain, covered, obstacle(design) or "fits"))
        columns = ("plates, rows x pitch, balls, mm", *MADE, "rms over the default's", "of the field covered", "fits")
        note = (
            "Error / stated error, mm rms, of the ends of a 97 mm wire located to 0.1 px. In brackets: 95 % interval "
            f"of the ratio, as made. A plate fits from {NEAREST_MM:.0f} mm (skin, drapes) to {FARTHEST_MM:.0f} mm "
            "(housing of the intensifier) from the hip, if its balls surround the wire and are in the field."
        )
        return Table("Geometry", columns, tuple(rows), note)


def obstacle(design: Design) -> str:
    """Return why a design does not fit around a hip; "" if it does."""
    if design.source_mm < NEAREST_MM:
        return "in the thigh"
    if design.xrii_mm > FARTHEST_MM:
        return "in the intensifier"
    for view in design.frame(WHOLE).views.values():
        for plate in (view.xrii, view.source):
            if view.in_field(plate.xyz_mm).mean() < MIN_IN_FIELD:
                return "beyond the field"
            if (reach_mm(view, plate) or 0.0) < MIN_REACH_MM:
                return "too small for the wire"
    return ""


def covered_share(design: Design) -> float:
    """Return the share of the field's disc at the hip that is covered by shadows of balls, without overlap."""
    plates = ((design.xrii_mm, design.rows), (design.source_mm, design.rows + 1))
    area = sum(rows**2 * (design.ball_mm / 2 * SOURCE_TO_HIP_MM / (SOURCE_TO_HIP_MM + mm)) ** 2 for mm, rows in plates)
    return area / (107.5 * SOURCE_TO_HIP_MM / SOURCE_TO_DETECTOR_MM) ** 2


def bead_sd_px(ball_mm: float) -> float:
    """Return the noise of a ball's centre, proportional to sqrt((1 - C/2) / R) / C with the contrast C of its mean
    chord, and BEAD_PX at 3 mm."""

    def relative(mm: float) -> float:
        contrast = 1 - np.exp(-attenuation_per_mm("steel")[MIDDLE_ENERGY] * 2 / 3 * mm)
        return float(np.sqrt((1 - contrast / 2) / mm) / contrast)

    return BEAD_PX * relative(ball_mm) / relative(BEAD_MM)


def error_of(setup: SetUp, design: Design, sd: Tolerances, handling: Handling, seed: int) -> Values | None:
    """Return the errors (2) of the wire's ends and the roots of the stated variances, mm; None: refused."""
    rng = np.random.default_rng(seed)
    frame = design.frame(sd)
    shared, picks = rng.standard_normal(36), CENTRED_PX * rng.standard_normal((2, 2, 2))
    factor = frame.error_factor
    draws = np.concatenate([rng.standard_normal(factor.shape[1] - len(shared)), shared])
    made = replace(
        displaced(frame, (factor @ draws).reshape(-1, 3)), tolerances=WHOLE
    )  # handling depends on the tolerances as made
    stands = replace(setup, frame=frame, true_frame=in_use(made, handling))
    pixels = np.array([setup.views[name].project(WIRE_ENDS_MM) for name in VIEWS]) + picks
    try:
        views = [sl.calibrate(_seen(stands, name, rng, bead_sd_px(design.ball_mm)), frame) for name in VIEWS]
        return located(views, pixels, WIRE_ENDS_MM)
    except SightlineError:
        return None


def _seen(setup: SetUp, name: str, rng: np.random.Generator, sd_px: float) -> Observations:
    ids, uv = bead_images(setup, name, rng, sd_px)
    return Observations(name, ids, uv, np.broadcast_to(sd_px**2 * np.eye(2), (len(ids), 2, 2)))


def _gain(design: Design, trials: Sequence[Values]) -> Estimate:
    """Return the rms error over that of the default, as made, over set-ups without refusals, with a paired interval."""
    key = f"{design.name}, as made"
    name = f"{design.name}: rms over the default's"
    pairs = [[np.mean(np.square(t[k]["error"])) for k in (key, AS_MADE)] for t in trials if t[key] and t[AS_MADE]]
    if len(pairs) < 2:
        return Estimate(name, None, None, None, "", len(pairs))
    mine, theirs = np.mean(pairs, axis=0)
    ratio = mine / theirs
    spread = np.std(np.array(pairs) @ [1.0, -ratio], ddof=1) / np.sqrt(len(pairs)) / theirs
    low, high = ratio + 1.96 * np.array([-spread, spread])
    return Estimate(name, float(ratio**0.5), float(max(low, 0.0) ** 0.5), float(high**0.5), "", len(pairs))


def _findings(results: dict[str, DesignResult], gains: dict[Design, Estimate]) -> Sequence[str]:
    sentences = [f"The default frame: {results[AS_MADE].error} mm rms at the ends of the wire."]
    handled = [key for key in HANDLINGS if f"{key}, as made" in results]
    if handled:
        worst = max(handled, key=lambda key: results[f"{key}, as made"].error.value or 0.0)
        measured = results[f"{worst}, plates and arms measured"].error
        sentences.append(
            f"Handling costs it most by {worst}: {results[f'{worst}, as made'].error} mm rms, "
            f"{measured} with plates and arms measured."
        )
    fitting = [(gain.value, design, gain) for design, gain in gains.items() if gain.value and not obstacle(design)]
    if not fitting:
        return sentences
    _, best, gain = min(fitting, key=lambda fit: fit[0])
    if gain.high is not None and gain.high < 1 - MIN_GAIN:
        return [*sentences, f"Recommended of those that fit: {best.name}, {gain} of the default's error."]
    return [
        *sentences,
        f"Recommended: the default frame. The best of the others that fit is {best.name}, at {gain} of its error; "
        f"a change is recommended only if it reduces the error by at least {MIN_GAIN:.0%}.",
    ]
