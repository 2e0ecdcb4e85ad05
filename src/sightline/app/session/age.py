"""Age of a plan's images, counted from their acquisition, not from the arrival of their files."""

from datetime import UTC, datetime, timedelta
from math import isfinite
from time import monotonic

from sightline.app.session.planning import Planning
from sightline.app.session.seen import SeenImage
from sightline.case.journal import Actor
from sightline.errors import UnusableInputError
from sightline.robot.kinematics.target import LIFETIME_S

_CLOCKS_APART = timedelta(seconds=5)  # tolerated between C-arm and this machine, both set by one time server [ours]
_MAX_AGO_MIN = 1e6  # two years [ours]


class PlanAge:
    """The age of the current plan."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self._first: dict[datetime, tuple[float, float]] = {}  # by image time: age at the first query, and its time

    def taken_at(self, seen: SeenImage) -> datetime | None:
        """Return when an image was taken: from its file, else as stated by a person; None if unknown. A file's time
        after its arrival is from a wrong clock and is ignored."""
        arrived, said = seen.acquired.at, seen.taken_at
        if seen.acquired.by is Actor.DEMO:
            return arrived  # it was simulated just then
        if said is not None and said <= arrived + _CLOCKS_APART:
            return min(said, arrived)
        return self._planning.decisions.taken.get(seen.acquired.number)

    def state_taken(self, image: str, minutes_ago: float) -> None:
        """Record a person's statement when an image was taken. Raises UnusableInputError."""
        planning = self._planning
        seen = planning.seen(image)
        if seen is None or not (isfinite(minutes_ago) and 0.0 <= minutes_ago <= _MAX_AGO_MIN):
            raise UnusableInputError("enter the minutes since the image was taken, 0 or more")
        at = datetime.now(UTC) - timedelta(minutes=minutes_ago)
        planning.edit(planning.decisions.with_taken(seen.acquired.number, at))

    @property
    def now_s(self) -> float | None:
        """Seconds since the oldest of the planning images was taken. None if unknown; negative if the clock was set
        back to before that. It keeps growing even if the clock is set back meanwhile."""
        at = self._imaged_at()
        if at is None:
            return None
        age = (datetime.now(UTC) - at).total_seconds()
        if age < 0.0:
            return age
        first, asked_s = self._first.setdefault(at, (age, monotonic()))
        return max(age, first + monotonic() - asked_s)

    @property
    def drilled_s(self) -> float | None:
        """Age of the images when the drilled plan was sent, s; None if the current plan was not drilled."""
        planning, at = self._planning, self._imaged_at()
        if planning.drilled is None or planning.sent is None or not planning.sent_is_current or at is None:
            return None
        return (planning.sent.at - at).total_seconds()

    @property
    def fresh(self) -> bool:
        """True while the images are recent enough to act on."""
        return is_fresh(self.now_s)

    def _imaged_at(self) -> datetime | None:
        """Return when the oldest planning image was taken; None if one is missing or its time is unknown."""
        seen = [self._planning.seen(name) for name in self._planning.names]
        known = [at for one in seen if one is not None and (at := self.taken_at(one)) is not None]
        return min(known) if len(known) == len(seen) else None


def is_fresh(age_s: float | None) -> bool:
    """Return True if images of this age are recent enough to act on; None: unknown age."""
    return age_s is not None and 0.0 <= age_s <= LIFETIME_S
