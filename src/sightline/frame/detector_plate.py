"""The built-in plate on the detector of an image intensifier: it shows the distortion beside a solid."""

from sightline.frame.plate import Fiducial, Plate

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
