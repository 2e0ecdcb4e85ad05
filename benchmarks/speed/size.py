"""Cost of `detect` against the image's size and the number of beads.

The images are balls of one radius in pixels on an even background, with Poisson noise and a detector's blur. Costs are
processor time of all threads, the smallest of several runs: another program's load hardly changes it.
"""

import time

import cv2
import numpy as np

import sightline as sl
from benchmarks.rows import Row

SIDES = (512, 724, 1024, 1448, 2048, 2896, 4096)
COUNTS = (50, 100, 200, 400)
SIDE, COUNT = 1024, 100  # of the images that vary in the other property
RADIUS_PX, DEPTH, QUANTA, BLUR_PX = 7.0, 3.0, 2000.0, 0.9
WHITE = 4095.0
REQUIRED_EXPONENT = 1.1  # of the cost over the pixels from 1024² on: linear, with a tenth for the machine's caches
RUNS = 8


def image_of(side: int, count: int) -> sl.Radiograph:
    """Return an image of `side` x `side` pixels with `count` balls at random places of a grid."""
    rng = np.random.default_rng([side, count])
    columns = int(np.ceil(np.sqrt(count)))
    pitch = side / columns
    places = rng.permutation(columns * columns)[:count]
    middle = np.stack([places % columns, places // columns], axis=1) * pitch + pitch / 2
    reach = int(RADIUS_PX) + 2
    light = np.full((side, side), QUANTA, np.float32)
    for u, v in middle + rng.uniform(-2, 2, middle.shape):
        left, top = int(u) - reach, int(v) - reach
        y, x = np.mgrid[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
        chord = np.sqrt(np.clip(1 - ((x - u) ** 2 + (y - v) ** 2) / RADIUS_PX**2, 0, None))
        light[y, x] *= 0.3 + 0.7 * np.exp(-DEPTH * chord)
    noisy = cv2.GaussianBlur(rng.poisson(light).astype(np.float32), (0, 0), BLUR_PX) * (0.6 * WHITE / QUANTA)
    return sl.Radiograph(np.clip(np.rint(noisy), 0, WHITE).astype(np.uint16), WHITE)


def run(quick: bool) -> list[Row]:
    """Return the rows of this part."""
    sides, runs = (SIDES[:3], 2) if quick else (SIDES, RUNS)
    by_side = np.array([_cost_ms(side, COUNT, runs) for side in sides])
    by_count = np.array([_cost_ms(SIDE, count, runs) for count in COUNTS])
    pixels = np.array(sides, dtype=float) ** 2
    large = pixels >= SIDE**2 if not quick else pixels > 0
    exponent = float(np.polyfit(np.log(pixels[large]), np.log(by_side[large]), 1)[0])
    per_bead = float(np.polyfit(COUNTS, by_count, 1)[0])
    group = "speed against size"
    return [
        Row(
            group,
            f"detect, {COUNT} beads on {' / '.join(map(str, sides))} px squared",
            f"{' / '.join(f'{ms:.0f}' for ms in by_side)} ms",
        ),
        Row(
            group,
            f"exponent of the cost over the pixels, from {SIDE} px squared on",
            f"{exponent:.2f}",
            f"<= {REQUIRED_EXPONENT:g}",
            "",
            None if quick else exponent <= REQUIRED_EXPONENT,
        ),
        Row(
            group,
            f"detect, {' / '.join(map(str, COUNTS))} beads on {SIDE} px squared",
            f"{' / '.join(f'{ms:.0f}' for ms in by_count)} ms",
        ),
        Row(group, "cost of one more bead", f"{per_bead:.2f} ms"),
    ]


def _cost_ms(side: int, count: int, runs: int) -> float:
    """Return the smallest processor time of `detect`, ms, over `runs` runs after a first one."""
    image = image_of(side, count)
    taken = []
    for _ in range(runs + 1):
        started = time.process_time()
        found = sl.detect(sl.Radiograph(image.pixels, image.white))
        taken.append(1e3 * (time.process_time() - started))
    if len(found) != count:
        print(f"{side} px squared: {len(found)} of {count} beads found")
    return min(taken[1:])
