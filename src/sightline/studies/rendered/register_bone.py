"""How well the bone of a CT is registered to two images of it: error, coverage of the stated error, refusals.

Each trial draws a hip beside a frame, renders both views, calibrates them from their beads, and registers the bone's CT
from a start that is off. The CT and the images come from one model of the bone, so nothing tells here of a bone that
differs from its CT.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sightline.common.checks import failed
from sightline.common.geometry.covariance import length_quantile
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.from_images.registration import BoneStart, ScannedBone, register_bone
from sightline.from_images.registration.align import moved
from sightline.studies.runs.study import Estimate, EstimateGroup, Summary, Table, Values, quantile, rms, share
from sightline.studies.scenes import calibrated_views, observed
from sightline.twin.scenes.bone_ct import bone_ct
from sightline.twin.scenes.specimens import SetUpSpec, specimen
from sightline.twin.xray.render import render_views

# A start is off by up to as much along and about each axis: the reach of `BoneStart` [ours].
START_MM, START_DEG = 10.0, 10.0
WRONG_MM = 2.0  # error of a point of a pose that counts as wrong [ours]
ARMS = {"gamma": "Γ, 9-inch intensifier", "block60": "block60, flat panel"}


@dataclass(frozen=True)
class RegisterBone:
    """The study; its fields can be varied."""

    name = "register-bone"
    about = "The bone of a CT registered to two images: error, coverage of the stated error, refusals"

    frames: tuple[str, ...] = tuple(ARMS)

    @property
    def configuration(self) -> dict[str, Any]:
        """The fields and the constants that they depend on."""
        return {**asdict(self), "start_mm": START_MM, "start_deg": START_DEG}

    def trial(self, rng: np.random.Generator) -> Values:
        """Return for each frame whether the pose is trusted; its error: rotation, °, and of entry and end of the ideal
        wire lengths, mm, lengths over their stated 95 % bounds, and chi-squares over 3."""
        return {name: _registered(name, np.random.default_rng(int(rng.integers(2**32)))) for name in self.frames}

    def summary(self, trials: Sequence[Values]) -> Summary:
        """Return outcomes and errors."""
        ended = [FrameResult.of(name, [trial[name] for trial in trials]) for name in self.frames]
        columns = ("frame", "no pose", "not trusted", "entry and end, mm", "rotation, °", "within the stated 95 %",
                   "error over stated, rms", f"trusted and wrong by {WRONG_MM:g} mm")  # fmt: skip
        note = "Errors: median / 95 %, of trusted poses. In brackets: 95 % intervals."
        return Summary(
            findings=tuple(result.words for result in ended),
            estimates=tuple(estimate for result in ended for estimate in result.estimates),
            tables=(Table("Poses of the bone", columns, tuple(result.row for result in ended), note),),
        )


def _registered(frame: str, rng: np.random.Generator) -> Values:
    try:
        drawn = specimen("hip", rng, SetUpSpec(Frame.load(frame)))
        setup = drawn.setup
        scan, pose = bone_ct(drawn.scene, setup.side, rng)
        bone = ScannedBone.of_ct(scan)
        images = render_views(setup, list(setup.views), drawn.scene, rng)
        seen = {name: observed(image, setup.frame, name) for name, image in images.items()}
        reach = np.repeat([np.deg2rad(START_DEG), START_MM], 3)
        start = BoneStart(moved(pose, rng.uniform(-reach, reach), pose.apply(bone.centre_mm)))
        found = register_bone(bone, list(images.values()), calibrated_views(setup, seen), start)
    except SightlineError as error:
        return {"ended": "refused", "why": type(error).__name__}
    wire = drawn.wire_mm
    assert wire is not None  # noqa: S101 - a hip has a wire
    own = pose.inv().apply(wire)
    off = found.at(own) - wire
    stated = np.array([found.covariance_at(point[None]) for point in own])
    return {
        "ended": "trusted" if found.trusted else "not trusted",
        "why": ", ".join(sorted({check.name for check in failed(found.checks)})),
        "error_mm": np.linalg.norm(off, axis=1).round(6).tolist(),
        "turn_deg": float(np.rad2deg((pose * found.pose.inv()).rotation.magnitude())),
        "over_95": (np.linalg.norm(off, axis=1) / length_quantile(stated)).round(6).tolist(),
        "chi2_3": (np.einsum("ni,ni->n", off, np.linalg.solve(stated, off[..., None])[..., 0]) / 3).round(6).tolist(),
    }


@dataclass(frozen=True)
class FrameResult(EstimateGroup):
    """Outcomes of the registrations beside one frame; `errors`: median and 95 % of points and rotation."""

    name: str
    refused: Estimate
    not_trusted: Estimate
    errors: tuple[Estimate, ...]
    covered: Estimate
    normalised: Estimate
    wrong: Estimate

    @staticmethod
    def of(frame: str, outcomes: Sequence[Values]) -> "FrameResult":
        """Return the result over all trials."""
        name, answered = ARMS[frame], [outcome for outcome in outcomes if outcome["ended"] != "refused"]
        good = [outcome for outcome in answered if outcome["ended"] == "trusted"]
        sizes = {
            "entry and end": (np.array([outcome["error_mm"] for outcome in good]).ravel(), "mm"),
            "rotation": (np.array([outcome["turn_deg"] for outcome in good]), "°"),
        }
        worst = np.array([max(outcome["error_mm"]) for outcome in good])
        return FrameResult(
            name,
            share(f"{name}: no pose", np.array([outcome["ended"] == "refused" for outcome in outcomes])),
            share(f"{name}: not trusted", np.array([outcome["ended"] == "not trusted" for outcome in answered])),
            tuple(quantile(f"{name}: {what}, {at:.0%}", values, at, unit)
                  for what, (values, unit) in sizes.items() for at in (0.5, 0.95)),
            share(f"{name}: entries and ends within the stated 95 %",
                  np.array([each <= 1 for outcome in good for each in outcome["over_95"]])),
            rms(f"{name}: error over stated, rms", [np.sqrt(outcome["chi2_3"]) for outcome in good]),
            share(f"{name}: trusted and wrong", worst > WRONG_MM),
        )  # fmt: skip

    @property
    def words(self) -> str:
        """The result as a sentence."""
        median = self.errors[0]
        if median.value is None:
            return f"{self.name}: no pose is trusted."
        return f"{self.name}: {median.value:.2f} mm at the wire's ends (median); {self.covered.value:.0%} within 95 %."

    @property
    def row(self) -> tuple[str, ...]:
        """The row of the table."""
        pairs = zip(self.errors[::2], self.errors[1::2], strict=True)
        return (
            self.name,
            str(self.refused),
            str(self.not_trusted),
            *("none" if a.value is None else f"{a.value:.2f} / {b.value:.2f}" for a, b in pairs),
            str(self.covered),
            str(self.normalised),
            str(self.wrong),
        )
