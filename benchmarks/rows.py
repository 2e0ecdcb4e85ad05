"""One line of the benchmark table."""

from dataclasses import dataclass


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
