"""What one radiograph shows of the machine that made it: distortion, blur, noise, contrast, vignetting.

Every function measures one thing on pixels or beads alone, whoever made them, and raises NotMeasurableError where the
image has no such content. The frame, the source and the C-arm are not known.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from sightline.common.fitting import monomials
from sightline.detection import Detections
from sightline.detection.beads.noise import NoiseModel, estimate_noise
from sightline.detection.beads.window import BEYOND
from sightline.detection.lattice import Lattice, lattice_of_sheet
from sightline.detection.log_image import field_inset, log_image
from sightline.errors import DetectionRefusedError, RefusedError
from sightline.imaging import Radiograph

DEGREES = (1, 2, 3, 4, 5, 6, 7)
RIM = 0.9  # of the field's radius: where pincushion and turn are stated; an octagonal field reaches further [ours]
PER_COEFFICIENT = 2  # [ours] points for each coefficient of a polynomial, at least: of fewer, it follows the noise
CLEAR = 1.6  # [ours] bead radii about a bead that count as its shadow and blur: with less, noise is overstated
STEP_PX = 0.2  # grid of the template of a rim
BIN_PX = 0.25  # of a rim's profile
EDGE_BEADS = 60  # [ours] rims that are fitted, of many beads evenly chosen: more take longer and say the same
MIN_RADIUS_PX = 10 * BIN_PX  # of a bead whose rim has a profile: ten of its bins
MIN_BALLS, ALIKE = 8, 0.15  # as many as detection compares with each other; spread of their radii [ours]
OPEN, INNER = 0.8, 0.8  # log ratio of bright to dark, in so much of the radius: phantoms 0.5, a spine 1.3 [ARCADIS]
# Rings of the field, and how many of them must be even; sectors of each, and pixels of a sector, whose mean then has a
# tenth of their noise [ours].
RINGS, MIN_RINGS, SECTORS, MIN_PIXELS = 10, 6, 12, 100
PLATE_BLUR = 0.7  # pitches: leaves 3e-6 of a hexagonal lattice's own pattern [calc]
UNEVEN = 0.05  # spread (s.d.) of brightness around a ring beyond which something shades it: vignetting is round [ours]


class NotMeasurableError(RefusedError):
    """The image has no content that shows this."""


@dataclass(frozen=True, eq=False)
class DistortionMeasured:
    """`residual_px`: rms per point (both coordinates) that a polynomial from pixels to the plate leaves, by degree.

    Those with too few points are absent. `pincushion`: share by which the ring at RIM of the field's radius lies
    further out than the middle's own scale has it; `turn_rad`: by how much it is turned against the middle.
    """

    points: int
    residual_px: dict[int, float]
    pincushion: float
    turn_rad: float


@dataclass(frozen=True, eq=False)
class VignettingMeasured:
    """Median brightness of rings, the innermost is 1; `radius` of the rings over the field's radius."""

    radius: np.ndarray
    brightness: np.ndarray


def field_circle(image: Radiograph) -> tuple[np.ndarray, float]:
    """Centre (2,) and radius, px, of the smallest circle that encloses the field."""
    outline = cv2.findContours(image.field_mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    centre, radius = cv2.minEnclosingCircle(np.concatenate(outline))
    return np.array(centre), float(radius)


def lattice_of(beads: Detections | None) -> Lattice:
    """The lattice that an image's beads stand on. Raises NotMeasurableError."""
    if beads is None:
        raise NotMeasurableError("no beads or holes")
    try:
        return lattice_of_sheet(beads.uv_px)
    except DetectionRefusedError as error:
        raise NotMeasurableError(str(error)) from None


def distortion(lattice: Lattice, centre_px: np.ndarray, radius_px: float) -> DistortionMeasured:
    """Distortion of a lattice seen in a round field. A tilt of the plate counts as distortion of degree 2."""
    uv, xy = (lattice.uv_px - centre_px) / radius_px, lattice.xy - lattice.xy.mean(axis=0)
    xy_unit = xy / np.abs(xy).max()
    slope = np.linalg.lstsq(monomials(uv, 1), xy, rcond=None)[0][1:]
    px_per_pitch = radius_px / np.sqrt(abs(np.linalg.det(slope)))
    residual = {}
    for degree in DEGREES:
        terms = monomials(uv, degree)
        left = len(uv) - terms.shape[1]
        if len(uv) < PER_COEFFICIENT * terms.shape[1]:
            break
        miss = xy - terms @ np.linalg.lstsq(terms, xy, rcond=None)[0]
        residual[degree] = float(px_per_pitch * np.sqrt((miss**2).sum() / left))
    degree = max(d for d in residual if d <= 5)
    pincushion, turn = _at_rim(xy_unit, uv, degree)
    return DistortionMeasured(len(uv), residual, pincushion, turn)


def _at_rim(xy: np.ndarray, uv: np.ndarray, degree: int) -> tuple[float, float]:
    """Mean share outwards and mean turn (rad) of a ring at RIM against the map that holds in the middle.

    The ring is one on the plate: the middle's linear map takes it to a circle of radius RIM of the image's field.
    """
    to_plate = np.linalg.lstsq(monomials(uv, degree), xy, rcond=None)[0]
    middle, slope = to_plate[0], to_plate[1:3]  # d(xy) = d(uv) @ slope
    local = (xy - middle) @ np.linalg.inv(slope)
    to_image = np.linalg.lstsq(monomials(local, degree), uv, rcond=None)[0]
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    ring = RIM * np.exp(1j * angle)
    seen = monomials(np.stack([ring.real, ring.imag], axis=1), degree) @ to_image
    start = to_image[0]
    own = ring.real[:, None] * to_image[1] + ring.imag[:, None] * to_image[2]
    ratio = np.mean(((seen - start) @ [1, 1j]) / (own @ [1, 1j]))
    return float(ratio.real - 1), float(np.angle(ratio))


def edge_spread(image: Radiograph, beads: Detections | None) -> tuple[float, int]:
    """Standard deviation (px) of the blur of rims, median over beads, and how many were fitted. The pixel is in it.

    A ball is taken for exp(-k chord) of unknown k in unknown scatter, a hole for a disc; washers are left out.
    """
    if beads is None:
        raise NotMeasurableError("no beads or holes")
    kind = np.array(beads.kind)
    nearest = _nearest_px(beads)
    reach = np.minimum(beads.radius_px + BEYOND, nearest - beads.radius_px - BEYOND / 2)
    fit = (kind != "washer") & (beads.radius_px >= MIN_RADIUS_PX) & (reach > beads.radius_px + 1.5)
    chosen = np.flatnonzero(fit)
    if not len(chosen):
        raise NotMeasurableError(f"no ball or hole of {MIN_RADIUS_PX} px radius and more stands free")
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, EDGE_BEADS).astype(int))]
    pixels = image.pixels.astype(np.float64)
    blurs = [
        _rim_blur(pixels, beads.uv_px[i], float(beads.radius_px[i]), float(reach[i]), kind[i] == "ball") for i in chosen
    ]
    known = [b for b in blurs if b is not None]
    if not known:
        raise NotMeasurableError(f"none of {len(chosen)} rims has a profile that a blurred disc or ball explains")
    return float(np.median(known)), len(known)


def _nearest_px(beads: Detections) -> np.ndarray:
    """(N,): distance from each bead to the next one."""
    if len(beads) < 2:
        return np.full(len(beads), np.inf)
    return np.asarray(KDTree(beads.uv_px).query(beads.uv_px, k=2)[0])[:, 1]


def _rim_blur(pixels: np.ndarray, uv_px: np.ndarray, radius_px: float, reach_px: float, ball: bool) -> float | None:
    at, values, weight = _profile(pixels, uv_px, reach_px)
    if len(at) < 12:
        return None

    def left(parameters: np.ndarray) -> np.ndarray:
        radius, blur, depth = parameters
        shape = _template(radius, blur, depth if ball else None, at)
        terms = weight[:, None] * np.stack([np.ones_like(shape), shape], axis=1)
        goal = weight * values
        return goal - terms @ np.linalg.lstsq(terms, goal, rcond=None)[0]

    low, high = np.array([0.6 * radius_px, 0.3, 0.1]), np.array([1.5 * radius_px, 0.6 * radius_px, 12.0])
    fit = least_squares(left, [radius_px, min(1.0, 0.3 * radius_px), 2.0], bounds=(low, high), diff_step=1e-3)
    swing = np.ptp(values) * np.sqrt((weight**2).sum())
    stuck = min(fit.x[1] - low[1], high[1] - fit.x[1]) < 1e-3
    return None if stuck or np.linalg.norm(fit.fun) > 0.03 * swing else float(fit.x[1])


def _profile(pixels: np.ndarray, uv_px: np.ndarray, reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean radius, mean pixel and root of the number of pixels, of rings BIN_PX wide about a place."""
    (u, v), half = uv_px, int(reach_px) + 1
    row, column = round(v), round(u)
    part = pixels[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
    rows = np.arange(part.shape[0]) + max(row - half, 0)
    columns = np.arange(part.shape[1]) + max(column - half, 0)
    distance = np.hypot(columns - u, (rows - v)[:, None])
    inside = distance < reach_px
    ring = (distance[inside] / BIN_PX).astype(int)
    count = np.bincount(ring)
    some = count > 0
    at, mean = (np.bincount(ring, a[inside])[some] / count[some] for a in (distance, part))
    return at, mean, np.sqrt(count[some])


def _template(radius: float, blur: float, depth: float | None, at: np.ndarray) -> np.ndarray:
    """A ball's or (no depth) a disc's blurred profile at distances from its middle: 1 inside at most, 0 far away."""
    half = int(np.ceil((max(at[-1], radius) + 4 * blur) / STEP_PX))
    side = STEP_PX * np.arange(-half, half + 1)
    r2 = side**2 + (side**2)[:, None]
    if depth is None:
        sharp = np.clip((radius - np.sqrt(r2)) / STEP_PX + 0.5, 0.0, 1.0)
    else:
        sharp = 1 - np.exp(-depth * np.sqrt(np.maximum(1 - r2 / radius**2, 0.0)))
    soft = cv2.GaussianBlur(sharp, (0, 0), blur / STEP_PX, borderType=cv2.BORDER_CONSTANT)
    return np.interp(at, side[half:], soft[half, half:])


def free_field(image: Radiograph, beads: Detections | None) -> np.ndarray:
    """(H, W) bool: inside the field, away from beads, and not saturated."""
    free = field_inset(image).astype(np.uint8)
    for (u, v), radius in [] if beads is None else zip(beads.uv_px, beads.radius_px, strict=True):
        cv2.circle(free, (round(u), round(v)), round(CLEAR * radius) + 3, 0, -1)
    top = 0.98 * image.pixels[free > 0].max(initial=0)  # an image may saturate below its white level
    clipped = image.pixels > top
    return (free > 0) & ~clipped if (clipped & (free > 0)).sum() > 0.02 * free.sum() else free > 0


def noise(image: Radiograph, beads: Detections | None) -> tuple[NoiseModel, np.ndarray]:
    """Noise of the log intensity in the free field, and the levels (5,) of log intensity there: 5, 25, ..., 95 %."""
    if _is_plate(beads):
        raise NotMeasurableError("holes everywhere leave no flat block of 16 px")
    free = free_field(image, beads)
    logs = log_image(image, field_inset(image))
    model = estimate_noise(logs, free)
    if model is None:
        raise NotMeasurableError("fewer than 8 blocks of 16 px are free of beads and of the field's edge")
    return model, np.percentile(logs[free], [5, 25, 50, 75, 95])


def usual_balls(beads: Detections | None) -> np.ndarray:
    """Indices of the balls of the usual size. Raises NotMeasurableError where they may as well be anatomy."""
    balls = np.zeros(0, int) if beads is None else np.flatnonzero(np.array(beads.kind) == "ball")
    if beads is None or len(balls) < MIN_BALLS:
        raise NotMeasurableError(f"{len(balls)} balls; fewer than {MIN_BALLS} may be anatomy")
    radius = beads.radius_px[balls]
    usual = balls[np.abs(radius / np.median(radius) - 1) < ALIKE]
    if 2 * len(usual) < len(balls):
        raise NotMeasurableError("what was found dark and round has no usual size, so it is hardly balls of a phantom")
    return usual


def ball_contrast(beads: Detections | None) -> tuple[float, float, int]:
    """Median change of log intensity in the middle of balls of the usual size, their radius (px), how many."""
    usual = usual_balls(beads)
    assert beads is not None  # noqa: S101 - usual_balls refuses None
    return float(np.median(beads.contrast[usual])), float(np.median(beads.radius_px[usual])), len(usual)


def open_beam(image: Radiograph, beads: Detections | None) -> bool:
    """Whether nothing thick stands in the beam: brightness within the field, beads apart, varies by less than e^0.8."""
    centre, radius = field_circle(image)
    v, u = np.nonzero(free_field(image, beads))
    inner = np.hypot(u - centre[0], v - centre[1]) < INNER * radius
    if not inner.any():
        return True
    low, high = np.percentile(image.pixels[v[inner], u[inner]], [5, 95])
    return bool(low > np.exp(-OPEN) * high)


def vignetting(image: Radiograph, beads: Detections | None) -> VignettingMeasured:
    """Brightness over radius, as far out as rings are evenly bright: of the free field, or of a whole perforated plate.

    A plate's holes are everywhere alike: blurred over them, it is an open field. Raises NotMeasurableError.
    """
    centre, radius = field_circle(image)
    pitch = float(np.median(_nearest_px(beads))) if beads is not None and _is_plate(beads) else None
    free = field_inset(image) if pitch else free_field(image, beads)
    pixels = _blurred(image.pixels, free, PLATE_BLUR * pitch) if pitch else image.pixels
    v, u = np.nonzero(free)
    x, y = u - centre[0], v - centre[1]
    ring = (RINGS * np.hypot(x, y) / radius).astype(int)
    sector = (SECTORS * (np.arctan2(y, x) / (2 * np.pi) + 0.5)).astype(int) % SECTORS
    values = pixels[v, u].astype(np.float64)
    brightness: list[float] = []
    for k in range(RINGS):
        parts = [values[(ring == k) & (sector == s)] for s in range(SECTORS)] if k else [values[ring == 0]]
        level = [float(np.median(part)) for part in parts if len(part) >= MIN_PIXELS]
        if 2 * len(level) <= len(parts):
            break
        low, middle, high = np.percentile(level, [16, 50, 84])
        if high - low > 2 * UNEVEN * middle:
            break
        brightness.append(float(middle))
    if len(brightness) < MIN_RINGS:
        raise NotMeasurableError(
            f"brightness is even to {UNEVEN:.0%} around the inner {len(brightness)} of {RINGS} rings only, "
            f"{MIN_RINGS} are needed: something in the beam shades the image"
        )
    levels = np.array(brightness)
    return VignettingMeasured((np.arange(len(levels)) + 0.5) / RINGS, levels / levels[0])


def _blurred(pixels: np.ndarray, mask: np.ndarray, blur_px: float) -> np.ndarray:
    """(H, W): weighted means of the pixels in the mask about each place."""
    weight = mask.astype(np.float64)
    total, known = (cv2.GaussianBlur(a, (0, 0), blur_px) for a in (pixels * weight, weight))
    return total / np.maximum(known, 1e-6)


def _is_plate(beads: Detections | None) -> bool:
    return beads is not None and 2 * beads.kind.count("hole") > len(beads)
