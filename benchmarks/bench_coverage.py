"""How often the stated error ellipsoids contain the truth: independent set-ups as points, and rendered pairs."""

from benchmarks.coverage import images, points
from benchmarks.rows import Row


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return [row for part in (points, images) for row in part.run(quick)]
