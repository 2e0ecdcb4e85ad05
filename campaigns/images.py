"""Images damaged on their way from the C-arm: no plan with GO may be wrong.

Each base is a simulated patient, rendered once per process. A damage changes one image or both, and states where the
damaged image shows a point, because the user clicks on what is visible.
"""

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from scipy.special import expit

import sightline as sl
from campaigns.campaign import Campaign, Damage, Ended
from campaigns.person import Clicks, Shown, judged
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.studies.scenes import VIEWS

BASES = 12  # rendered patients; the same for every seed
Picture = tuple[np.ndarray, Shown]  # pixels, 0 to 1, and the map from original to shown pixel coordinates
Spoil = Callable[[np.ndarray, np.random.Generator], Picture]


def same(uv: np.ndarray) -> np.ndarray:
    """Return the coordinates unchanged."""
    return uv


@lru_cache(maxsize=BASES)
def base(number: int) -> Rehearsal:
    """Return a patient with rendered images; right and left hips alternate."""
    return Rehearsal.draw(1000 + number, Frame.load("gamma"), ("right", "left")[number % 2])


def read(pixels: np.ndarray, white: int = 65535) -> Radiograph:
    """Return a Radiograph with integers up to white, as a file stores them."""
    kind = np.uint8 if white == 255 else np.uint16
    return Radiograph(np.clip(np.rint(pixels * white), 0, white).astype(kind), float(white))


def whole_way(images: dict[str, Radiograph], frame: Frame, clicks: Clicks, wire_mm: np.ndarray) -> Ended:
    """Return the verdict on two images, as from `sightline plan`."""
    from sightline.from_images.pipeline import label_beads

    views = []
    for name in VIEWS:
        beads = sl.detect(images[name])
        views.append(sl.calibrate(label_beads(images[name], beads, frame, name), frame, view=name))
    return judged(clicks.plan(views), wire_mm)


def damage(spoil: Spoil, *cause: str, both: bool = False, white: int = 65535) -> Damage:
    """Return the class of `spoil`, which changes one random image, or both."""

    def make(rng: np.random.Generator) -> Ended:
        rehearsal = base(int(rng.integers(BASES)))
        clicks = Clicks.on(rehearsal.setup, rehearsal.hip, rng)
        chosen = VIEWS if both else (str(rng.choice(VIEWS)),)
        images, shown = dict(rehearsal.images), {}
        for name in chosen:
            before = images[name]
            pixels, shown[name] = spoil(before.pixels / before.white, rng)
            images[name] = read(pixels, white)
        return whole_way(images, rehearsal.setup.frame, clicks.as_shown(shown), rehearsal.hip.wire_mm)

    return Damage(make, cause)


def rows_shifted(rows: Callable[[int, np.random.Generator], np.ndarray], least: float, most: float) -> Spoil:
    """Return a damage that shifts the rows (H,) bool sideways by `least` to `most` px."""

    def spoil(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
        shift = float(rng.choice([-1, 1])) * float(np.exp(rng.uniform(np.log(least), np.log(most))))
        moved = rows(len(pixels), rng)
        whole = cv2.warpAffine(
            pixels, np.array([[1, 0, shift], [0, 1, 0]]), pixels.shape[::-1], borderMode=cv2.BORDER_REPLICATE
        )

        def shown(uv: np.ndarray) -> np.ndarray:
            at = np.clip(np.rint(uv[:, 1]).astype(int), 0, len(pixels) - 1)
            return uv + np.stack([shift * moved[at], np.zeros(len(uv))], axis=1)

        return np.where(moved[:, None], whole, pixels), shown

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


def plain(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Spoil:
    """Return a damage that changes brightness only."""
    return lambda pixels, rng: (change(pixels, rng), same)


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


def resized(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Resize, as an export may."""
    factor = float(rng.choice([0.5, 0.75, 1.5]))
    out = cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return out, lambda uv: (uv + 0.5) * factor - 0.5


def stretched(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Make pixels that are not square."""
    factor = float(rng.uniform(0.85, 1.18))
    out = cv2.resize(pixels, None, fx=factor, fy=1.0, interpolation=cv2.INTER_LINEAR)
    return out, lambda uv: np.stack([(uv[:, 0] + 0.5) * factor - 0.5, uv[:, 1]], axis=1)


def bulged(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Warp locally by 1 to 6 px over 40 to 150 px, like a magnet near the intensifier."""
    height, width = pixels.shape
    middle, reach = rng.uniform(0.25, 0.75, 2) * [width, height], rng.uniform(40, 150)
    push = rng.uniform(1, 6) * (direction := rng.standard_normal(2)) / np.linalg.norm(direction)

    def by(uv: np.ndarray) -> np.ndarray:
        return np.exp(-((uv - middle) ** 2).sum(axis=-1, keepdims=True) / (2 * reach**2)) * push

    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    source = (grid - by(grid)).astype(np.float32)
    out = cv2.remap(
        pixels.astype(np.float32), source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )

    def shown(uv: np.ndarray) -> np.ndarray:
        at = uv.copy()
        for _ in range(20):
            at = uv + by(at)
        return at

    return out, shown


def ghosted(pixels: np.ndarray, rng: np.random.Generator) -> Picture:
    """Average two exposures between which the C-arm moved."""
    shift = rng.uniform(-6, 6, 2)
    other = cv2.warpAffine(
        pixels, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), pixels.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    return (pixels + other) / 2, lambda uv: uv + shift / 2


def smeared(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Blur by motion during the exposure."""
    steps, way = (
        np.linspace(-0.5, 0.5, 9),
        rng.uniform(2, 12) * np.array([np.cos(a := rng.uniform(0, np.pi)), np.sin(a)]),
    )
    shifted = [
        cv2.warpAffine(
            pixels,
            np.array([[1, 0, s * way[0]], [0, 1, s * way[1]]]),
            pixels.shape[::-1],
            borderMode=cv2.BORDER_REPLICATE,
        )
        for s in steps
    ]
    return np.mean(shifted, axis=0)


def jpeg(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Compress as JPEG of quality 15 to 95."""
    byte = np.clip(np.rint(pixels * 255), 0, 255).astype(np.uint8)
    packed = cv2.imencode(".jpg", byte, (cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(15, 96))))[1]
    return cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE) / 255


def windowed(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Clip dark and bright, as a screen shot does."""
    low, high = np.quantile(pixels, [rng.uniform(0.0, 0.15), rng.uniform(0.7, 1.0)])
    return np.clip((pixels - low) / max(high - low, 1e-6), 0, 1)


def saturated(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Overexpose."""
    return np.clip(pixels * rng.uniform(1.3, 6.0), 0, 1)


def flat(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Fill a rectangle with one value: a mark, a shutter, lost packets."""
    out = pixels.copy()
    height, width = (rng.uniform(0.05, 0.5, 2) * pixels.shape).astype(int)
    top, left = (rng.uniform(0, 0.8, 2) * pixels.shape).astype(int)
    out[top : top + height, left : left + width] = rng.choice([0.0, 1.0, float(np.median(pixels))])
    return out


def forged(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add 1 to 12 dark discs like balls."""
    out = pixels.copy()
    yy, xx = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    for _ in range(int(rng.integers(1, 13))):
        u, v, radius = *(rng.uniform(0.15, 0.85, 2) * pixels.shape[::-1]), rng.uniform(4, 18)
        edge = expit((radius - np.hypot(xx - u, yy - v)) / 0.8)
        out *= 1 - rng.uniform(0.2, 0.8) * edge
    return out


def moved_balls(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Copy squares of the image some pixels aside."""
    out = pixels.copy()
    for _ in range(int(rng.integers(1, 9))):
        v, u = (rng.uniform(0.2, 0.8, 2) * pixels.shape).astype(int)
        dv, du = rng.integers(-5, 6, 2)
        out[v + dv : v + dv + 28, u + du : u + du + 28] = pixels[v : v + 28, u : u + 28]
    return out


def wiped(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Inpaint a strip of 4 to 15 % of the image, which removes its content without a trace."""
    mask = np.zeros(pixels.shape, np.uint8)
    start, size = rng.uniform(0.2, 0.7), rng.uniform(0.04, 0.15)
    a, b = int(start * len(pixels)), int((start + size) * len(pixels))
    if rng.random() < 0.5:
        mask[a:b] = 1
    else:
        mask[:, a:b] = 1
    small = cv2.inpaint(np.clip(pixels * 255, 0, 255).astype(np.uint8), mask, 3, cv2.INPAINT_TELEA) / 255
    return np.where(mask, small, pixels)


def noisy(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add noise of 1 to 10 % of white."""
    return pixels + rng.uniform(0.01, 0.1) * rng.standard_normal(pixels.shape)


def striped(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add periodic stripes, as from interference."""
    at = np.arange(pixels.shape[0])[:, None] if rng.random() < 0.5 else np.arange(pixels.shape[1])[None]
    return pixels * (1 + rng.uniform(0.02, 0.2) * np.sin(2 * np.pi * at / rng.uniform(3, 60)))


def dead(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Set pixels and lines to black or white."""
    out = pixels.copy()
    hit = rng.random(pixels.shape) < rng.uniform(1e-4, 1e-2)
    out[hit] = rng.choice([0.0, 1.0], hit.sum())
    out[rng.integers(0, len(out), int(rng.integers(0, 4)))] = rng.choice([0.0, 1.0])
    return out


def blurred(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Defocus by 1 to 6 px."""
    return cv2.GaussianBlur(pixels, (0, 0), rng.uniform(1.0, 6.0))


def inverted(pixels: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """Invert, so that balls are bright."""
    return pixels.max() - pixels


def gamma(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Apply another tone curve."""
    return np.clip(pixels, 0, 1) ** rng.uniform(0.35, 2.5)


def coarse(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reduce to few grey levels."""
    levels = int(rng.integers(6, 48))
    return np.rint(pixels / pixels.max() * levels) / levels


def sharpened(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sharpen, like a vendor's edge enhancement."""
    return np.clip(
        pixels + rng.uniform(0.5, 4.0) * (pixels - cv2.GaussianBlur(pixels, (0, 0), rng.uniform(1, 4))), 0, 1
    )


def bent(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Multiply by a brightness slope across the image."""
    vv, uu = np.mgrid[-1 : 1 : pixels.shape[0] * 1j, -1 : 1 : pixels.shape[1] * 1j]
    slope = rng.uniform(-0.6, 0.6, 2)
    return np.clip(pixels * np.exp(slope[0] * uu + slope[1] * vv) * 0.6, 0, 1)


def unlike(
    make: Callable[[dict[str, Radiograph], int, np.random.Generator], dict[str, Radiograph]], *cause: str
) -> Damage:
    """Return a class in which the pair itself is wrong; `make` gets the images and the number of their base."""

    def go(rng: np.random.Generator) -> Ended:
        number = int(rng.integers(BASES))
        rehearsal = base(number)
        clicks = Clicks.on(rehearsal.setup, rehearsal.hip, rng)
        images = make(dict(rehearsal.images), number, rng)
        return whole_way(images, rehearsal.setup.frame, clicks, rehearsal.hip.wire_mm)

    return Damage(go, cause)


def of_another(images: dict[str, Radiograph], number: int, rng: np.random.Generator) -> dict[str, Radiograph]:
    """Replace one of the images by another patient's."""
    other = base((number + int(rng.integers(1, BASES))) % BASES)
    name = str(rng.choice(VIEWS))
    return {**images, name: other.images[name]}


CLASSES: dict[str, Damage] = {
    "untouched": damage(plain(lambda pixels, _: pixels)),
    "lower part shifted": damage(rows_shifted(lower_part, 1, 60), "torn", "rows", "shift"),
    "band shifted": damage(rows_shifted(band, 1, 60), "torn", "rows", "shift"),
    "fields shifted": damage(rows_shifted(odd, 0.5, 10), "interlace", "fields", "rows"),
    "local warp": damage(bulged),
    "two exposures averaged": damage(ghosted, "blur", "mov", "double"),
    "smeared by motion": damage(plain(smeared), "blur", "mov"),
    "out of focus": damage(plain(blurred), "blur"),
    "inverted": damage(plain(inverted), "invert"),
    "both inverted": damage(plain(inverted), "invert", both=True),
    "saturated": damage(plain(saturated), "satur", "clip", "white"),
    "windowed to 8 bits": damage(plain(windowed), "satur", "clip", "white", white=255),
    "JPEG": damage(plain(jpeg), white=255),
    "few grey levels": damage(plain(coarse)),
    "another tone curve": damage(plain(gamma)),
    "sharpened": damage(plain(sharpened)),
    "sloping brightness": damage(plain(bent)),
    "noisy": damage(plain(noisy)),
    "stripes": damage(plain(striped)),
    "dead pixels and lines": damage(plain(dead)),
    "flat rectangle": damage(plain(flat)),
    "strip wiped": damage(plain(wiped)),
    "forged balls": damage(plain(forged)),
    "moved squares": damage(plain(moved_balls)),
    "turned": damage(turned),
    "both mirrored": damage(mirrored, both=True),
    "one mirrored": damage(mirrored),
    "resized": damage(resized),
    "not square": damage(stretched),
    "views exchanged": unlike(lambda i, *_: {"pa": i["lateral"], "lateral": i["pa"]}, "swapped", "lateral", "other"),
    "one view twice": unlike(lambda i, *_: {"pa": i["pa"], "lateral": i["pa"]}, "view", "plates"),
    "another patient's image": unlike(of_another, "patient", "moved", "gap"),
}
CAMPAIGN = Campaign("images", "Images spoilt on their way from the C-arm", CLASSES)
