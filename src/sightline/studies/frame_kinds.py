"""Frames of different kinds at equal tolerances: plates around a hip, or a solid beside it.

Every frame is imaged by a C-arm aimed as it needs, in a pose of its own draw that shows it and the whole wire.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.errors import SightlineError
from sightline.frame import Frame, Tolerances
from sightline.studies.figure_spans import RMS, spans
from sightline.studies.frame_errors import BEAD_PX, INTERVAL, PICK_PX, DesignResult, located
from sightline.studies.scenes import (
    BEADS_20UM,
    WHOLE,
    WIRE_ENDS_MM,
    TargetScene,
    calibrated_views,
    draw_showing,
    measure,
)
from sightline.studies.study import Plot, Values
from sightline.twin.carm import Variation
from sightline.twin.distributions import NEAR_PLACE, SolidPlace

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


def which_to_build(kinds: Sequence[FrameKind], found: dict[str, DesignResult]) -> list[str]:
    """Return for each detector the sentence that orders the frames by their error at equal tolerances."""
    out = []
    for chain, detector in DETECTORS.items():
        errors = [(found[one.key(MADE)].error, one) for one in kinds if one.chain == chain]
        ranked = sorted(((e, one) for e, one in errors if e.value is not None), key=lambda pair: pair[0].value or 0.0)
        if ranked:
            best, *others = [f"{one.stands}: {error}" for error, one in ranked]
            out.append(f"Before the {detector} build {best} mm rms at equal tolerances. Others: {'; '.join(others)}.")
    return out


def kinds_plot(kinds: Sequence[FrameKind], found: dict[str, DesignResult]) -> list[Plot]:
    """Return the picture that compares the kinds, none without kinds."""
    rows = [(one.key(made), COLOURS[made]) for one in kinds for made in one.tolerances]
    drawn = [found[key].span(key, colour) for key, colour in rows if found[key].error.value is not None]
    title, caption = "Which frame to build", f"Ends of the wire: {INTERVAL}; diamond: stated error."
    return [Plot(title, spans(drawn, "mm", title, "stated", RMS), caption)] if drawn else []


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
