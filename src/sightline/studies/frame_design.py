"""Effect of a frame's design on the error at the target: kind of frame, plate distances, pitch, number and size of
balls, tolerances, handling errors.

All designs of the Γ frame are imaged by the same C-arm in the same pose, with errors from the same draws, so that
results differ only by design. Other kinds of frames have poses of their own (frame_kinds.py). Targets are the two ends
of a wire, located to 0.1 px; manual picks add the same error to every design.

Balls are points here. The noise of a centre depends on the size of the ball as in physics.md (Centroid limit), from
0.1 px for 3 mm. Not modelled: smaller balls are harder to find, and larger ones hide more. Handling errors affect only
the true frame; the software does not know them.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

import sightline as sl
from sightline.detection import Observations
from sightline.errors import SightlineError
from sightline.frame import Frame, Tolerances
from sightline.frame.check import reach_mm
from sightline.frame.designs import GAMMA_BEAMS, Balls, FrameDesign
from sightline.frame.plate import SOURCE_TO_DETECTOR_MM, SOURCE_TO_HIP_MM
from sightline.studies.frame_kinds import (
    BEAD_PX,
    BLOCKS,
    DRAPES_MM,
    EQUAL,
    FIELDS_MM,
    INTERVAL,
    KINDS,
    PICK_PX,
    DesignResult,
    FrameKind,
    error_of_kind,
    error_table,
    kinds_plot,
    located,
    place_table,
    which_to_build,
)
from sightline.studies.plots import spans
from sightline.studies.scenes import BEADS_20UM, VIEWS, WHOLE, WIRE_ENDS_MM, draw_showing
from sightline.studies.study import Estimate, Plot, Summary, Table, Values
from sightline.twin import SetUp, bead_images
from sightline.twin.objects.beam import attenuation_per_mm
from sightline.twin.objects.things import PLATE_THICKNESS_MM, SoftTissue
from sightline.twin.xray.setup import Handling, displaced, in_use

BEAD_MM = 3.0  # diameter of a ball that BEAD_PX holds for (physics.md, Centroid limit)
MIDDLE_ENERGY = 1  # 60 keV of the beam's three
# The skin of the thigh, drapes, and half of the plate.
NEAREST_MM = SoftTissue().half_mm[1] + DRAPES_MM + PLATE_THICKNESS_MM / 2
# Room for the intensifier's housing before its input plane: 30 mm [ours], so that no plate touches it.
FARTHEST_MM = SOURCE_TO_DETECTOR_MM - SOURCE_TO_HIP_MM - 30.0 - PLATE_THICKNESS_MM / 2
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
            "noise_px": {"bead": BEAD_PX, "pick": PICK_PX},
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
    shared, picks = rng.standard_normal(36), PICK_PX * rng.standard_normal((2, 2, 2))
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
