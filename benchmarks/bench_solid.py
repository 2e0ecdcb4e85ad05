"""Solids of balls beside Γ, DLT with bundle adjustment, OpenCV and the bound: points, rendered
images, images of another projector, and bad input."""

from benchmarks.rows import Row
from benchmarks.solid import faults, gvxr, images, plate, points


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return [row for part in (points, plate, images, gvxr, faults) for row in part.run(quick)]
