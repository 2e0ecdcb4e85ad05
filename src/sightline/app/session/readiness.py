"""Whether a plan may be sent: planning's checks, the confirmations by a person, and the age of the images."""

from sightline.app.plan.planner import Planned
from sightline.app.session.age import PlanAge, is_fresh
from sightline.app.session.planning import Planning
from sightline.checks import Check
from sightline.planning.points.results import Verdict
from sightline.robot.kinematics.target import LIFETIME_S

NO_SERIAL = "none"  # what a person types where the frame has none


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
