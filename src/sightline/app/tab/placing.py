"""What a person wants to place next. It follows from the decisions, so that undo steps back in it too."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from sightline.app.plan.decisions import Decisions, Pixel
from sightline.app.plan.marks import CHECK_NAMES, Asked, asked_of
from sightline.app.session.planning import Planning
from sightline.app.texts import STEPS
from sightline.case.views import NAMES


@dataclass(frozen=True)
class Goal:
    """A mark to be placed in an image: reached once it is elsewhere than `before`, None for not placed at all."""

    asked: Asked
    image: str
    before: Pixel | None = None

    def reached(self, decisions: Decisions) -> bool:
        """Return True once it is placed."""
        return decisions.mark(self.asked.name).at(self.image) != self.before


class Placing:
    """The goals of one page: those that its person chose, or else those that its step asks for."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self._chosen: tuple[Goal, ...] | None = None  # None: what the step asks for

    def goal(self, step: str) -> Goal | None:
        """Return what is to be placed now; None where nothing is."""
        wanted = self._asked_by(step) if self._chosen is None else self._chosen
        return next((one for one in wanted if not one.reached(self._planning.decisions)), None)

    def choose(self, listed: Sequence[Asked], images: tuple[str, str]) -> None:
        """Ask for those of these marks that are not placed; where all are, for the first anew."""
        goals, decisions = _goals(listed, images), self._planning.decisions
        if all(one.reached(decisions) for one in goals):
            first = goals[0]
            goals = (replace(first, before=decisions.mark(first.asked.name).at(first.image)),)
        self._chosen = goals

    def cancel(self) -> None:
        """Ask for nothing."""
        self._chosen = ()

    def begin_step(self) -> None:
        """Ask for what the step asks for."""
        self._chosen = None

    def _asked_by(self, step: str) -> tuple[Goal, ...]:
        planning = self._planning
        asked = asked_of(planning.decisions.kind)
        if step == STEPS[4] and planning.views(CHECK_NAMES) is not None:
            return _goals([one for one in asked if one.group == "landmark"], CHECK_NAMES)
        if step == STEPS[2] and planning.planned is not None:
            return _goals([one for one in asked if one.group != "aid"], NAMES)
        return ()


def _goals(listed: Iterable[Asked], images: tuple[str, str]) -> tuple[Goal, ...]:
    """Wire and aids image by image, entry and end in the PA image, then both in the lateral one; landmarks one by one
    in both."""
    listed = tuple(listed)
    wire = [Goal(a, image) for image in images for a in listed if a.group != "landmark" and image in a.images]
    return (*wire, *(Goal(a, image) for a in listed if a.group == "landmark" for image in images))
