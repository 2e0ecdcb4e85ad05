"""What one connection has asked by identifiers, and how each was answered: asked again, nothing acts again."""

from collections import OrderedDict
from dataclasses import dataclass

from sightline.robot.contract import Code
from sightline.robot.control.requests import Answer

KEPT = 256  # identifiers of a connection: a repeat comes soon after its first, within a few messages [ours]
_TEXT = 100  # letters of what was asked: no request that does anything is longer [ours]


@dataclass
class _Entry:
    text: str
    answer: Answer


class Remembered:
    """The newest requests of one connection, by identifier."""

    def __init__(self) -> None:
        self._entries: OrderedDict[str, _Entry] = OrderedDict()

    def earlier(self, identifier: str, text: str) -> Answer | None:
        """The answer to a request that was made before, None where it is new; a refusal where the identifier was that
        of another."""
        entry = self._entries.get(identifier)
        if entry is None:
            return None
        if entry.text == text[:_TEXT]:
            return entry.answer
        reason = f"{identifier[:20]} was {entry.text[:20]!r} before; give every request an identifier of its own"
        return Answer(Code.CONFIGURATION, reason)

    def put(self, identifier: str, text: str, answer: Answer) -> None:
        """A request and its answer."""
        self._entries[identifier] = _Entry(text[:_TEXT], answer)
        self._entries.move_to_end(identifier)
        if len(self._entries) > KEPT:
            self._entries.popitem(last=False)

    def ended(self, text: str, answer: Answer) -> None:
        """How the newest request of this text ended that was not done yet."""
        for entry in reversed(self._entries.values()):
            if entry.text == text and not entry.answer.done:
                entry.answer = answer
                return
