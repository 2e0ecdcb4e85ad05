"""Bad input of a block on a flat panel: how each plan ends, and how often a wrong one looks right.

A free wire of 97 mm and two landmarks beside `block60`, balls 0.02 mm, beads and picks 0.1 px. A wrong number is a plan
that is a GO with an entry or end farther off than 1.5 times its stated 95 % bound; good input has one in 1,000. The
block carries CFCS: where it has moved, the true wire is where it lies from the block at the last image.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

import sightline as sl
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from benchmarks.solid.scenes import BEAD_PX, PICK_PX, block, c_arms
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.detection import Observations
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.planning import kind
from sightline.studies.scenes import WIRE_ENDS_MM, TargetScene, draw_scene, measure
from sightline.twin import SetUp
from sightline.twin.xray.distributions import beam_at
from sightline.twin.xray.setup import displaced, with_errors

SETUPS = 40  # of each case
# Centre of the head and tip of the lesser trochanter of an average right femur with that wire (twin/anatomy/femur.py).
LANDMARKS_MM = np.array([[-23.0, -23.5, 5.0], [-2.5, 38.5, -22.0]])
POINTS_MM = np.concatenate([WIRE_ENDS_MM, LANDMARKS_MM])
BALL_MM = 0.02
THIRD, OBLIQUE_DEG = "a third image at 45°", 45.0
AT_REST = RigidTransform.identity()
WRONG = 1.5  # times the stated 95 %
MOVED_MM, MOVED_RAD = 0.3, float(np.radians(0.2))
AXES = {"along the first beam": 2, "along the second beam": 0, "across both beams": 1}  # of CFCS
ENDS = ("refused", "NO-GO", "GO, right", "GO, wrong")

Given = tuple[list[Observations], Frame, RigidTransform]  # the transform takes the targets to CFCS at the last image
Fault = Callable[[np.random.Generator, TargetScene], Given]


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    number = SETUPS // 10 if quick else SETUPS
    ended = in_parallel(_ended, [(name, seed) for name in CASES for seed in range(number)])
    return [_row(name, ended[k * number : (k + 1) * number]) for k, name in enumerate(CASES)]


@dataclass(frozen=True)
class _End:
    """How a plan ended: one of ENDS; a check that failed, the type of a refusal, or ""."""

    end: str
    reason: str


def _ended(case: tuple[str, int]) -> _End:
    """Return how the plan of one set-up with a fault ended."""
    name, seed = case
    rng = np.random.default_rng([13, seed])  # the same set-ups for each case
    views = {view: beam_at(np.radians(angle)) for view, angle in _angles_deg(name).items()}
    drawn = draw_scene(rng, block(BALL_MM), BEAD_PX, targets=1, reach_mm=0.0, views=views)
    scene = TargetScene.of(drawn.setup, drawn.observations, drawn.setup.hip_mm + POINTS_MM)
    seen, frame, T_last_cfcs = CASES[name](rng, scene)
    uv = scene.target_px + PICK_PX * rng.standard_normal(scene.target_px.shape)
    try:
        calibrated = calibrate_together(seen, frame, c_arms(scene.setup)[: len(seen)])
        made = sl.plan(
            calibrated,
            uv[: len(seen), 0],
            uv[: len(seen), 1],
            pick_sd_px=PICK_PX,
            landmarks_uv_px=uv[: len(seen), 2:],
            kind=kind("free-wire"),
        )
    except SightlineError as refusal:
        return _End("refused", type(refusal).__name__)
    if not made.verdict.go:
        return _End("NO-GO", next(check.name for check in made.verdict.checks if not check.passed))
    wire = made.trajectory
    off = np.linalg.norm(np.array([wire.entry_mm, wire.end_mm]) - T_last_cfcs.apply(scene.target_mm[:2]), axis=1)
    right = (off <= WRONG * np.array([wire.entry_error_95_mm, wire.end_error_95_mm])).all()
    return _End("GO, right" if right else "GO, wrong", "")


def _row(name: str, ended: Sequence[_End]) -> Row:
    count = {end: sum(one.end == end for one in ended) for end in ENDS}
    reasons = [one.reason for one in ended if one.reason]
    most = max(sorted(set(reasons)), key=reasons.count) if reasons else ""
    value = ", ".join(f"{number} {end}" for end, number in count.items() if number)
    return Row("solid, bad input", name, value, "0 GO, wrong", f"mostly {most}" if most else "", not count["GO, wrong"])


def _seen(setup: SetUp, rng: np.random.Generator) -> list[Observations]:
    return list(measure(rng, setup, BEAD_PX).values())


def _angles_deg(name: str) -> dict[str, float]:
    """Return the beams of the images of a case."""
    two = {"pa": 0.0, "lateral": 5.0 if name == VIEWS_5_DEG else 90.0}
    return {**two, "oblique": OBLIQUE_DEG} if THIRD in name else two


def _good(_rng: np.random.Generator, scene: TargetScene) -> Given:
    return list(scene.observations.values()), scene.frame, AT_REST


def _in_one_view(_rng: np.random.Generator, scene: TargetScene) -> Given:
    return list(scene.observations.values())[:1], scene.frame, AT_REST


def _moved(
    rng: np.random.Generator,
    scene: TargetScene,
    before: int,
    shift_mm: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: Sequence[float] = (0.0, 0.0, 0.0),
) -> Given:
    """Return what is seen if the block moves before an image, in a direction or against it."""
    true, sign = scene.setup.true_frame, rng.choice([-1.0, 1.0])
    assert true.solid is not None
    moved = RigidTransform.from_components(sign * np.array(shift_mm), Rotation.from_rotvec(sign * np.array(rotation)))
    later = replace(scene.setup, true_frame=displaced(true, moved.apply(true.solid.xyz_mm) - true.solid.xyz_mm))
    seen = [*scene.observations.values()][:before] + _seen(later, rng)[before:]
    return seen, scene.frame, moved.inv()


def _mirrored(_rng: np.random.Generator, scene: TargetScene) -> Given:
    solid = scene.frame.solid
    assert solid is not None
    return list(scene.observations.values()), displaced(scene.frame, solid.xyz_mm * np.array([-2.0, 0.0, 0.0])), AT_REST


def _understated(rng: np.random.Generator, scene: TargetScene) -> Given:
    loose = replace(scene.setup, true_frame=with_errors(block(3 * BALL_MM), rng))
    return _seen(loose, rng), scene.frame, AT_REST


def _wrong_serial(rng: np.random.Generator, scene: TargetScene) -> Given:
    """Return the images of a block with the file of another one, both printed to 0.2 mm and measured."""
    printed = block(0.2)
    other = replace(scene.setup, true_frame=with_errors(printed, rng))
    return _seen(other, rng), replace(with_errors(printed, rng), tolerances=scene.frame.tolerances), AT_REST


def _two_exchanged(rng: np.random.Generator, scene: TargetScene) -> Given:
    first, second = scene.observations.values()
    ids, (a, b) = list(second.ids), rng.choice(len(second), 2, replace=False)
    ids[a], ids[b] = ids[b], ids[a]
    return [first, replace(second, ids=tuple(ids))], scene.frame, AT_REST


def _moves() -> dict[str, Fault]:
    """Return the cases of a block that moves between two images, or before the second or third of three."""
    out: dict[str, Fault] = {}
    for before, where in ((1, ""), (1, f", then {THIRD}"), (2, f" before {THIRD}")):
        for name, axis in AXES.items():
            shift, turn = MOVED_MM * np.eye(3)[axis], MOVED_RAD * np.eye(3)[axis]
            out[f"moved by {MOVED_MM} mm {name}{where}"] = partial(_moved, before=before, shift_mm=shift)
            out[f"turned by 0.2° about an axis {name}{where}"] = partial(_moved, before=before, rotation=turn)
    return out


VIEWS_5_DEG = "views 5° apart"
CASES: dict[str, Fault] = {
    "good input": _good,
    f"good input, {THIRD}": _good,
    "block in one view only": _in_one_view,
    **_moves(),
    "mirrored block": _mirrored,
    "balls' errors understated threefold": _understated,
    "file of another block": _wrong_serial,
    "two balls exchanged in one view": _two_exchanged,
    VIEWS_5_DEG: _good,
}
