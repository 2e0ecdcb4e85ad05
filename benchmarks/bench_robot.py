"""The simulated robot: its loop, its stop, its link beside pyigtl, its kinematics, and break-throughs of its wire."""

from benchmarks.robot import control, link, manipulator, supervision
from benchmarks.rows import Row


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return [row for part in (control, link, supervision, manipulator) for row in part.run(quick)]
