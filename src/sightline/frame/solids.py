"""The built-in solids: blocks of PMMA that carry their balls in one piece."""

from collections.abc import Callable

from sightline.frame.plate import Fiducial, RigidBody

Place = tuple[float, float, float]

# Ball centres lie 3.5 mm under a face of the 60 mm cube, on whole millimetres [ours]; by a search for places whose
# shadows seldom overlap: from 400 directions 15 of the 16 balls are clear on average.
_BLOCK60_LARGE: tuple[Place, ...] = (
    (20.0, 9.0, -26.5), (-16.0, -26.5, -24.0), (-26.5, 12.0, 10.0), (16.0, 24.0, 26.5), (26.5, -14.0, 22.0),
)  # fmt: skip
_BLOCK60_SMALL: tuple[Place, ...] = (
    (7.0, -26.5, 24.0), (26.5, -24.0, -13.0), (26.5, 24.0, -4.0), (-17.0, -9.0, 26.5), (-26.5, 1.0, -24.0),
    (9.0, 26.5, 9.0), (-4.0, 26.5, -24.0), (-24.0, 26.5, -13.0), (0.0, -5.0, -26.5), (-26.5, -24.0, 24.0),
    (-23.0, -26.5, 4.0),
)  # fmt: skip
LARGE_MM, SMALL_MM = 5.0, 3.0  # diameters, as on the plates: two sizes, so that a glance tells the orientation [ours]


def block60() -> RigidBody:
    """Return the 60 mm cube of 16 balls, centred at the origin."""
    return _solid(_BLOCK60_LARGE, _BLOCK60_SMALL)


def _solid(large: tuple[Place, ...], small: tuple[Place, ...]) -> RigidBody:
    sized = [(xyz, LARGE_MM) for xyz in large] + [(xyz, SMALL_MM) for xyz in small]
    return RigidBody(tuple(Fiducial(f"b{n}", xyz, diameter) for n, (xyz, diameter) in enumerate(sized, 1)))


SOLIDS: dict[str, Callable[[], RigidBody]] = {"block60": block60}
