"""What clients have yet to be told, in order: a stop is done once the joints stand, and what it ended comes after."""

from dataclasses import replace

from sightline.robot.contract import Code
from sightline.robot.control.requests import Outcome


class Outcomes:
    """Outcomes since the last `take`, and those of stops that are not done yet."""

    def __init__(self) -> None:
        self._due: list[Outcome] = []
        self._stops: list[Outcome] = []  # told once the joints stand
        self._after_stops: list[Outcome] = []

    @property
    def stopping(self) -> bool:
        """Whether a stop was obeyed and the joints were not seen to stand yet."""
        return bool(self._stops)

    def add(self, outcome: Outcome) -> None:
        """An outcome to be told at once."""
        self._due.append(outcome)

    def conclude(self, outcome: Outcome) -> None:
        """How a motion or a collision check ended; where a stop ended it, it is told after that stop."""
        (self._after_stops if self._stops else self._due).append(outcome)

    def stop(self, outcome: Outcome) -> None:
        """A stop that was obeyed: told when the joints stand."""
        self._stops.append(outcome)

    def stand(self) -> None:
        """The joints stand: stops are done."""
        self._due += self._stops + self._after_stops
        self._stops, self._after_stops = [], []

    def still_move(self, text: str) -> None:
        """The joints do not stand: stops have failed, and are told so by the next `stand`."""
        self._stops = [replace(stop, code=Code.HARDWARE, text=text) for stop in self._stops]

    def drop_stops(self, client: int) -> None:
        """The client is gone: its stops are not told."""
        self._stops = [stop for stop in self._stops if stop.client != client]

    def take(self) -> tuple[Outcome, ...]:
        """What there is to tell now, which is then forgotten here."""
        due, self._due = tuple(self._due), []
        return due
