"""The built-in solids: blocks of PMMA that carry their balls in one piece."""

from sightline.frame.plate import Fiducial, RigidBody

Place = tuple[float, float, float]

# Found by `python tools/design_block.py NAME`: ball centres 3.5 mm under a face, on whole millimetres along it [ours],
# at places whose shadows seldom overlap. Small block: 30 x 30 x 50 mm; cubes: 40, 60 and 120 mm. The shadows of the
# cube of 40 mm seldom overlap along its edges either: a small field leaves no choice of how it stands.
_BLOCK30_LARGE: tuple[Place, ...] = (
    (11.5, 9.0, 19.0), (-9.0, 9.0, 21.5), (-9.0, 11.5, 5.0), (8.0, -9.0, -21.5),
)  # fmt: skip
_BLOCK30_SMALL: tuple[Place, ...] = (
    (-11.5, -9.0, 13.0), (-9.0, -11.5, -19.0), (11.5, 0.0, -5.0), (9.0, -9.0, 21.5), (-11.5, -2.0, -2.0),
    (1.0, -11.5, 5.0), (-1.0, 11.5, -11.0), (-9.0, 9.0, -21.5),
)  # fmt: skip
_BLOCK40_LARGE: tuple[Place, ...] = (
    (6.0, -16.5, -12.0), (-1.0, -6.0, 16.5), (16.5, 1.0, -11.0), (16.5, 11.0, 4.0),
)  # fmt: skip
_BLOCK40_SMALL: tuple[Place, ...] = (
    (-3.0, 8.0, -16.5), (-16.5, -7.0, 1.0), (-16.5, -14.0, 7.0), (-12.0, -7.0, -16.5), (8.0, 16.5, 0.0),
    (-16.5, 13.0, -6.0), (16.5, -14.0, 14.0), (6.0, 6.0, 16.5), (-4.0, -16.5, -4.0), (-8.0, 16.5, -12.0),
)  # fmt: skip
_BLOCK60_LARGE: tuple[Place, ...] = (
    (20.0, 9.0, -26.5), (-16.0, -26.5, -24.0), (-26.5, 12.0, 10.0), (16.0, 24.0, 26.5), (26.5, -14.0, 22.0),
)  # fmt: skip
_BLOCK60_SMALL: tuple[Place, ...] = (
    (7.0, -26.5, 24.0), (26.5, -24.0, -13.0), (26.5, 24.0, -4.0), (-17.0, -9.0, 26.5), (-26.5, 1.0, -24.0),
    (9.0, 26.5, 9.0), (-4.0, 26.5, -24.0), (-24.0, 26.5, -13.0), (0.0, -5.0, -26.5), (-26.5, -24.0, 24.0),
    (-23.0, -26.5, 4.0),
)  # fmt: skip
_CUBE120_LARGE: tuple[Place, ...] = (
    (11.0, 17.0, 56.5), (-15.0, 56.5, -6.0), (-1.0, 56.5, -40.0), (45.0, -9.0, 56.5), (8.0, 56.5, 17.0),
    (-35.0, -56.5, -21.0), (-56.5, -7.0, 30.0), (30.0, 26.0, -56.5), (56.5, 34.0, 11.0), (0.0, -56.5, -12.0),
)  # fmt: skip
_CUBE120_SMALL: tuple[Place, ...] = (
    (-56.5, -49.0, -30.0), (-46.0, 6.0, -56.5), (-35.0, -56.5, 50.0), (56.5, -50.0, 34.0), (56.5, 5.0, 40.0),
    (-42.0, 56.5, 33.0), (56.5, -31.0, 4.0), (-29.0, 36.0, 56.5), (-56.5, 50.0, -42.0), (16.0, -45.0, -56.5),
    (56.5, 22.0, -25.0), (-4.0, -26.0, 56.5), (-45.0, 36.0, -56.5), (4.0, -56.5, 39.0), (56.5, -21.0, -48.0),
    (48.0, 56.5, 5.0), (-56.5, 21.0, 39.0), (-56.5, -10.0, -27.0), (-17.0, -29.0, -56.5), (37.0, -32.0, 56.5),
    (-56.5, -49.0, 21.0), (49.0, -56.5, -32.0),
)  # fmt: skip
LARGE_MM, SMALL_MM = 5.0, 3.0  # diameters, as on the plates: two sizes, so that a glance tells the orientation [ours]


def _solid(large: tuple[Place, ...], small: tuple[Place, ...]) -> RigidBody:
    sized = [(xyz, LARGE_MM) for xyz in large] + [(xyz, SMALL_MM) for xyz in small]
    return RigidBody(tuple(Fiducial(f"b{n}", xyz, diameter) for n, (xyz, diameter) in enumerate(sized, 1)))


SOLIDS = {
    "block30": _solid(_BLOCK30_LARGE, _BLOCK30_SMALL),
    "block40": _solid(_BLOCK40_LARGE, _BLOCK40_SMALL),
    "block60": _solid(_BLOCK60_LARGE, _BLOCK60_SMALL),
    "cube120": _solid(_CUBE120_LARGE, _CUBE120_SMALL),
}
