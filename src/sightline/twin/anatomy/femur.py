"""A parametric proximal femur with its socket, as a density volume.

Anatomical coordinates: origin at the centre of the femoral head, (lateral, caudal, anterior), mm. In CFCS lateral is
+X, anterior +Z, and caudal +Y for a right hip, -Y for a left one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
from scipy.optimize import root_scalar

from sightline.common.kernels import kernel
from sightline.common.threads import in_parts
from sightline.errors import SetUpError
from sightline.imaging.volumes.volume import Volume
from sightline.twin.anatomy.shapes import blend, ellipsoid_distance, step, texture

VOXEL_MM = 0.75
SHORT_MM = 8.0  # distance of the ideal wire's tip from the surface of the head: 5-10 mm [physics.md, Planning values]
CORTEX_GAP_MM = 3.0  # between a cannulated screw and the neck's surface [ours, typical]
NARROWEST = 0.96  # radius of the neck where it is narrowest, over `neck_radius_mm`
# The voxelised box, anatomical coordinates: the part of a hip that a field of 215 mm at the detector can show.
BOX_LOW_MM = np.array([-110.0, -110.0, -48.0])
BOX_HIGH_MM = np.array([76.0, 106.0, 42.0])
# Its end beside a solid: images are aimed caudal of the hip, and their panel shows 127 mm along a diagonal [calc].
LONG_HIGH_MM = np.array([76.0, 205.0, 42.0])
# Trochanters as ellipsoids: centre from the base, half-axes [ours].
LESSER_MM, LESSER_HALF_MM = np.array([-13.0, 30.0, -12.0]), np.array([9.0, 12.0, 9.0])
GREATER_MM, GREATER_HALF_MM = np.array([7.0, -14.0, -5.0]), np.array([13.0, 25.0, 17.0])
# Share of cortical bone that adds one CT number to soft tissue at 60 keV: mu_water / 1000 / (mu_bone - mu_tissue).
BONE_PER_HU = 0.206e-3 / (0.0604 - 0.0217) / 10


@dataclass(frozen=True)
class Femur:
    """A proximal femur. Lengths mm, angles degrees.

    Defaults are the middle of the ranges in physics.md, section Femur [src several CT series].
    """

    head_radius_mm: float = 23.0
    neck_radius_mm: float = 16.0
    neck_length_mm: float = 52.0  # centre of the head to the axis of the shaft [ours, typical]
    neck_shaft_deg: float = 128.0
    anteversion_deg: float = 12.0
    shaft_radius_mm: float = 15.0
    canal_radius_mm: float = 7.0
    cancellous_hu: float = 132.0  # neck; normal 132, osteopenic 99, osteoporotic 41 [src]
    socket: bool = True  # include the acetabulum and the pelvis above and medial of it

    @property
    def towards_head(self) -> np.ndarray:
        """Unit vector (3,) along the neck, anatomical coordinates."""
        return neck_axis(self.neck_shaft_deg, self.anteversion_deg)

    @property
    def base_mm(self) -> np.ndarray:
        """Intersection (3,) of the axes of neck and shaft, anatomical coordinates."""
        return -self.neck_length_mm * self.towards_head

    @property
    def lesser_trochanter_mm(self) -> np.ndarray:
        """Tip (3,) of the lesser trochanter, medial and dorsal of the shaft, anatomical coordinates."""
        return self.base_mm + LESSER_MM + np.array([-1.0, 0.0, -1.0]) * LESSER_HALF_MM / np.sqrt(2)

    @property
    def greater_trochanter_mm(self) -> np.ndarray:
        """Most cranial point (3,) of the greater trochanter, anatomical coordinates."""
        return self.base_mm + GREATER_MM + np.array([0.0, -1.0, 0.0]) * GREATER_HALF_MM

    def wire_mm(self, angle_deg: float = 135.0, short_mm: float = SHORT_MM) -> tuple[np.ndarray, np.ndarray]:
        """Return entry and end point of the ideal guide wire, anatomical coordinates.

        The wire passes the centre of the head at `angle_deg` to the shaft (the paper's 135°), in the plane of the neck,
        from the lateral surface to `short_mm` below the surface of the head (5-10 mm: physics.md, Planning values).
        Raises SetUpError if it does not meet the lateral cortex.
        """
        along = neck_axis(angle_deg, self.anteversion_deg)
        return self.entry_mm(np.zeros(3), along), (self.head_radius_mm - short_mm) * along

    def cannulated_wires_mm(self, screw_mm: float = 7.3, short_mm: float = 5.0) -> np.ndarray:
        """Return entry and end (3, 2, 3) of the wires of three cannulated screws, parallel to the neck, anatomical
        coordinates: one inferior, two superior (posterior and anterior), as an inverted triangle with equal sides.

        Screws of `screw_mm` stay CORTEX_GAP_MM from the neck's surface where
        it is narrowest. The ends lie `short_mm` below the head's surface. Raises SetUpError.
        """
        along = self.towards_head
        down = np.array([0.0, 1.0, 0.0]) - along[1] * along
        down /= np.linalg.norm(down)
        spread = NARROWEST * self.neck_radius_mm - CORTEX_GAP_MM - screw_mm / 2
        forwards = np.cross(along, down)
        forwards *= np.sign(forwards[2])
        wires = []
        for turn in (0.0, radians(240.0), radians(120.0)):
            through = spread * (cos(turn) * down + sin(turn) * forwards)
            depth = np.sqrt((self.head_radius_mm - short_mm) ** 2 - spread**2)
            wires.append([self.entry_mm(through, along), through + depth * along])
        return np.array(wires)

    def entry_mm(self, through_mm: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return where the line through a point (3,) in the head, along a unit vector (3,) towards the head, meets the
        lateral surface, anatomical coordinates. Raises SetUpError."""
        height = self._height(through_mm, -along)
        inside = next((b for b in np.arange(110.0, 30.0, -1.0) if height(b) < 0), None)
        if inside is None:
            raise SetUpError("the wire does not meet this femur's lateral cortex; use another angle")
        back = root_scalar(height, bracket=(inside, inside + 1.0), xtol=1e-9).root
        return through_mm - back * along

    def surface_mm(self, inside_mm: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the first point (3,) of the surface on a ray from a point (3,) inside the bone, along a unit vector
        (3,), anatomical coordinates. Raises SetUpError if there is none within 60 mm."""
        height = self._height(inside_mm, direction)
        outside = next((at for at in np.arange(1.0, 60.0) if height(at) > 0), None)
        if outside is None or height(0.0) > 0:
            raise SetUpError("the ray does not leave this femur within 60 mm; start it inside the bone")
        return inside_mm + root_scalar(height, bracket=(0.0, outside), xtol=1e-9).root * direction

    def _height(self, start_mm: np.ndarray, direction: np.ndarray) -> Callable[[float], float]:
        """Return the distance from the surface as a function of the way along a ray."""
        numbers = self.numbers()
        return lambda way_mm: float(_femur_distance(start_mm + way_mm * direction, numbers)[0])

    def numbers(self) -> np.ndarray:
        """Return the parameters of the compiled kernels."""
        sizes = [self.head_radius_mm, self.neck_radius_mm, self.shaft_radius_mm, self.canal_radius_mm]
        hu = self.cancellous_hu * BONE_PER_HU
        return np.array([*sizes, *self.base_mm, hu, float(self.socket)])


def neck_axis(neck_shaft_deg: float, anteversion_deg: float) -> np.ndarray:
    """Return the unit vector (3,) towards the head, anatomical coordinates, at these angles."""
    across, version = sin(radians(neck_shaft_deg)), radians(anteversion_deg)
    return np.array([-across * cos(version), cos(radians(neck_shaft_deg)), across * sin(version)])


def draw_femur(rng: np.random.Generator) -> Femur:
    """Draw a femur within the ranges of physics.md, section Femur."""
    return Femur(
        head_radius_mm=rng.uniform(20, 26),
        neck_radius_mm=rng.uniform(30, 35) / 2,
        neck_length_mm=rng.uniform(48, 56),
        neck_shaft_deg=rng.uniform(122, 133),
        anteversion_deg=rng.uniform(10, 14),
        cancellous_hu=float(rng.choice([132.0, 99.0, 41.0])),
    )


def to_cfcs(anatomical_mm: np.ndarray, side: str, head_mm: np.ndarray) -> np.ndarray:
    """Convert anatomical coordinates (..., 3) to CFCS, with the centre of the head at `head_mm` (3,)."""
    return np.asarray(anatomical_mm) * [1.0, 1.0 if side == "right" else -1.0, 1.0] + head_mm


def voxelise(
    femur: Femur, side: str, head_mm: np.ndarray, rng: np.random.Generator | None, high_mm: np.ndarray = BOX_HIGH_MM
) -> Volume:
    """Return the bone up to `high_mm` as a volume in CFCS, with a random trabecular texture unless `rng` is None."""
    nx, ny, nz = (int(n) for n in np.ceil((high_mm - BOX_LOW_MM) / VOXEL_MM))
    tile = np.zeros((1, 1, 1), dtype=np.float32) if rng is None else texture(rng)
    values = np.zeros((nx, ny, nz), dtype=np.float32)
    in_parts(_fill, BOX_LOW_MM, femur.numbers(), tile, values)
    return placed(values, BOX_LOW_MM, VOXEL_MM, side, head_mm)


def placed(values: np.ndarray, low_mm: np.ndarray, voxel_mm: float, side: str, origin_mm: np.ndarray) -> Volume:
    """Return the volume, CFCS, of voxels (nx, ny, nz) whose first is at `low_mm` (3,), anatomical coordinates, with the
    anatomical origin at `origin_mm` (3,)."""
    low = low_mm
    if side == "left":
        values = np.ascontiguousarray(values[:, ::-1])
        low = np.array([low[0], -(low[1] + (values.shape[1] - 1) * voxel_mm), low[2]])
    return Volume(values, low + origin_mm, np.full(3, voxel_mm))


@kernel()
def _femur_distance(p: np.ndarray, n: np.ndarray) -> tuple[float, float]:
    """Return the signed distance from the femur's surface (negative inside), and from that of the head alone."""
    rh, rn, rs = n[0], n[1], n[2]
    bx, by, bz = n[4], n[5], n[6]
    length = np.sqrt(bx * bx + by * by + bz * bz)
    head = np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2) - rh
    t = min(max((p[0] * bx + p[1] * by + p[2] * bz) / length**2, 0.0), 1.0)
    radius = rn * (NARROWEST + 0.9 * (t - 0.45) ** 2)  # narrowest in the middle
    neck = np.sqrt((p[0] - t * bx) ** 2 + (p[1] - t * by) ** 2 + (p[2] - t * bz) ** 2) - radius
    x, y, z = p[0] - bx, p[1] - by, p[2] - bz
    flare = 1.0 + 0.28 * np.exp(-((max(y, 0.0) / 28.0) ** 2))  # wider towards the trochanters
    shaft = np.sqrt(x * x + z * z * 1.1 + min(y, 0.0) ** 2) - rs * flare
    greater = ellipsoid_distance(
        (x - GREATER_MM[0], y - GREATER_MM[1], z - GREATER_MM[2]),
        (GREATER_HALF_MM[0], GREATER_HALF_MM[1], GREATER_HALF_MM[2]),
    )
    lesser = ellipsoid_distance(
        (x - LESSER_MM[0], y - LESSER_MM[1], z - LESSER_MM[2]),
        (LESSER_HALF_MM[0], LESSER_HALF_MM[1], LESSER_HALF_MM[2]),
    )
    body = blend(blend(shaft, greater, 10.0), lesser, 9.0)
    return blend(blend(neck, head, 6.0), body, 14.0), head


@kernel()
def _medial_limit(n: np.ndarray) -> float:
    """Return x below which a femur with the numbers `n` leaves every voxel empty.

    Head, neck, shaft and trochanters end 12 mm lateral of it; where they blend, bone reaches 9.75 mm further at most.
    """
    return -12.0 - max(n[0], 1.25 * n[1], 1.3 * n[2] - n[4], LESSER_HALF_MM[0] - LESSER_MM[0] - n[4])


@kernel()
def _without_socket(p: np.ndarray, head: float) -> bool:
    """Return whether a point is so far lateral or caudal of the head that neither socket nor pelvis reaches it."""
    return head > 6.5 and (p[0] > 40.0 or p[1] > 40.0)


@kernel()
def _bone(p: np.ndarray, n: np.ndarray, texture: float, medial: float) -> float:
    """Return the share of cortical bone at a point. `medial`: see `_medial_limit`."""
    if p[0] < medial:
        share, head = 0.0, np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2) - n[0]
    else:
        share, head = _femur_share(p, n, texture)
    if n[8] > 0.5 and not _without_socket(p, head):
        share = max(share, _socket(p, head, texture, n[7]))
    return share


@kernel()
def _femur_share(p: np.ndarray, n: np.ndarray, texture: float) -> tuple[float, float]:
    """Return the share of cortical bone without the socket, and the distance from the head's surface. The cortex is
    1 mm thick on the head, 2 mm on the neck, and increases along the shaft down to the canal (5 mm laterally)
    [ours, typical]; inside is cancellous bone, denser in the head.
    """
    distance, head = _femur_distance(p, n)
    down = p[1] - n[5]
    shaft = min(max((down - 5.0) / 45.0, 0.0), 1.0)
    cortex = 1.0 + step(head - 2.0, 6.0) + shaft * (n[2] - n[3] - 2.0)
    spongy = n[7] * (1.0 + 1.2 * step(-head, 16.0)) * (1.0 - shaft) * (1.0 + 0.7 * texture)
    within = step(-distance, VOXEL_MM)
    hard = within - step(-distance - cortex, VOXEL_MM)
    return max(spongy, 0.0) * (within - hard) + (0.92 + 0.03 * texture) * hard, head


@kernel()
def _socket(p: np.ndarray, head: float, texture: float, spongy: float) -> float:
    """Return the share of bone of the acetabulum (a shell 3.5 mm outside the head, open laterally and caudally) and of
    the bone that supports it."""
    opening = 0.72 * p[0] + 0.69 * p[1]  # along the neck
    gap = head - 3.5
    cup = min(step(gap, VOXEL_MM), step(-opening - 2.0, VOXEL_MM))
    shell = min(cup, step(2.5 - gap, VOXEL_MM))
    ilium = ellipsoid_distance((p[0] + 28.0 + 0.35 * (p[1] + 52.0), p[1] + 52.0, p[2] + 2.0), (28.0, 62.0, 15.0))
    pubis = ellipsoid_distance((p[0] + 58.0, p[1] - 8.0, p[2] - 10.0), (42.0, 13.0, 10.0))
    bearing = blend(ilium, pubis, 14.0)
    within = min(step(-bearing, VOXEL_MM), step(gap, VOXEL_MM))
    hard = min(within, 1.0 - step(-bearing - 1.5, VOXEL_MM))
    fill = max(spongy * (1.3 + 0.7 * texture), 0.0) * within
    return max(0.85 * max(shell, hard), fill)


@kernel(nogil=True)
def _fill(part, parts, low, n, tile, values):  # noqa: PLR0917
    """Fill in the share of bone at every voxel; the outermost voxels stay empty."""
    tx, ty, tz = tile.shape
    p, medial = np.empty(3), _medial_limit(n)
    for i in range(1 + part, values.shape[0] - 1, parts):
        for j in range(1, values.shape[1] - 1):
            for k in range(1, values.shape[2] - 1):
                p[0], p[1], p[2] = low[0] + VOXEL_MM * i, low[1] + VOXEL_MM * j, low[2] + VOXEL_MM * k
                texture = float(tile[i % tx, j % ty, k % tz])
                values[i, j, k] = _bone(p, n, texture, medial)
