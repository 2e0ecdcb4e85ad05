"""Relations between the wires of a procedure, judged with the joint error of all wires.

Errors that the wires share cancel in a relation: two wires are more nearly parallel than each direction is accurate.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sightline.common.checks import Check, at_most
from sightline.common.geometry.covariance import joined, length_quantile, response
from sightline.common.geometry.lines import across, unit
from sightline.errors import RobotRefusedError
from sightline.planning.bone.directions import ANTERIOR, caudal, lies
from sightline.planning.bone.drawings import Axis
from sightline.planning.points.results import SpacePoints, Verdict, error_unknown
from sightline.planning.procedures.document import Relation

# Probability that errors alone make a relation hold; divided among its pairs of wires, or the sides of its triangle.
_RISK = 0.05


@dataclass(frozen=True, eq=False)
class WireLines:
    """N wires in space, CFCS, by their keys, with their joint covariance.

    `ends_mm` (N, 2, 3): entry and end of each; `joint_covariance_mm2` (6N, 6N), None where an error is unknown.
    """

    keys: tuple[str, ...]
    ends_mm: np.ndarray
    joint_covariance_mm2: np.ndarray | None

    @staticmethod
    def of(keys: Sequence[str], points: SpacePoints | None, placed: Mapping[str, Axis]) -> "WireLines":
        """Return wires of these images, whose `points` are (entry, end) of each of `keys`, and wires that are `placed`
        already, as other images or a hole's rims measured them.

        The errors of the latter are taken to be independent of the others'.
        """
        planned = [] if points is None else [points.xyz_mm]
        covariances = [] if points is None else [points.joint_covariance_mm2]
        covariances += [wire.covariance_mm2 for wire in placed.values()]
        known = [covariance for covariance in covariances if covariance is not None]
        all_known = len(known) == len(covariances)
        return WireLines(
            (*keys, *placed),
            np.concatenate([*planned, *(wire.ends_mm for wire in placed.values())]).reshape(-1, 2, 3),
            joined(known, lambda i, j: np.zeros((len(known[i]), len(known[j])))) if all_known else None,
        )

    def places(self, keys: Sequence[str]) -> list[int]:
        """Return the places of those of these wires that are known."""
        return [self.keys.index(key) for key in keys if key in self.keys]

    def linear(self, function: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return a value (m,) of the wires and its covariance (m, m); `function` maps (K, N, 2, 3) to (K, m).

        Raises ErrorUnknownError.
        """
        if self.joint_covariance_mm2 is None:
            raise error_unknown()
        shape = self.ends_mm.shape
        value, own = response(lambda flat: function(flat.reshape(-1, *shape)), self.ends_mm.ravel())
        return value, own @ self.joint_covariance_mm2 @ own.T


def judge_relations(
    relations: Sequence[Relation],
    wires: WireLines,
    names: Mapping[str, str],
    side: str | None,
    lacks: str = "is not planned",
) -> Verdict:
    """Return a check for each relation of geometry.

    `names`: of all wires of the procedure, by key. A relation with a missing wire is judged for the others: it fails
    where they break it, and otherwise it cannot be made; `lacks`: why it is missing. Raises UnusableInputError for an
    unknown side.
    """
    checks = []
    for relation in relations:
        name = relation.relation
        if name == "order":
            continue
        lacking = [f"the {names[key]} {lacks}" for key in relation.wires if key not in wires.keys]
        lacking += ["the side is not given"] if name == "inverted triangle" and side is None else []
        if wires.joint_covariance_mm2 is None:
            sentence = f"The relation '{name}' cannot be judged: the error of a view is not stated."
            checks.append(Check(name, False, None, None, "", sentence))
            continue
        check = _JUDGES[name](relation, wires, names, side)
        if check is None or (lacking and check.passed):
            sentence = f"The relation '{name}' cannot be judged yet: {', '.join(lacking)}."
            check = Check(name, False, None, None, "", sentence, missing=True)
        checks.append(check)
    return Verdict(tuple(checks))


def refuse_unrelated(unchecked: Sequence[str] | None) -> None:
    """Raise RobotRefusedError where relations of a wire to the procedure's others were not checked.

    `unchecked`: their names; None where a plan does not state them.
    """
    if unchecked is None or unchecked:
        which = "the plan does not state whether its" if unchecked is None else f"the {' and '.join(unchecked)}"
        raise RobotRefusedError(
            f"this is one wire of several: {which} relations to the others were {'' if unchecked is None else 'not '}"
            "checked; plan all wires together, or name those that are in the bone in in_bone of the file of picks"
        )


def angle_rad(ends_mm: np.ndarray, first: int, second: int) -> np.ndarray:
    """Return the angles (K,) between the directions of two wires of `ends_mm` (K, N, 2, 3)."""
    a, b = (_directions(ends_mm)[:, k] for k in (first, second))
    return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def spacing_mm(ends_mm: np.ndarray, first: int, second: int) -> np.ndarray:
    """Return the distances (K,) of two wires of `ends_mm` (K, N, 2, 3) at their entries, perpendicular to the wires."""
    along = _mean_direction(ends_mm[:, [first, second]])
    return np.linalg.norm(across(ends_mm[:, second, 0] - ends_mm[:, first, 0], along), axis=-1)


def across_axes(along: np.ndarray, cranial: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors (K, 3) across wires along `along` (K, 3): upwards, and from there to the front."""
    above = unit(across(cranial, along))
    return above, unit(across(across(ANTERIOR, along), above))


def _directions(ends_mm: np.ndarray) -> np.ndarray:
    return unit(ends_mm[..., 1, :] - ends_mm[..., 0, :])


def _mean_direction(ends_mm: np.ndarray) -> np.ndarray:
    """Return the mean direction (K, 3) of wires (K, N, 2, 3), whose entry and end may be exchanged."""
    along = _directions(ends_mm)
    opposite = (along * along[:, :1]).sum(axis=-1, keepdims=True) < 0.0
    return unit(np.where(opposite, -along, along).sum(axis=1))


def _parallel(relation: Relation, wires: WireLines, names: Mapping[str, str], side: str | None) -> Check | None:
    """Return the check of the pair of wires with the largest bound of its angle; None for fewer than two wires."""
    pairs, high, angles = list(combinations(wires.places(relation.wires), 2)), relation.high or 0.0, {}
    for a, b in pairs:
        # The difference of two directions; its length is the angle, where that is small.
        _, covariance = wires.linear(lambda ends, a=a, b=b: _directions(ends[:, b]) - _directions(ends[:, a]))
        value, error = angle_rad(wires.ends_mm[None], a, b)[0], length_quantile(covariance, 1 - _RISK / len(pairs))
        angles[a, b] = float(np.rad2deg(value + error)), float(np.rad2deg(value))
    if not angles:
        return None
    worst = max(angles, key=lambda pair: angles[pair])
    bound, value = angles[worst]
    states = f"Between {_both(wires, worst, names)} the angle is {value:.2f}°, with 95 % probability below {bound:.2f}°"
    otherwise = f"; it must be below {high:g}°: move the end point of one of them."
    return at_most("parallel", bound, high, "°", states, otherwise=otherwise)


def _spacing(relation: Relation, wires: WireLines, names: Mapping[str, str], side: str | None) -> Check | None:
    """Return the check of the pair of wires with the smallest margin; None for fewer than two wires."""
    pairs, margins = list(combinations(wires.places(relation.wires), 2)), []
    low, high = relation.low or 0.0, relation.high or 0.0
    for a, b in pairs:
        (value,), variance = wires.linear(lambda ends, a=a, b=b: spacing_mm(ends, a, b)[:, None])
        error = length_quantile(variance, 1 - _RISK / len(pairs))
        least, most = max(float(value - error), 0.0), float(value + error)
        margins += [(least - low, least, low, value, error, (a, b)), (high - most, most, high, value, error, (a, b))]
    if not margins:
        return None
    margin, figure, limit, value, error, worst = min(margins)
    sentence = (
        f"Between {_both(wires, worst, names)} the distance at the entries is {value:.1f} mm, with 95 % probability "
        f"within {error:.1f} mm"
    )
    sentence += "." if margin >= 0.0 else f"; with its error it must lie between {low:g} and {high:g} mm: move a wire."
    return Check("spacing", margin >= 0.0, figure, limit, "mm", sentence)


def _triangle(relation: Relation, wires: WireLines, names: Mapping[str, str], side: str | None) -> Check | None:
    """Return the check of an inverted triangle: the first wire below the others, the second in front, the third behind.

    None without the side, or for fewer than two wires with the first.
    """
    keys, known = relation.wires, wires.places(relation.wires)
    if side is None or keys[0] not in wires.keys or len(known) < 2:
        return None
    ahead = np.array([1.0 if wires.keys[k] == keys[1] else -1.0 for k in known[1:]])
    cranial = -caudal(side)

    def margins(ends: np.ndarray) -> np.ndarray:
        """Return how far each other wire lies above the first, and on its own side of it, seen along the wires."""
        above, front = across_axes(_mean_direction(ends[:, known]), cranial)
        off = ends[:, known[1:], 0] - ends[:, known[:1], 0]
        return np.concatenate([(off * above[:, None]).sum(-1), ahead * (off * front[:, None]).sum(-1)], axis=1)

    values, covariance = wires.linear(margins)
    # Each margin can be wrong in one direction only, so its bound is that of twice the risk in both.
    errors = length_quantile(covariance.diagonal()[:, None, None], 1 - 2 * _RISK / len(values))
    worst = int(np.argmin(values - errors))
    least = float((values - errors)[worst])
    passed = least > 0.0
    other = known[1:][worst % len(ahead)]
    if worst < len(ahead):
        ways = ("above", "below")
    else:
        ways = ("in front of", "behind") if ahead[worst - len(ahead)] > 0 else ("behind", "in front of")
    sentence = (
        f"The {names[wires.keys[other]]} must lie {ways[0]} the {names[keys[0]]}: it lies "
        f"{lies(float(values[worst]), ways)} it, with 95 % probability within {errors[worst]:.1f} mm"
    )
    sentence += "." if passed else "; wires are exchanged, or the side is wrong, or they are too close: pick again."
    return Check("inverted triangle", passed, least, 0.0, "mm", sentence)


def _both(wires: WireLines, pair: tuple[int, int], names: Mapping[str, str]) -> str:
    first, second = (names[wires.keys[k]] for k in pair)
    return f"the {first} and the {second}"


_Judge = Callable[[Relation, WireLines, Mapping[str, str], str | None], Check | None]
_JUDGES: Mapping[str, _Judge] = {"parallel": _parallel, "spacing": _spacing, "inverted triangle": _triangle}
