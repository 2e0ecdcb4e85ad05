"""How far a plan lies within the limits of each check of its bone, in the check's own stated 95 % error."""

from dataclasses import dataclass, replace

import numpy as np

from sightline.geometry.covariance import TWO_SIDED_95, response
from sightline.planning import Anatomy, Plan
from sightline.planning.bone.metrics import metric
from sightline.planning.procedures.rules import CHECKS, CheckRule
from sightline.planning.verdict.bone_checks import MEASURES, measures
from sightline.planning.verdict.view_directions import Located


@dataclass(frozen=True, eq=False)
class KnownBone:
    """What a plan knows of the bone and the wire.

    `marks_mm` (3L,): named landmarks, in the order of `names`; `covariance` (n + 3L, n + 3L), mm², of `found.values`
    and these. The errors of a landmark and of an aid are taken as independent.
    """

    found: Anatomy
    side: str
    names: tuple[str, ...]
    marks_mm: np.ndarray
    covariance: np.ndarray
    lying: Located

    @staticmethod
    def of(made: Plan) -> "KnownBone":
        """Return what a plan with a side, drawn aids and stated errors knows."""
        found, joint = made.anatomy, made.seen.joint_covariance_mm2
        assert found is not None and found.covariance is not None and joint is not None and made.side is not None  # noqa: S101
        n, marks = len(found.values), made.seen.xyz_mm[2:].ravel()
        covariance = np.zeros((n + len(marks),) * 2)
        covariance[:n, :n], covariance[n:, n:] = found.covariance, joint[6:, 6:]
        covariance[found.at["wire"], n:] = joint[:6, 6:]
        covariance[n:, found.at["wire"]] = joint[6:, :6]
        lying = Located(made.kind, made.views, found, made.landmark_names, made.side)
        return KnownBone(found, made.side, made.landmark_names, marks, covariance, lying)

    def _by_bone(self, rule: CheckRule) -> tuple[float, float] | None:
        """Return how far the value of a check that `Located` makes lies beyond its limit, and its 95 % error."""
        lying = replace(self.lying, anatomy=self.found)
        if rule.check == "view directions":
            if lying.unknown_directions:
                return -np.inf, np.nan
            worst = lying.worst_view()
            return worst.away_deg - worst.wanted.within_deg, worst.error_deg
        if rule.check == "side" and len(lying.procedure.document.directions) == 3:
            value, error = (np.inf, np.nan) if lying.unknown_side else lying.beside()
            return -value, error
        return None

    def with_wire(self, wire_mm: np.ndarray) -> "KnownBone":
        """Return the same bone with another wire (2, 3), CFCS."""
        values = self.found.values.copy()
        values[self.found.at["wire"]] = wire_mm.ravel()
        return replace(self, found=replace(self.found, values=values))

    def beyond(self, rule: CheckRule) -> float:
        """Return how far the value of a check lies beyond its limits: negative inside, -inf where it is not made."""
        if (by_bone := self._by_bone(rule)) is not None:
            return by_bone[0]
        if rule.check not in MEASURES:
            value = metric(self.found, rule.check, self.side).value
            return -np.inf if value is None else _beyond(value, rule)
        marks = dict(zip(self.names, self.marks_mm.reshape(-1, 3), strict=True))
        entry, end = self.found.part("wire").reshape(2, 1, 3)
        made = measures(self.found, (rule,), self.side, marks)
        return max((_beyond(float(one.value(entry, end)[0]), rule) for one in made), default=-np.inf)

    def error_95(self, rule: CheckRule) -> float:
        """Return the 95 % error of the value of a check."""
        if (by_bone := self._by_bone(rule)) is not None:
            return by_bone[1]
        if rule.check not in MEASURES:
            sd = metric(self.found, rule.check, self.side).sd
            return np.nan if sd is None else TWO_SIDED_95 * sd
        n = len(self.found.values)
        at = np.concatenate([self.found.values, self.marks_mm])
        unused = {k for part in ("neck", "outline") if part in self.found.at for k in range(n)[self.found.at[part]]}
        used = [k for k in range(len(at)) if k not in unused]

        def of(rows: np.ndarray) -> np.ndarray:
            whole = np.tile(at, (len(rows), 1))
            whole[:, used] = rows
            bones = [replace(self, found=replace(self.found, values=one[:n]), marks_mm=one[n:]) for one in whole]
            return np.array([[bone.beyond(rule)] for bone in bones])

        _, own = response(of, at[used])
        return TWO_SIDED_95 * float(np.sqrt(own[0] @ self.covariance[np.ix_(used, used)] @ own[0]))

    def times_beyond(self, rule: CheckRule) -> float:
        """Return `beyond` in units of its 95 % error."""
        beyond = self.beyond(rule)
        return beyond / self.error_95(rule) if np.isfinite(beyond) else beyond


def _beyond(value: float, rule: CheckRule) -> float:
    """Return how far a value lies beyond the limits of a rule; those without limits are of values above zero."""
    low, high = rule.range if CHECKS[rule.check].limits else (0.0, np.inf)
    return max(low - value, value - high)
