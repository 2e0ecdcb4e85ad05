"""Labelling of plates and of solids in random scenes of points: shares labelled, wrong and refused."""

from benchmarks.labelling import plates, solids
from benchmarks.rows import Row


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return [row for part in (plates, solids) for row in part.run(quick)]
