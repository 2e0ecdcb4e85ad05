"""Messages for errors on a page."""

import traceback
from collections.abc import Callable

from sightline.app import texts
from sightline.errors import RobotRefusedError, SightlineError


def sentence_of(error: Exception) -> str:
    """Return the message for an error: its own sentence, of a robot's refusal the reason without codes, or for a defect
    that something in Sightline failed."""
    if isinstance(error, RobotRefusedError) and error.reason:
        return f"The robot refused: {error.reason}."
    return (
        texts.titled(str(error))
        if isinstance(error, SightlineError)
        else (
            "Reload the page and report this: something in Sightline failed "
            f"({type(error).__name__}). The plan is unchanged."
        )
    )


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
