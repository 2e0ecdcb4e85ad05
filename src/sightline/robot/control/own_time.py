"""Time during which a loop itself ran. The silence of others is judged by it: a pause of the loop is not theirs."""

from sightline.robot.plant import CYCLE_S

# Of a pause no more counts than this, so that after it clients and drives have most of their time left to be heard
# [ours: four cycles, of the ten after which drives are missed].
LONGEST_S = 4 * CYCLE_S


class OwnTime:
    """Of one loop, `now_s` seconds since its first turn. `longest_s`: how much of a turn counts."""

    def __init__(self, longest_s: float = LONGEST_S) -> None:
        self.now_s = 0.0
        self._longest_s = longest_s
        self._turned_s: float | None = None

    def turn(self, now_s: float) -> float:
        """The loop turns, at `now_s` by its clock, which may leap. How much counts since its last turn, s."""
        passed = 0.0 if self._turned_s is None else min(max(now_s - self._turned_s, 0.0), self._longest_s)
        self._turned_s = now_s
        self.now_s += passed
        return passed
