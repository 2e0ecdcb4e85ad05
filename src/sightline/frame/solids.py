"""The built-in solids, blocks of PMMA that carry their balls in one piece, and the plate on the detector beside them.

That plate shows the distortion of an image intensifier.
"""

from sightline.frame.designs import BUILTIN
from sightline.frame.plate import Fiducial, Plate, RigidBody

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

STAND_OFF_MM = 20.0  # [ours] of the balls from the detector's input plane, towards the source
_ROWS, _PITCH_MM, _RADIUS_STEPS = 9, 22.0, 4.6  # [ours] 69 balls in a circle of 100 mm: a 9-inch field
_LARGE_MM, _SMALL_MM = 3.0, 2.0  # [ours] half the shadows of a block's balls: a glance tells them apart
# Places (row, column) of the datum markers. No two triples of them resemble each other (`patterns.resemblance`), and
# each half of the plate has three.
_DATUMS = ((1, 3), (1, 6), (3, 2), (6, 8), (9, 4), (9, 6))


def _plate() -> Plate:
    middle = (_ROWS + 1) / 2
    places = [(row, column) for row in range(1, _ROWS + 1) for column in range(1, _ROWS + 1)]
    within = [p for p in places if (p[0] - middle) ** 2 + (p[1] - middle) ** 2 <= _RADIUS_STEPS**2]
    return Plate(
        tuple(
            Fiducial(
                f"d-{row}-{column}",
                (_PITCH_MM * (column - middle), _PITCH_MM * (row - middle), STAND_OFF_MM),
                _LARGE_MM if (row, column) in _DATUMS else _SMALL_MM,
                (row, column) in _DATUMS,
            )
            for row, column in within
        )
    )


DETECTOR_PLATE = _plate()
WITH_PLATE = {f"{name}+detector-plate": name for name in ("block30", "block40", "block60")}  # each with its solid
FRAME_NAMES = (*BUILTIN, *SOLIDS, *WITH_PLATE)  # of all built-in frames
