"""One line of the benchmark table."""

from dataclasses import dataclass
from typing import TypeVar

Result = TypeVar("Result")


@dataclass(frozen=True)
class Row:
    """A measured value next to the required one and to that of a peer in the same run.

    `met` is None where nothing is required: the value is for information.
    """

    group: str
    name: str
    value: str
    required: str = ""
    peer: str = ""
    met: bool | None = None


def finished(group: str, trials: "list[Result | str]") -> "tuple[list[Result], list[Row]]":
    """Return the results of trials, and the row that counts the refused ones; prints the reasons of those."""
    done = [trial for trial in trials if not isinstance(trial, str)]
    for reason in (trial for trial in trials if isinstance(trial, str)):
        print(f"refused: {reason}")
    return done, [Row(group, "set-ups refused", f"{len(trials) - len(done)} of {len(trials)}")]
