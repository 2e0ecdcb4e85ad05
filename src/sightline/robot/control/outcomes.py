"""Queue of outcomes for clients. A stop is done once the joints stand still; what it ended is reported after it."""

from dataclasses import replace

from sightline.robot.contract import Code
from sightline.robot.control.requests import Outcome


class Outcomes:
    """Outcomes since the last `take`, and stops that are not done yet."""

    def __init__(self) -> None:
        self._due: list[Outcome] = []
        self._stops: list[Outcome] = []  # reported once the joints stand still
        self._after_stops: list[Outcome] = []

    @property
    def stopping(self) -> bool:
        """Whether a stop was obeyed and the joints have not yet come to rest."""
        return bool(self._stops)

    def add(self, outcome: Outcome) -> None:
        """Queue an outcome for immediate report."""
        self._due.append(outcome)

    def conclude(self, outcome: Outcome) -> None:
        """Queue the outcome of a motion or a collision check; if a stop ended it, after that stop."""
        (self._after_stops if self._stops else self._due).append(outcome)

    def stop(self, outcome: Outcome) -> None:
        """Queue a stop that was obeyed, to be reported when the joints stand still."""
        self._stops.append(outcome)

    def stand(self) -> None:
        """The joints stand still: release the stops and what they ended."""
        self._due += self._stops + self._after_stops
        self._stops, self._after_stops = [], []

    def still_move(self, text: str) -> None:
        """The joints still move: turn the stops into failures, which the next `stand` releases."""
        self._stops = [replace(stop, code=Code.HARDWARE, text=text) for stop in self._stops]

    def drop_stops(self, client: int) -> None:
        """Drop the stops of a client that is gone."""
        self._stops = [stop for stop in self._stops if stop.client != client]

    def take(self) -> tuple[Outcome, ...]:
        """Return and remove the outcomes that are due."""
        due, self._due = tuple(self._due), []
        return due
