"""Time of the robot: the loop's clock, the command lease, and the expiry of targets.

The loop's clock counts only the time in which its loop ran: a pause must not count as a peer's silence.
"""

from collections import OrderedDict
from dataclasses import replace

from sightline.errors import RobotRefusedError
from sightline.robot.contract import MAX_KEPT, SILENCE_S
from sightline.robot.control.insertion import Insertion
from sightline.robot.kinematics.target import LIFETIME_S
from sightline.robot.plant import CYCLE_S

# At most this much of a pause counts, so that clients and drives keep most of their time to be heard after it [ours:
# four cycles, of the ten after which drives count as lost].
MAX_STEP_S = 4 * CYCLE_S


class LoopClock:
    """The clock of one loop. `now_s`: seconds since its first tick; `max_step_s`: the most that one tick may add."""

    def __init__(self, max_step_s: float = MAX_STEP_S) -> None:
        self.now_s = 0.0
        self._longest_s = max_step_s
        self._ticked_s: float | None = None

    def tick(self, now_s: float) -> float:
        """Advance to `now_s` of a clock that may jump. Returns the seconds counted since the last tick."""
        passed = 0.0 if self._ticked_s is None else min(max(now_s - self._ticked_s, 0.0), self._longest_s)
        self._ticked_s = now_s
        self.now_s += passed
        return passed


class Lease:
    """One client, by its number, may hold the lease. Only clients that announced heartbeats are watched for silence.

    `watches`: False in virtual time, which passes faster than a client's heartbeats can come.
    """

    def __init__(self) -> None:
        self.holder: int | None = None
        self.watches = True
        self._heard_s: dict[int, float] = {}

    def heard(self, client: int, now_s: float, heartbeat: bool) -> None:
        """Record a message: a `heartbeat`, their announcement, or one that counts only for clients that announced
        them."""
        if self.watches and (heartbeat or client in self._heard_s):
            self._heard_s[client] = now_s

    @property
    def unwatched(self) -> bool:
        """Whether the loss of the holder's network would be noticed only by TCP, after seconds."""
        return self.watches and self.holder not in self._heard_s

    def take(self, client: int) -> bool:
        """Acquire the lease if it is free. Returns whether this client holds it now."""
        if self.holder is None:
            self.holder = client
        return self.holder == client

    def left(self, client: int) -> bool:
        """Remove a client. Returns whether it held the lease, which is then free."""
        self._heard_s.pop(client, None)
        if client != self.holder:
            return False
        self.holder = None
        return True

    def silence(self, begun_s: float, now_s: float, unread_s: float) -> str | None:
        """Return why a motion that began at `begun_s` must end, or None.

        Either its client was silent for too long, not counting the last `unread_s` that may be unread; or the robot
        did not read its link for too long and would miss a stop."""
        heard_s = self._heard_s.get(-1 if self.holder is None else self.holder)
        if heard_s is not None and now_s - unread_s - max(heard_s, begun_s) > SILENCE_S:
            return f"the client was silent for {SILENCE_S:g} s"
        if min(unread_s, now_s - begun_s) > SILENCE_S:
            return f"the robot did not read its own link for {SILENCE_S:g} s: its computer is too busy"
        return None


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
            expires = self._plans[plan] = min(self._plans.get(plan, insertion.expires_s), insertion.expires_s)
            self._plans.move_to_end(plan)
            if len(self._plans) > MAX_KEPT:
                self._plans.popitem(last=False)
            what, new = f"the plan {plan[:40]!r}, sent before,", "plan again under an identifier of its own"
        if now_s > expires:
            raise RobotRefusedError(f"{what} has expired; take new images and {new}")
        return replace(insertion, expires_s=min(insertion.expires_s, expires))
