"""What is drawn on two images, in space: axes, planes, cylinders, tubes and pairs of rims; and wires inside tubes.

A line drawn in an image spans a plane in space; the planes of two images meet in an axis.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.covariance import line_direction, response
from sightline.common.geometry.lines import NearestApproach, across, nearest_approach, unit
from sightline.errors import ReconstructionRefusedError
from sightline.planning.points.lines_of_sight import Sights
from sightline.planning.points.trajectory import MIN_LENGTH_MM

# Planes: the bone's surface at the entry, as one image shows it.
ENTRY_BORDERS = ENTRY, ENTRY_LATERAL = "entry-cortex", "entry-cortex-lateral"

# For both images the focal point and four clicks on the view's plate, (K, 2, 5, 3).
Tube = np.ndarray
_MIN_SINE = 0.5  # [ours] of the angle between the two views of the tube, seen along it: below, an error counts twofold
_MIN_ALONG = 0.7  # cosine of the largest angle between wire and tube; a larger one shows wrong borders [ours]
_STATIONS = 5  # [ours] along the drawn part of the tube: its borders are straight, so that more tell no more
MAX_UNEQUAL = 0.2  # [ours] of a cylinder's widths in both images, over their mean: with more, they are of two things
# At a smaller angle between the planes the axis's error is more than six times theirs [ours].
MIN_ANGLE_RAD = np.deg2rad(10.0)
# Drawings of one thing in two images show its middle on lines of sight that pass each other by less than this [ours]: a
# few times the error of strokes, and less than between two things.
MAX_GAP_MM = 5.0
Rays = list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Axis:
    """A straight axis, CFCS.

    `ends_mm` (2, 3): its points at the first view's two clicks; `covariance_mm2` (6, 6) of both, None where a view's
    error is unknown.
    """

    ends_mm: np.ndarray
    covariance_mm2: np.ndarray | None

    @property
    def direction(self) -> np.ndarray:
        """(3,) unit vector from the first end to the second."""
        return unit(self.ends_mm[1] - self.ends_mm[0])

    @property
    def direction_covariance_rad2(self) -> np.ndarray | None:
        """(2, 2) covariance of the direction along two axes perpendicular to it."""
        if self.covariance_mm2 is None:
            return None
        to_direction = line_direction(*self.ends_mm)
        return to_direction @ self.covariance_mm2 @ to_direction.T

    @property
    def offset_covariance_mm2(self) -> np.ndarray | None:
        """(2, 2) covariance of the middle of both ends along two axes perpendicular to it."""
        if self.covariance_mm2 is None:
            return None
        across = np.linalg.svd(self.direction[None])[2][1:]
        to_offset = np.hstack([across, across]) / 2
        return to_offset @ self.covariance_mm2 @ to_offset.T

    def distance_mm(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the distances (...) of points (..., 3) from the axis."""
        return np.linalg.norm(np.cross(xyz_mm - self.ends_mm[0], self.direction), axis=-1)


def find_axis(sights: Sights, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends (6,) of the axis drawn as `name`, and their derivatives (6, n) by its numbers in z.

    Raises ReconstructionRefusedError where the planes do not determine it.
    """
    at = sights.values[sights.index(name)]
    rays = sights.rays(name, at[None])
    if min(np.linalg.norm(points[0, 1] - points[0, 0]) for _, points in rays) < MIN_LENGTH_MM:
        raise ReconstructionRefusedError(
            f"the two clicks of the {name} axis are too close together; draw the line longer in both images"
        )
    first, second = (np.cross(points[0, 0] - focal[0, 0], points[0, 1] - focal[0, 0]) for focal, points in rays)
    sine = np.linalg.norm(np.cross(first, second)) / (np.linalg.norm(first) * np.linalg.norm(second))
    if sine < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            f"the planes of the {name} axis in the two images meet at {np.rad2deg(np.arcsin(sine)):.0f}° (at least "
            f"{np.rad2deg(MIN_ANGLE_RAD):.0f}° is needed): the axis lies in the plane of both beams, where these two "
            "images do not determine it; rotate the C-arm for one of them"
        )
    ends, own = response(lambda z: _axis_ends(sights.rays(name, z)), at)
    length = np.linalg.norm(ends[3:] - ends[:3])
    if length < MIN_LENGTH_MM:
        raise ReconstructionRefusedError(
            f"the {name} axis is drawn {length:.1f} mm long (at least {MIN_LENGTH_MM:.0f} mm is needed); draw it longer"
        )
    return ends, own


def _axis_ends(both: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return (K, 6): where the first view's two rays intersect the plane of the second view's rays."""
    (focal_a, a), (focal_b, b) = both
    normal = np.cross(b[:, 0] - focal_b[:, 0], b[:, 1] - focal_b[:, 0])[:, None]
    rays = a - focal_a
    reach = (normal * (focal_b - focal_a)).sum(axis=-1) / (normal * rays).sum(axis=-1)
    return (focal_a + reach[..., None] * rays).reshape(len(a), 6)


def find_drawing(sights: Sights, name: str, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (m,) of what is drawn as `name`, and their derivatives (m, n) by its numbers in z.

    `kind`, a type of `Drawing`:

    - "plane": a point, and the unit normal (6)
    - "cylinder": a point of its axis, the axis's direction, its radius (7)
    - "outline tube", "oval tube": for each image the focal point, and the four clicks on its plate (30)
    - "rim pair": the middles of both rims (6)

    Raises ReconstructionRefusedError where the drawing does not determine it.
    """
    at = sights.values[sights.index(name)]
    find = _FINDERS[kind]
    return response(lambda z: find(sights.rays(name, z), name), at)


def _plane(rays: Rays, name: str) -> np.ndarray:
    """Return point and normal (K, 6).

    A round plane, seen obliquely, is an ellipse, whose long axis is drawn: that diameter is perpendicular to the beam.
    So each image shows a direction in the plane, and two of them its normal; one image alone shows the plane edge-on.
    """
    middles = [(points.mean(axis=1), focal[:, 0]) for focal, points in rays]
    beams = [unit(middle - focal) for middle, focal in middles]
    drawn = [unit(across(points[:, 1] - points[:, 0], beam)) for (_, points), beam in zip(rays, beams, strict=True)]
    if len(rays) == 1:
        return np.concatenate([middles[0][0], unit(np.cross(drawn[0], beams[0]))], axis=1)
    normal = np.cross(drawn[0], drawn[1])
    if np.linalg.norm(normal[0]) < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            f"the normal of the {name} lies in the plane of both beams, where these two images do not determine it; "
            "rotate the C-arm for one of them"
        )
    return np.concatenate([_middle(rays, name), unit(normal)], axis=1)


def _cylinder(rays: Rays, name: str) -> np.ndarray:
    tube = _tube_of(rays, name)
    return cylinder(tube, _nearest(rays).middle_mm, name)


def _tube(rays: Rays, name: str) -> np.ndarray:
    return _tube_of(rays, name).reshape(len(rays[0][0]), -1)


def _tube_of(rays: Rays, name: str) -> Tube:
    tube = _clicks(rays, name)
    for view in tube[0]:
        refuse_borders(view, name)
    return tube


def _oval_tube(rays: Rays, name: str) -> np.ndarray:
    tube = _clicks(rays, name)
    refuse_oval(tube[0, 0], name)
    refuse_borders(tube[0, 1], name)
    _middle(rays, name)
    return tube.reshape(len(tube), -1)


def _rim_pair(rays: Rays, name: str) -> np.ndarray:
    rims = [[(focal, points[:, rim]) for focal, points in rays] for rim in (slice(0, 4), slice(4, 8))]
    return np.concatenate([_middle(rim, name) for rim in rims], axis=1)


def _clicks(rays: Rays, name: str) -> Tube:
    """Return for the first two images the focal point and the clicks (K, 2, 5, 3)."""
    _refuse_one(rays, name)
    return np.stack([np.concatenate([focal, points], axis=1) for focal, points in rays[:2]], axis=1)


def _middle(rays: Rays, name: str) -> np.ndarray:
    """Return the point (K, 3) that the middles of the clicks in the first two images show."""
    _refuse_one(rays, name)
    near = _nearest(rays)
    if near.gap_mm[0] > MAX_GAP_MM:
        raise ReconstructionRefusedError(
            f"the {name} is not the same in both images: the middles of its clicks pass each other at "
            f"{near.gap_mm[0]:.1f} mm (at most {MAX_GAP_MM:.0f} mm); draw it again, each image in its own place"
        )
    return near.middle_mm


def _nearest(rays: Rays) -> NearestApproach:
    """Return the closest approach of the lines of sight through the middles of the clicks in the first two images."""
    (source, a), (other, b) = ((focal[:, 0], points.mean(axis=1) - focal[:, 0]) for focal, points in rays[:2])
    return nearest_approach(source, a, other, b)


def _refuse_one(rays: Rays, name: str) -> None:
    if len(rays) < 2:
        raise ReconstructionRefusedError(f"the {name} is drawn in one image only; draw it in both images")


_FINDERS: dict[str, Callable[[Rays, str], np.ndarray]] = {
    "plane": _plane,
    "cylinder": _cylinder,
    "outline tube": _tube,
    "oval tube": _oval_tube,
    "rim pair": _rim_pair,
}


def wire_in_tube(entry: np.ndarray, tip: np.ndarray, tube: Tube, name: str) -> np.ndarray:
    """Return the least distances (K,), mm, of wires from the surface of the tube, between the ends of its borders.

    `entry`, `tip` (K, 3); `name` of the tube in messages. Negative outside. Raises ReconstructionRefusedError.

    A border is a plane through the focal point; the planes midway between two borders of a view meet in the tube's
    axis. Its section is the ellipse nearest to a circle that touches the four planes: its squared half-width in the
    direction n is n M n. A point at the share s of the way to an ellipse lies (1 - s) times its shorter semi-axis or
    more from it.
    """
    seen = _Seen.of(tube, entry, name)
    wire = seen.places(entry, tip)
    _refuse_across(entry, tip, seen.way, name)
    first, last = _common([*seen.ends, wire], name)
    along = first + np.linspace(0.0, 1.0, _STATIONS) * (last - first)
    axis = seen.middle[:, None] + along[..., None] * seen.way[:, None]
    beside = _at(entry, tip, wire, along) - axis
    x, y = ((beside * n[:, None]).sum(axis=-1) for n in seen.across)
    return _from_ellipse((x, y), seen.half(axis), (seen.across[0] * seen.across[1]).sum(axis=-1)[:, None], name)


def tip_in_tube(entry: np.ndarray, tip: np.ndarray, tube: Tube, name: str) -> np.ndarray:
    """Return how far (K,), mm, tips lie before the end of the drawn borders, along the tube; negative beyond it.

    Raises ReconstructionRefusedError.
    """
    seen = _Seen.of(tube, entry, name)
    _refuse_across(entry, tip, seen.way, name)
    wire = seen.places(entry, tip)
    forwards = np.sign(wire[:, 1:] - wire[:, :1])
    return np.min([(forwards * ends).max(axis=1) for ends in seen.ends], axis=0) - (forwards * wire[:, 1:])[:, 0]


def wire_in_oval(entry: np.ndarray, tip: np.ndarray, tube: Tube, name: str) -> np.ndarray:
    """Return the least distances (K,), mm, of wires from a tube that the first image shows end-on, as an oval.

    The second image shows two borders: they limit the wire as far as they are drawn, and the middle of their clicks is
    the depth at which the oval is compared. A point at the share s of the way to the oval lies (1 - s) times its
    shorter semi-axis or more from it. Raises ReconstructionRefusedError.
    """
    middle, along = _middle_of_oval(tube, name)
    wire = _refuse_across(entry, tip, along, name)
    (focal, clicks), (side, borders) = ((tube[:, k, 0], tube[:, k, 1:]) for k in (0, 1))
    rays = clicks - focal[:, None]
    depth = ((middle - focal) * along).sum(axis=-1)[:, None, None]
    ring = focal[:, None] + depth / (rays * along[:, None]).sum(axis=-1, keepdims=True) * rays
    long, short = (ring[:, 0] - ring[:, 1]) / 2, (ring[:, 2] - ring[:, 3]) / 2
    reached = ((middle - entry) * along).sum(axis=-1) / ((tip - entry) * along).sum(axis=-1)
    if not 0.0 <= reached[0] <= 1.0:
        raise ReconstructionRefusedError(f"the wire does not pass the {name}; pick entry and end again")
    beside = entry + reached[:, None] * (tip - entry) - ring.mean(axis=1)
    axes = np.stack([long, short, along], axis=2)
    share = np.linalg.norm(np.linalg.solve(axes, beside[..., None])[:, :2, 0], axis=1)
    mean = ((long**2).sum(axis=-1) + (short**2).sum(axis=-1)) / 2
    area = np.linalg.norm(np.cross(long, short), axis=-1)
    semi = np.sqrt(mean - np.sqrt(np.maximum(mean**2 - area**2, 0.0)))
    in_ring = semi * (1.0 - share) * np.abs((wire * along).sum(axis=-1))
    lines = _one_way(borders.reshape(-1, 2, 2, 3))
    places = np.stack([((point - middle) * along).sum(axis=-1) for point in (entry, tip)], axis=1)
    first, last = _common([_ends(side, lines, middle, along), places], name)
    stations = _at(entry, tip, places, first + np.linspace(0.0, 1.0, _STATIONS) * (last - first))
    inside = ((stations - side[:, None])[:, :, None] * _inward(side, lines)[:, None]).sum(axis=-1)
    return np.minimum(in_ring, inside.min(axis=(1, 2)))


def entry_to_oval(entry: np.ndarray, tip: np.ndarray, tube: Tube, name: str) -> np.ndarray:
    """Return the distances (K,), mm, along wires from the entry to the middle of a tube that the first image shows as
    an oval. Raises ReconstructionRefusedError."""
    middle, along = _middle_of_oval(tube, name)
    wire = _refuse_across(entry, tip, along, name)
    return ((middle - entry) * along).sum(axis=-1) / (wire * along).sum(axis=-1)


def axis_of_tube(tube: Tube, name: str) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return a point (3,) of the axis of one tube, its direction (3,), and for both images the places (1, 2), mm along
    it from the point, where its drawn borders end. Raises ReconstructionRefusedError."""
    seen = _seen(tube, name)
    return seen.middle[0], seen.way[0], seen.ends


def line_of_tube(tube: Tube, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the axes of tubes, (K, 3), beside the middle of what is drawn, and their directions (K, 3).

    Raises ReconstructionRefusedError."""
    seen = _seen(tube, name)
    return seen.middle, seen.way


def axis_of_oval(tube: Tube, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the middle (3,) of one tube that the first image shows as an oval, the ray (3,) of that image through it,
    and the unit vector (3,) across the tube from one border of the second image to the other.

    Raises ReconstructionRefusedError.
    """
    middle, along = _middle_of_oval(tube, name)
    inward = _inward(tube[:, 1, 0], _one_way(tube[:, 1, 1:].reshape(-1, 2, 2, 3)))
    return middle[0], along[0], unit(inward[:, 0] - inward[:, 1])[0]


def cylinder(tube: Tube, on: np.ndarray, name: str) -> np.ndarray:
    """Return a point of the axis near `on` (K, 3), its direction, and the radius, (K, 7), of a cylinder's borders.

    Raises ReconstructionRefusedError where its widths in both images are not those of one cylinder.
    """
    seen = _Seen.of(tube, on, name)
    first, second = (half[:, 0] for half in seen.half(seen.middle[:, None]))
    radius = (first + second) / 2
    if abs(first[0] - second[0]) > MAX_UNEQUAL * radius[0]:
        raise ReconstructionRefusedError(
            f"the {name} is {2 * first[0]:.1f} and {2 * second[0]:.1f} mm wide in the two images, which is not one "
            "cylinder; draw its borders again"
        )
    return np.concatenate([seen.middle, seen.way, radius[:, None]], axis=1)


def refuse_borders(view: np.ndarray, name: str) -> None:
    """Raise ReconstructionRefusedError where borders, clicked at (5, 3) with the focal point first, cross."""
    if all(_sides(view)):
        raise ReconstructionRefusedError(
            f"the borders of the {name} cross in an image; click two points of one border, then two of the other"
        )


def refuse_oval(view: np.ndarray, name: str) -> None:
    """Raise ReconstructionRefusedError where the axes of an oval, clicked at (5, 3), do not cross."""
    if not all(_sides(view)):
        raise ReconstructionRefusedError(
            f"the axes of the oval of the {name} do not cross; click both ends of its long axis, then both of its "
            "short axis"
        )


def _sides(view: np.ndarray) -> list[bool]:
    """Return for each of two lines whether its ends (5, 3, after the focal point) lie on both sides of the other."""
    lines = (view[1:] - view[0]).reshape(2, 2, 3)
    normals = np.cross(lines[:, 0], lines[:, 1])
    return [bool(np.prod(lines[k] @ normals[1 - k]) < 0.0) for k in (0, 1)]


@dataclass(frozen=True, eq=False)
class _Seen:
    """A tube seen from the side in both views, K times: `across` (3,) of both views, a point and the direction of its
    axis, the borders' planes inwards and their ends along the axis."""

    across: tuple[np.ndarray, np.ndarray]
    middle: np.ndarray
    way: np.ndarray
    focal: np.ndarray
    inward: tuple[np.ndarray, np.ndarray]
    ends: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(tube: Tube, through: np.ndarray, name: str) -> "_Seen":
        """`through` (K, 3): the axis's point lies beside it. Raises ReconstructionRefusedError."""
        drawn = [(tube[:, k, 0], _one_way(tube[:, k, 1:].reshape(-1, 2, 2, 3))) for k in (0, 1)]
        first, second = (_inward(focal, lines) for focal, lines in drawn)
        first_across, other = (unit(normals[:, 0] - normals[:, 1]) for normals in (first, second))
        sine = np.linalg.norm(np.cross(first_across, other), axis=-1)[:, None]
        if sine[0, 0] < _MIN_SINE:
            raise ReconstructionRefusedError(
                f"both images show the {name} from nearly the same side; draw both borders along it, or rotate the "
                "C-arm for one image"
            )
        axes = np.stack([first_across, other, np.cross(first_across, other) / sine], axis=1)
        on = np.stack([drawn[0][0], drawn[1][0], through], axis=1)
        middle = np.linalg.solve(axes, (axes * on).sum(axis=-1)[..., None])[..., 0]
        way = axes[:, 2]
        ends = tuple(_ends(focal, lines, middle, way) for focal, lines in drawn)
        return _Seen((first_across, other), middle, way, tube[:, :, 0], (first, second), (ends[0], ends[1]))

    def places(self, *points: np.ndarray) -> np.ndarray:
        """Return the places (K, N), mm along the axis, of N points (K, 3)."""
        return np.stack([((point - self.middle) * self.way).sum(axis=-1) for point in points], axis=1)

    def half(self, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the half-widths (K, S) in both views at points (K, S, 3) of the axis."""
        first, second = (
            ((axis - self.focal[:, k, None]) * normals[:, :1]).sum(axis=-1) for k, normals in enumerate(self.inward)
        )
        return first, second


def _seen(tube: Tube, name: str) -> _Seen:
    """Return tubes, with points of their axes beside the middle of what is drawn.

    Raises ReconstructionRefusedError."""
    (source, a), (other, b) = ((tube[:, k, 0], tube[:, k, 1:].mean(axis=1) - tube[:, k, 0]) for k in (0, 1))
    return _Seen.of(tube, nearest_approach(source, a, other, b).middle_mm, name)


def _middle_of_oval(tube: Tube, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle (K, 3) of the tube's drawn part, and the ray (K, 3) of the first image through it."""
    ray, other = (tube[:, k, 1:].mean(axis=1) - tube[:, k, 0] for k in (0, 1))
    if np.linalg.norm(np.cross(unit(ray), unit(other)), axis=-1)[0] < _MIN_SINE:
        raise ReconstructionRefusedError(
            f"both images show the {name} from nearly the same side; rotate the C-arm for one"
        )
    return nearest_approach(tube[:, 0, 0], ray, tube[:, 1, 0], other).middle_mm, unit(ray)


def _refuse_across(entry: np.ndarray, tip: np.ndarray, way: np.ndarray, name: str) -> np.ndarray:
    """Return the wire's direction (K, 3). Raises ReconstructionRefusedError where it does not run along the tube."""
    wire = unit(tip - entry)
    if abs(wire[0] @ way[0]) < _MIN_ALONG:
        raise ReconstructionRefusedError(
            f"the wire does not run along the {name} as it is drawn; pick entry and end again, or draw it again"
        )
    return wire


def _at(entry: np.ndarray, tip: np.ndarray, places: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the points (K, S, 3) of wires at places (K, S), given those of entry and tip, (K, 2)."""
    share = (along - places[:, :1]) / (places[:, 1:] - places[:, :1])
    return entry[:, None] + share[..., None] * (tip - entry)[:, None]


def _one_way(lines: np.ndarray) -> np.ndarray:
    """Return borders whose points run the same way."""
    way = np.diff(lines[0], axis=1)[:, 0]
    return lines if way[0] @ way[1] > 0.0 else np.stack([lines[:, 0], lines[:, 1, ::-1]], axis=1)


def _inward(focal: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return the unit normals (K, 2, 3) of the planes of a view's borders, each towards the other border."""
    normal = unit(np.cross(lines[:, :, 0] - focal[:, None], lines[:, :, 1] - focal[:, None]))
    other = lines[:, ::-1].mean(axis=2) - focal[:, None]
    return normal * np.sign((normal * other).sum(axis=-1))[..., None]


def _ends(focal: np.ndarray, lines: np.ndarray, middle: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return where an axis crosses the planes through a focal point and both borders' ends, (K, 2) mm along it."""
    normal = np.cross(lines[:, 0] - focal[:, None], lines[:, 1] - focal[:, None])
    return (normal * (focal - middle)[:, None]).sum(axis=-1) / (normal * way[:, None]).sum(axis=-1)


def _common(sections: list[np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return first and last place (K, 1) of the common part of sections (K, 2) of an axis."""
    first = np.max([section.min(axis=1) for section in sections], axis=0)[:, None]
    last = np.min([section.max(axis=1) for section in sections], axis=0)[:, None]
    if first[0, 0] >= last[0, 0]:
        raise ReconstructionRefusedError(
            f"the borders of the {name} in both images and the wire have no common part; draw them at the same place"
        )
    return first, last


def _from_ellipse(
    beside: tuple[np.ndarray, np.ndarray], half: tuple[np.ndarray, np.ndarray], cosine: np.ndarray, name: str
) -> np.ndarray:
    """Return the least distance (K,) of points from ellipses: how far they lie `beside` the middle (K, S) and the
    `half` widths (K, S) in two directions, with the `cosine` (K, 1) of the angle between these."""
    sine = np.sqrt(1.0 - cosine**2)
    (x, other), (a, b) = beside, half
    mean, part = (a**2 + b**2) / 2, (a**2 - b**2) / 2
    shortest2 = mean - np.abs(part) / sine
    if shortest2[0].min() <= 0.0:
        raise ReconstructionRefusedError(f"the borders in both images do not fit one {name}; draw them again")
    y, cross = (other - x * cosine) / sine, -part * cosine / sine
    share2 = ((mean - part) * x**2 - 2 * cross * x * y + (mean + part) * y**2) / (mean**2 - (part / sine) ** 2)
    return (np.sqrt(shortest2) * (1.0 - np.sqrt(share2))).min(axis=1)
