"""What a page says of work that failed."""

import traceback
from collections.abc import Callable

from sightline.app.texts import BUG
from sightline.errors import SightlineError


def sentence_of(error: Exception) -> str:
    """Return what a page says of an error: its own sentence, or that something in Sightline failed."""
    return str(error) if isinstance(error, SightlineError) else BUG.format(kind=type(error).__name__)


def report(error: Exception) -> str:
    """Return the sentence of an error. A defect of Sightline is also printed, with its traceback."""
    if not isinstance(error, SightlineError):
        traceback.print_exception(error)
    return sentence_of(error)


def why_not(work: Callable[[], object]) -> str:
    """Do the work, and return why it could not be done; an empty string where it was."""
    try:
        work()
    except Exception as error:
        return report(error)
    return ""
