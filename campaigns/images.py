"""Images damaged on their way from the C-arm: no plan with GO may be wrong.

Each base is a simulated patient with Γ or block, drawn once per process: by gVirtualXray where it is installed (`pip
install gvxr`), else by the twin. A damage changes one image or both, and states where the damaged image shows a point,
because the user clicks on what is visible.
"""

from collections.abc import Callable
from functools import lru_cache, partial

import cv2
import numpy as np
from benchmarks import gvxr
from scipy.special import expit

import sightline as sl
from campaigns.campaign import Campaign, Damage, Ended
from campaigns.person import Clicks, Shown, judged
from sightline.detection import Observations
from sightline.frame import Frame
from sightline.from_images.pipeline import label_beads, view_of
from sightline.imaging import Radiograph
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.studies.scenes import VIEWS

BASES, FIRST = 12, 1000  # patients, and the first one's seed; the same for every try
Picture = tuple[np.ndarray, Shown]  # pixels, 0 to 1, and the map from original to shown pixel coordinates
Spoil = Callable[[np.ndarray, np.random.Generator], Picture]


@lru_cache(maxsize=BASES)
def base(number: int) -> Rehearsal:
    """Return a patient with images; right and left hips alternate, and pairs of Γ and block."""
    frame = Frame.load(("gamma", "block60")[number // 2 % 2])
    patient = Rehearsal.draw(FIRST + number, frame, ("right", "left")[number % 2])
    if gvxr.INSTALLED:
        rng = np.random.default_rng([FIRST, number])
        parts = gvxr.hip_parts(patient.setup.true_frame, patient.hip.wire_mm)
        draw = gvxr.intensifier_image if frame.solid is None else gvxr.panel_image
        vars(patient)["images"] = {name: draw(patient.setup.views[name], parts, rng) for name in VIEWS}
    return patient


def read(pixels: np.ndarray, white: int = 65535) -> Radiograph:
    """Return a Radiograph with integers up to white, as a file stores them."""
    kind = np.uint8 if white == 255 else np.uint16
    return Radiograph(np.clip(np.rint(pixels * white), 0, white).astype(kind), float(white))


def planned(images: dict[str, Radiograph], rehearsal: Rehearsal, clicks: Clicks) -> Ended:
    """Return the verdict on two images, as from `sightline plan`."""
    views = []
    for name in VIEWS:
        image, whole = images[name], images[name] is rehearsal.images[name]
        beads = of_base(rehearsal.seed - FIRST, name) if whole else labelled(image, rehearsal, name)
        views.append(view_of(beads, image, rehearsal.setup.frame))
    return judged(clicks.plan(views), rehearsal.hip.wire_mm)


def labelled(image: Radiograph, rehearsal: Rehearsal, name: str) -> Observations:
    return label_beads(image, sl.detect(image), rehearsal.setup.frame, name, live=True)


@lru_cache(maxsize=2 * BASES)
def of_base(number: int, name: str) -> Observations:
    """Return the beads of an image that no damage changed."""
    return labelled(base(number).images[name], base(number), name)


def damage(spoil: Spoil, *cause: str, both: bool = False, white: int = 65535) -> Damage:
    """Return the class of `spoil`, which changes one random image, or both."""

    def make(rng: np.random.Generator) -> Ended:
        rehearsal = base(int(rng.integers(BASES)))
        clicks = Clicks.on(rehearsal.setup, rehearsal.hip, rng)
        images, shown = dict(rehearsal.images), {}
        for name in VIEWS if both else (str(rng.choice(VIEWS)),):
            pixels, shown[name] = spoil(images[name].pixels / images[name].white, rng)
            images[name] = read(pixels, white)
        return planned(images, rehearsal, clicks.as_shown(shown))

    return Damage(make, cause)


def plain(change: Callable[[np.ndarray, np.random.Generator], np.ndarray], *cause: str, **options: int) -> Damage:
    """Return the class of a damage that changes brightness only."""
    return damage(lambda pixels, rng: (change(pixels, rng), lambda uv: uv), *cause, **options)


def unlike(
    make: Callable[[dict[str, Radiograph], int, np.random.Generator], dict[str, Radiograph]], *cause: str
) -> Damage:
    """Return a class in which the pair itself is wrong; `make` gets the images and the number of their base."""

    def go(rng: np.random.Generator) -> Ended:
        number = int(rng.integers(BASES))
        rehearsal = base(number)
        clicks = Clicks.on(rehearsal.setup, rehearsal.hip, rng)
        return planned(make(dict(rehearsal.images), number, rng), rehearsal, clicks)

    return Damage(go, cause)


def of_another(images: dict[str, Radiograph], number: int, rng: np.random.Generator) -> dict[str, Radiograph]:
    """Replace one of the images by another patient's, with the same frame."""
    other = base((number + 4 * int(rng.integers(1, BASES // 4))) % BASES)
    name = str(rng.choice(VIEWS))
    return {**images, name: other.images[name]}


def shifted(pixels: np.ndarray, by_px: np.ndarray) -> np.ndarray:
    """Return an image shifted by (u, v), its border continued."""
    matrix = np.array([[1, 0, by_px[0]], [0, 1, by_px[1]]])
    return cv2.warpAffine(pixels, matrix, pixels.shape[::-1], borderMode=cv2.BORDER_REPLICATE)


def rows_shifted(rows: Callable[[int, np.random.Generator], np.ndarray], least: float, most: float) -> Spoil:
    """Return a damage that shifts the rows (H,) bool sideways by `least` to `most` px."""

    def spoil(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
        shift = float(rng.choice([-1, 1])) * float(np.exp(rng.uniform(np.log(least), np.log(most))))
        moved = rows(len(pixels), rng)

        def shown(uv: np.ndarray) -> np.ndarray:
            at = np.clip(np.rint(uv[:, 1]).astype(int), 0, len(pixels) - 1)
            return uv + np.stack([shift * moved[at], np.zeros(len(uv))], axis=1)

        return np.where(moved[:, None], shifted(pixels, np.array([shift, 0.0])), pixels), shown

    return spoil


def lower_part(height: int, rng: np.random.Generator) -> np.ndarray:
    """Select all rows below a line in the middle half."""
    return np.arange(height) > rng.uniform(0.25, 0.75) * height


def band(height: int, rng: np.random.Generator) -> np.ndarray:
    """Select a strip of a tenth to a third of the rows."""
    start, size = rng.uniform(0.1, 0.6) * height, rng.uniform(0.1, 0.33) * height
    return (np.arange(height) > start) & (np.arange(height) < start + size)


def odd(height: int, _: np.random.Generator) -> np.ndarray:
    """Select every second row: two fields of a moving patient."""
    return np.arange(height) % 2 == 1


def turned(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Rotate by 90°, 180° or 270°, as a display may."""
    times, size = int(rng.integers(1, 4)), len(pixels) - 1

    def shown(uv: np.ndarray) -> np.ndarray:
        for _ in range(times):
            uv = np.stack([uv[:, 1], size - uv[:, 0]], axis=1)
        return uv

    return np.ascontiguousarray(np.rot90(pixels, times)), shown


def mirrored(pixels: np.ndarray, _: np.random.Generator) -> Picture:
    """Exchange left and right, as a display may."""
    width = pixels.shape[1] - 1
    return np.ascontiguousarray(pixels[:, ::-1]), lambda uv: np.stack([width - uv[:, 0], uv[:, 1]], axis=1)


def scaled(pixels: np.ndarray, across: float, down: float, how: int) -> Picture:
    resized = cv2.resize(pixels, None, fx=across, fy=down, interpolation=how)
    return resized, lambda uv: (uv + 0.5) * np.array([across, down]) - 0.5


def resized(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Resize, as an export may."""
    factor = float(rng.choice([0.5, 0.75, 1.5]))
    return scaled(pixels, factor, factor, cv2.INTER_AREA)


def stretched(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Make pixels that are not square."""
    return scaled(pixels, float(rng.uniform(0.85, 1.18)), 1.0, cv2.INTER_LINEAR)


def bulged(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Warp locally by 1 to 6 px over 40 to 150 px, like a magnet near the intensifier."""
    height, width = pixels.shape
    middle, reach = rng.uniform(0.25, 0.75, 2) * [width, height], rng.uniform(40, 150)
    push = rng.uniform(1, 6) * (direction := rng.standard_normal(2)) / np.linalg.norm(direction)

    def by(uv: np.ndarray) -> np.ndarray:
        return np.exp(-((uv - middle) ** 2).sum(axis=-1, keepdims=True) / (2 * reach**2)) * push

    def shown(uv: np.ndarray) -> np.ndarray:
        at = uv.copy()
        for _ in range(20):
            at = uv + by(at)
        return at

    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    u, v = np.moveaxis((grid - by(grid)).astype(np.float32), -1, 0)
    warped = cv2.remap(pixels.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return warped, shown


def ghosted(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Average two exposures between which the C-arm moved."""
    shift = rng.uniform(-6, 6, 2)
    return (pixels + shifted(pixels, shift)) / 2, lambda uv: uv + shift / 2


def shone_through(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add an earlier frame, from which all has moved since: lag, or a filter over time."""
    share, way, angle = rng.uniform(0.1, 0.5), rng.uniform(2, 6), rng.uniform(0, 2 * np.pi)
    return (1 - share) * pixels + share * shifted(pixels, way * np.array([np.cos(angle), np.sin(angle)]))


def surrounded(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Lay the image into bars of any grey level, blank its corners, and store it with the black of a video."""
    grey, black = rng.uniform(0, 1, 2) * [1, 0.1]
    v, u = np.indices(pixels.shape) - (np.array(pixels.shape)[:, None, None] - 1) / 2
    blanked = np.where(np.hypot(u, v) > 0.49 * len(pixels), black, black + (1 - black) * pixels)
    wide = rng.integers(0, len(pixels) // 2, 4)
    bars = np.pad(blanked, (wide[:2], wide[2:]), constant_values=grey)
    return bars, lambda uv: uv + np.array([wide[2], wide[0]])


def captured(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Capture from a video of 576 lines, 8 bits, compressed; sometimes with another ratio of the sides."""
    factor = 576 / len(pixels)
    small, shown = scaled(pixels, factor * float(rng.choice([1.0, 1.0, 1.25])), factor, cv2.INTER_AREA)
    return jpeg(small, rng), shown


def smeared(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Blur by motion during the exposure."""
    way = rng.uniform(2, 12) * np.array([np.cos(a := rng.uniform(0, np.pi)), np.sin(a)])
    return np.mean([shifted(pixels, step * way) for step in np.linspace(-0.5, 0.5, 9)], axis=0)


def jpeg(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Compress as JPEG of quality 15 to 95."""
    byte = np.clip(np.rint(pixels * 255), 0, 255).astype(np.uint8)
    packed = cv2.imencode(".jpg", byte, (cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(15, 96))))[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)) / 255


def windowed(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Clip dark and bright, as a screen shot does."""
    low, high = np.quantile(pixels, [rng.uniform(0.0, 0.15), rng.uniform(0.7, 1.0)])
    return (pixels - low) / max(high - low, 1e-6)


def flat(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Fill a rectangle with one value: a mark, a shutter, lost packets."""
    filled = pixels.copy()
    height, width = (rng.uniform(0.05, 0.5, 2) * pixels.shape).astype(int)
    top, left = (rng.uniform(0, 0.8, 2) * pixels.shape).astype(int)
    filled[top : top + height, left : left + width] = rng.choice([0.0, 1.0, float(np.median(pixels))])
    return filled


def forged(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add 1 to 12 dark discs like balls."""
    yy, xx = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    for _ in range(int(rng.integers(1, 13))):
        u, v, radius = *(rng.uniform(0.15, 0.85, 2) * pixels.shape[::-1]), rng.uniform(4, 18)
        pixels = pixels * (1 - rng.uniform(0.2, 0.8) * expit((radius - np.hypot(xx - u, yy - v)) / 0.8))
    return pixels


def moved_balls(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Copy squares of the image some pixels aside."""
    moved = pixels.copy()
    for _ in range(int(rng.integers(1, 9))):
        v, u = (rng.uniform(0.2, 0.8, 2) * pixels.shape).astype(int)
        dv, du = rng.integers(-5, 6, 2)
        moved[v + dv : v + dv + 28, u + du : u + du + 28] = pixels[v : v + 28, u : u + 28]
    return moved


def wiped(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Inpaint a strip of 4 to 15 % of the image, which removes its content without a trace."""
    mask = np.zeros(pixels.shape, np.uint8)
    start, size = rng.uniform(0.2, 0.7), rng.uniform(0.04, 0.15)
    strip = mask if rng.random() < 0.5 else mask.T
    strip[int(start * len(pixels)) : int((start + size) * len(pixels))] = 1
    painted = cv2.inpaint(np.clip(pixels * 255, 0, 255).astype(np.uint8), mask, 3, cv2.INPAINT_TELEA) / 255
    return np.where(mask, painted, pixels)


def noisy(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add noise of 1 to 10 % of white."""
    return pixels + rng.uniform(0.01, 0.1) * rng.standard_normal(pixels.shape)


def striped(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add periodic stripes, as from interference."""
    at = np.arange(pixels.shape[0])[:, None] if rng.random() < 0.5 else np.arange(pixels.shape[1])[None]
    return pixels * (1 + rng.uniform(0.02, 0.2) * np.sin(2 * np.pi * at / rng.uniform(3, 60)))


def dead(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Set pixels and lines to black or white."""
    broken = pixels.copy()
    hit = rng.random(pixels.shape) < rng.uniform(1e-4, 1e-2)
    broken[hit] = rng.choice([0.0, 1.0], hit.sum())
    broken[rng.integers(0, len(broken), int(rng.integers(0, 4)))] = rng.choice([0.0, 1.0])
    return broken


def coarse(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reduce to few grey levels."""
    levels = int(rng.integers(6, 48))
    return np.rint(pixels / pixels.max() * levels) / levels


def sharpened(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sharpen, like a vendor's edge enhancement."""
    return pixels + rng.uniform(0.5, 4.0) * (pixels - cv2.GaussianBlur(pixels, (0, 0), rng.uniform(1, 4)))


def bent(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Multiply by a brightness slope across the image."""
    vv, uu = np.mgrid[-1 : 1 : pixels.shape[0] * 1j, -1 : 1 : pixels.shape[1] * 1j]
    slope = rng.uniform(-0.6, 0.6, 2)
    return pixels * np.exp(slope[0] * uu + slope[1] * vv) * 0.6


inverted = partial(plain, lambda pixels, _: pixels.max() - pixels, "invert")
CLIPPED = ("satur", "clip", "white")
CLASSES: dict[str, Damage] = {
    "untouched": plain(lambda pixels, _: pixels),
    "lower part shifted": damage(rows_shifted(lower_part, 1, 60), "torn", "rows", "shift"),
    "band shifted": damage(rows_shifted(band, 1, 60), "torn", "rows", "shift"),
    "fields shifted": damage(rows_shifted(odd, 0.5, 10), "interlace", "fields", "rows"),
    "local warp": damage(bulged),
    "two exposures averaged": damage(ghosted, "blur", "mov", "double"),
    "an earlier frame shines through": plain(shone_through, "copy", "blur", "mov"),
    "surrounded": damage(surrounded, white=255),
    "captured with 576 lines": damage(captured, "few pixels", "not square", white=255),
    "smeared by motion": plain(smeared, "blur", "mov"),
    "out of focus": plain(lambda pixels, rng: cv2.GaussianBlur(pixels, (0, 0), rng.uniform(1.0, 6.0)), "blur"),
    "inverted": inverted(),
    "both inverted": inverted(both=True),
    "saturated": plain(lambda pixels, rng: pixels * rng.uniform(1.3, 6.0), *CLIPPED),
    "windowed to 8 bits": plain(windowed, *CLIPPED, white=255),
    "JPEG": plain(jpeg, white=255),
    "few grey levels": plain(coarse),
    "another tone curve": plain(lambda pixels, rng: np.clip(pixels, 0, 1) ** rng.uniform(0.35, 2.5)),
    "sharpened": plain(sharpened),
    "sloping brightness": plain(bent),
    "noisy": plain(noisy),
    "stripes": plain(striped),
    "dead pixels and lines": plain(dead),
    "flat rectangle": plain(flat),
    "strip wiped": plain(wiped),
    "forged balls": plain(forged),
    "moved squares": plain(moved_balls),
    "turned": damage(turned),
    "both mirrored": damage(mirrored, both=True),
    "one mirrored": damage(mirrored),
    "resized": damage(resized),
    "not square": damage(stretched, "not square"),
    "views exchanged": unlike(lambda i, *_: {"pa": i["lateral"], "lateral": i["pa"]}, "swapped", "lateral", "other"),
    "one view twice": unlike(lambda i, *_: {"pa": i["pa"], "lateral": i["pa"]}, "view", "plates"),
    "another patient's image": unlike(of_another, "patient", "moved", "gap"),
}
_BY = "gVirtualXray" if gvxr.INSTALLED else "the twin"
CAMPAIGN = Campaign("images", f"Images of {_BY} spoilt on their way from the C-arm", CLASSES)
