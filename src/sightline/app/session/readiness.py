"""Whether a plan may be sent: planning's checks, the confirmations by a person, and the age of the images, counted from
their acquisition, not from the arrival of their files."""

from datetime import UTC, datetime, timedelta
from math import isfinite
from time import monotonic

from sightline.app.plan.planner import Planned
from sightline.app.session.planning import Planning
from sightline.app.session.seen import SeenImage
from sightline.case.journal import Actor
from sightline.common.checks import Check
from sightline.errors import UnusableInputError
from sightline.planning.points.results import Verdict
from sightline.robot.contract import NO_SERIAL
from sightline.robot.kinematics.target import LIFETIME_S

_CLOCKS_APART = timedelta(seconds=5)  # tolerated between C-arm and this machine, both set by one time server [ours]
_MAX_AGO_MIN = 60 * 24 * 365  # [calc] a year: an older image is a slip of the keyboard


class PlanAge:
    """The age of the current plan."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self._first: dict[datetime, tuple[float, float]] = {}  # by image time: age at the first query, and its time

    def taken_at(self, seen: SeenImage) -> datetime | None:
        """Return when an image was taken: from its file, else as stated by a person; None if unknown. A file's time
        after its arrival is from a wrong clock and is ignored."""
        arrived, stated = seen.acquired.at, seen.taken_at
        if seen.acquired.by is Actor.DEMO:
            return arrived  # it was simulated just then
        if stated is not None and stated <= arrived + _CLOCKS_APART:
            return min(stated, arrived)
        return self._planning.decisions.taken.get(seen.acquired.number)

    def state_taken(self, image: str, minutes_ago: float) -> None:
        """Record a person's statement when an image was taken. Raises UnusableInputError."""
        planning = self._planning
        seen = planning.seen(image)
        if seen is None or not (isfinite(minutes_ago) and 0.0 <= minutes_ago <= _MAX_AGO_MIN):
            raise UnusableInputError("enter the minutes since the image was taken, 0 or more")
        at = datetime.now(UTC) - timedelta(minutes=minutes_ago)
        planning.decide(taken={**planning.decisions.taken, seen.acquired.number: at})

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
        known = [at for image in seen if image is not None and (at := self.taken_at(image)) is not None]
        return min(known) if len(known) == len(seen) else None


def is_fresh(age_s: float | None) -> bool:
    """Return True if images of this age are recent enough to act on; None: unknown age."""
    return age_s is not None and 0.0 <= age_s <= LIFETIME_S


class Readiness:
    """The verdict on the plan of a case."""

    def __init__(self, planning: Planning, age: PlanAge) -> None:
        self._planning, self._age = planning, age

    def verdict_of(self, known: Planned | None) -> Verdict | None:
        """Return the verdict on sending the plans of all wires; None without one."""
        verdict = None if known is None else known.verdict
        if verdict is None:
            return None
        return verdict.joined(Verdict(tuple(self.confirmations)))

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on the current plan; None without one."""
        return self.verdict_of(self._planning.planned)

    @property
    def go(self) -> bool:
        """True if all wires are planned, every check passed, and the patient has what the procedure is for."""
        verdict = self.verdict
        return verdict is not None and verdict.go and not self._planning.lacking

    @property
    def can_send(self) -> bool:
        """True if the plan is GO and its images are recent enough to act on, now."""
        return self.go and self._age.fresh

    @property
    def confirmations(self) -> list[Check]:
        """Checks of the confirmations by a person, and of the plan's age."""
        side, serial = self._planning.decisions.side, self._planning.decisions.serial
        known = self._planning.frame.serial
        drilled_s = self._age.drilled_s  # the age of a drilled plan no longer matters
        age_s = self._age.now_s if drilled_s is None else drilled_s
        fresh = is_fresh(age_s)
        return [
            Check(
                "side confirmed",
                side is not None,
                None,
                None,
                "",
                f"A person confirmed on the images that this is the {side} side."
                if side
                else "Look at both images and confirm the patient's side, on the step Images.",
                missing=side is None,
            ),
            Check(
                "frame confirmed",
                serial is not None and (known is None or serial == known),
                None,
                None,
                "",
                _serial_sentence(serial)
                if serial
                else "Read the serial on the frame that the robot holds and confirm it, on the step Images.",
                missing=serial is None,
            ),
            Check(
                "plan age",
                fresh,
                age_s,
                LIFETIME_S,
                "s",
                _age_sentence(age_s, fresh=fresh, drilled=drilled_s is not None),
            ),
        ]


def _serial_sentence(serial: str) -> str:
    if serial == NO_SERIAL:
        return "A person confirmed that the frame has no serial."
    return f"A person read the serial {serial} on the frame."


def _age_sentence(age_s: float | None, *, fresh: bool, drilled: bool) -> str:
    if age_s is None:
        return "It is not known when the images were taken: state it on the step Images, or take both again."
    if not fresh:
        return "The images are too old, or the clock was set back: the patient may have moved; take both again."
    if drilled:
        return "The images were recent enough when the plan was sent; the wire is drilled."
    return "The images are recent enough: the patient has not had long to move."
