"""Bead centres in real and hard simulated images, beside OpenCV, trackpy and the Cramér-Rao bound; the second look."""

from benchmarks.detection import against_bound, real_images, second_look
from benchmarks.rows import Row


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return [row for part in (real_images, against_bound, second_look) for row in part.run(quick)]
