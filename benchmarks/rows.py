"""One line of the benchmark table."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """A measured figure beside what is asked of it and what a peer reaches in the same run.

    `met` is None where nothing is asked: the figure is printed for the reader.
    """

    group: str
    name: str
    figure: str
    asked: str = ""
    peer: str = ""
    met: bool | None = None
