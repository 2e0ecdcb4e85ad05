"""Answers to one connection's requests by identifier, so that a repeated request does not act again."""

from collections import OrderedDict
from dataclasses import dataclass

from sightline.robot.contract import Code
from sightline.robot.control.requests import Answer

MAX_ANSWERS = 256  # identifiers kept per connection: a repeat comes within a few messages of the first [ours]
_TEXT = 100  # characters of a request that are compared: no valid request is longer [ours]


@dataclass
class _Entry:
    text: str
    answer: Answer


class AnswerCache:
    """The newest requests of one connection with their answers, by identifier."""

    def __init__(self) -> None:
        self._entries: OrderedDict[str, _Entry] = OrderedDict()

    def earlier(self, identifier: str, text: str) -> Answer | None:
        """Return the answer to a repeated request, a refusal if the identifier belongs to another request, or None if
        it is new."""
        entry = self._entries.get(identifier)
        if entry is None:
            return None
        if entry.text == text[:_TEXT]:
            return entry.answer
        reason = f"{identifier[:20]} was {entry.text[:20]!r} before; give every request an identifier of its own"
        return Answer(Code.CONFIGURATION, reason)

    def put(self, identifier: str, text: str, answer: Answer) -> None:
        """Store a request with its answer."""
        self._entries[identifier] = _Entry(text[:_TEXT], answer)
        self._entries.move_to_end(identifier)
        if len(self._entries) > MAX_ANSWERS:
            self._entries.popitem(last=False)

    def ended(self, text: str, answer: Answer) -> None:
        """Replace the answer of the newest unfinished request of this text."""
        for entry in reversed(self._entries.values()):
            if entry.text == text and not entry.answer.done:
                entry.answer = answer
                return
