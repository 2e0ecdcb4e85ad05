"""Until when targets may be drilled: a target that is sent again is as old as it was."""

from collections import OrderedDict
from dataclasses import replace

from sightline.errors import RobotRefusedError
from sightline.robot.control.insertion import Insertion
from sightline.robot.kinematics.target import LIFETIME_S

KEPT = 256  # plans: a robot sees a few in the ten minutes that one lives [ours]


class Lifetimes:
    """A plan lives as long as was said when its identifier first came; a bare target as long as its registration."""

    def __init__(self) -> None:
        self._plans: OrderedDict[str, float] = OrderedDict()
        self._registration_s = 0.0

    def registered(self, now_s: float) -> None:
        """A registration came: its images were taken before."""
        self._registration_s = now_s + LIFETIME_S

    def limit(self, insertion: Insertion, now_s: float) -> Insertion:
        """The insertion with the time that it has left. Raises RobotRefusedError where that has passed."""
        if insertion.identity is None:
            expires, what, new = self._registration_s, "the registration of this target", "register again"
        else:
            plan = insertion.identity.plan
            expires = self._remembered(plan, insertion.expires_s)
            what, new = f"the plan {plan[:40]!r}, sent before,", "plan again under an identifier of its own"
        if now_s > expires:
            raise RobotRefusedError(f"{what} has expired; take new images and {new}")
        return replace(insertion, expires_s=min(insertion.expires_s, expires))

    def _remembered(self, plan: str, expires_s: float) -> float:
        self._plans[plan] = min(self._plans.get(plan, expires_s), expires_s)
        self._plans.move_to_end(plan)
        if len(self._plans) > KEPT:
            self._plans.popitem(last=False)
        return self._plans[plan]
