"""A clock that counts only the time in which its loop ran: a pause of the loop must not count as a peer's silence."""

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
