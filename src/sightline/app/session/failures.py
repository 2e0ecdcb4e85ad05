"""Messages for errors on a page."""

import traceback
from collections.abc import Callable

from sightline.app import texts
from sightline.errors import SightlineError


def sentence_of(error: Exception) -> str:
    """Return the message for an error: its own sentence, or for a defect that something in Sightline failed."""
    return str(error) if isinstance(error, SightlineError) else texts.BUG.format(kind=type(error).__name__)


def report(error: Exception) -> str:
    """Return the message for an error. A defect of Sightline is also printed with its traceback."""
    if not isinstance(error, SightlineError):
        traceback.print_exception(error)
    return sentence_of(error)


def failure_of(work: Callable[[], object]) -> str:
    """Run `work` and return the message of its error; empty if there was none."""
    try:
        work()
    except Exception as error:
        return report(error)
    return ""
