"""The steps of a procedure, and the next mark to place. The mark is derived from the decisions, so that undo also goes
back to it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from sightline.app.plan.decisions import Decisions, Pixel
from sightline.app.plan.marks import GUIDE, MarkSpec
from sightline.app.session.session import Session
from sightline.case.views import CHECK_NAMES, NAMES, OBLIQUE, SHOT_NAMES
from sightline.planning.check.shot import ALIGNED
from sightline.planning.procedures import kind as kind_of
from sightline.planning.procedures.document import CHECKS
from sightline.planning.verdict.plan_checks import MIN_FREE_POINTS


class ProcedureStep(StrEnum):
    """A step, in their order. The value is its key in the texts, in the page's address and in test hooks."""

    IMAGES = "images"
    CALIBRATE = "calibrate"
    PLAN = "plan"
    DRILL = "drill"
    VERIFY = "verify"

    @property
    def number(self) -> int:
        """Its number, from 1."""
        return list(ProcedureStep).index(self) + 1


_BY_POINT = ("landmark", "bone")  # groups whose marks are placed point by point, each in all images


@dataclass(frozen=True)
class Goal:
    """A mark to place in an image: reached once it differs from `before`; None: not placed."""

    spec: MarkSpec
    image: str
    before: Pixel | None = None

    def reached(self, decisions: Decisions) -> bool:
        """Return True once it is placed."""
        return decisions.mark(self.spec.name).at(self.image) != self.before


class Placing:
    """The goals of one page: those that the person chose, or else those of the step."""

    def __init__(self, session: Session) -> None:
        self._planning, self._shots, self._bone = session.planning, session.shots, session.bone
        self._chosen: tuple[Goal, ...] | None = None  # None: the goals of the step
        self.skipped: tuple[MarkSpec, ...] = ()

    def goal(self, step: ProcedureStep) -> Goal | None:
        """Return the next goal; None if there is none."""
        return next((goal for goal in self._wanted(step) if not goal.reached(self._planning.decisions)), None)

    def progress(self, step: ProcedureStep) -> tuple[int, int]:
        """Return the number of the next goal, from 1, and the number of all."""
        wanted, goal = self._wanted(step), self.goal(step)
        return (len(wanted) if goal is None else wanted.index(goal) + 1), len(wanted)

    def optional(self, step: ProcedureStep) -> MarkSpec | None:
        """Return the mark of the next goal, if the step's plan can do without it: a landmark that leaves enough
        others, and that nothing is measured from."""
        goal = self.goal(step)
        if goal is None or self._chosen is not None or step is not ProcedureStep.PLAN:
            return None
        landmarks = [spec for spec in self._asked if spec.group == "landmark"]
        spare = goal.spec in landmarks and len(landmarks) > MIN_FREE_POINTS
        return goal.spec if spare and goal.spec.of not in _measured_from(self._planning.decisions.kind) else None

    def skip(self, step: ProcedureStep) -> None:
        """Ask no more for the mark of the next goal, if it is optional."""
        spec = self.optional(step)
        self.skipped = self.skipped if spec is None else (*self.skipped, spec)

    @property
    def _asked(self) -> list[MarkSpec]:
        return [spec for spec in self._planning.asked if spec not in self.skipped]

    def _wanted(self, step: ProcedureStep) -> tuple[Goal, ...]:
        return self._requested_by(step) if self._chosen is None else self._chosen

    def choose(self, listed: Sequence[MarkSpec], images: tuple[str, ...]) -> None:
        """Ask for these marks that are not placed; if all are, ask for the first one again."""
        goals, decisions = _goals(listed, images), self._planning.decisions
        if all(goal.reached(decisions) for goal in goals):
            first = goals[0]
            goals = (replace(first, before=decisions.mark(first.spec.name).at(first.image)),)
        self._chosen = goals

    def cancel(self) -> None:
        """Ask for nothing."""
        self._chosen = ()

    def begin_step(self) -> None:
        """Return to the goals of the step."""
        self._chosen = None

    def _requested_by(self, step: ProcedureStep) -> tuple[Goal, ...]:
        planning = self._planning
        if step is ProcedureStep.VERIFY and planning.views(CHECK_NAMES) is not None:
            return _goals(planning.landmarks, CHECK_NAMES)
        if step is ProcedureStep.DRILL and self._shots.shown and planning.views(SHOT_NAMES) is not None:
            guide = GUIDE if self._shots.shown == ALIGNED else ()
            return _goals([*guide, *planning.landmarks], SHOT_NAMES)
        if step is ProcedureStep.CALIBRATE and planning.views() is not None:
            return _goals(self._bone.asked, NAMES)
        if step is ProcedureStep.PLAN and planning.planned is not None and not planning.lacking:
            pair = _goals(self._asked, NAMES)
            third = [spec for spec in self._asked if spec.group == "landmark" and OBLIQUE in planning.names]
            return (*pair, *_goals(third, (OBLIQUE,)))
        return ()


def _measured_from(kind: str) -> set[str]:
    """Return the keys of the landmarks and aids that a procedure's checks and directions are made of."""
    known = kind_of(kind)
    checks = (key for rule in known.checks for keys in CHECKS[rule.check].needs for key in keys)
    directions = (key for one in known.document.directions for key in (*one.from_, *one.to))
    return {*checks, *directions}


def _goals(listed: Iterable[MarkSpec], images: tuple[str, ...]) -> tuple[Goal, ...]:
    """Return the goals in order: wire and aids image by image, first PA, then lateral; then each landmark in all; last
    the robot's own wire, which no verdict needs."""
    listed = tuple(listed)
    each = [Goal(a, image) for image in images for a in listed if a.group not in _BY_POINT and a.shown_in(image)]
    landmarks = [Goal(a, image) for a in listed if a.group in _BY_POINT for image in images]
    last = [goal for goal in each if goal.spec.group == "robot"]
    return (*(goal for goal in each if goal not in last), *landmarks, *last)
