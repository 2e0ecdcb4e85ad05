"""Holes of a nail from two views, and drilled by the robot: error, coverage and refusals."""

from benchmarks.holes import drilled, measured
from benchmarks.rows import Row


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return [row for part in (measured, drilled) for row in part.run(quick)]
