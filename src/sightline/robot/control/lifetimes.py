"""Expiry of targets: sending a target again does not extend its life."""

from collections import OrderedDict
from dataclasses import replace

from sightline.errors import RobotRefusedError
from sightline.robot.control.insertion import Insertion
from sightline.robot.kinematics.target import LIFETIME_S

MAX_PLANS = 256  # remembered; a robot sees a few in the ten minutes that one is valid [ours]


class Lifetimes:
    """Expiry times. A plan's runs from the first message with its identifier; a bare target expires with its
    registration."""

    def __init__(self) -> None:
        self._plans: OrderedDict[str, float] = OrderedDict()
        self._registration_s = 0.0

    def registered(self, now_s: float) -> None:
        """Start the lifetime of a registration just received: its images were taken before."""
        self._registration_s = now_s + LIFETIME_S

    def limit(self, insertion: Insertion, now_s: float) -> Insertion:
        """Return the insertion with its remaining lifetime. Raises RobotRefusedError if it has expired."""
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
        if len(self._plans) > MAX_PLANS:
            self._plans.popitem(last=False)
        return self._plans[plan]
