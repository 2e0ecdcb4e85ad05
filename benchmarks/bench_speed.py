"""Time from an array to a calibrated view, of detection against the image's size, and of a dragged point's curve."""

from benchmarks.rows import Row
from benchmarks.speed import planning, size, view


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return [row for part in (view, size, planning) for row in part.run(quick)]
