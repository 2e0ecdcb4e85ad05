"""A guide wire drilled into the bone of the images: thrust, skiving, bending, the reading of the force sensor.

The bone is the scene's own volumes, so cortex, cancellous bone, their texture, a bore and a fracture are where the
images show them. Lengths mm, forces N, points in MCS.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import hypot, inf, sqrt

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.kernels import kernel
from sightline.errors import SetUpError
from sightline.imaging.volumes.volume import Volume
from sightline.twin.objects.things import WIRE_DIAMETER_MM

# Values [ours] without a source: physics.md, Drilling. Thrust: 35 N (d/2.5)(f_rev/0.06)^0.6 (density/1.9)².
THRUST_N, FEED_PER_REV_MM, FEED_POWER, CORTICAL_G_CM3 = 35.0, 0.06, 0.6, 1.9
REVS_PER_S = 1000 / 60
AXIAL_N_PER_MM = 100.0  # wire in its chuck against bone
NOISE_SHARE, NOISE_N = 0.1, 0.3  # of the force sensor, s.d.
DENSITY_G_CM3 = {"bone": CORTICAL_G_CM3, "composite": 1.64}  # at a share of 1; glass-filled epoxy
STEEL_N_PER_MM2 = 193e3  # physics.md
MAX_SLOPE = 3.0  # the flank of a trocar tip 1.5 diameters long (things.py) cannot rest on a steeper slope
FRICTION = 0.3  # steel on wet bone
MIN_FREE_MM = 5.0  # minimum free length, from the play of the guide
# A sleeve that ends within GRIP_MM of the point where bone holds the wire stands on the bone, and its teeth grip. Its
# mouth stays there; an arm with compliance or play rotates it about its mouth (8 mm across, on 45° of cortex).
GRIP_MM, SLEEVE_LENGTH_MM = 10.0, 80.0
HELD_SHARE = 0.3  # with this share of cortical bone all round the tip, the tip is in a hole and follows it
SLIDE_MM = 0.02  # maximum lateral step, so that the tip does not jump over bone
_AROUND = 8  # density samples on a ring
_ANGLES = 2 * np.pi * np.arange(_AROUND) / _AROUND
_RIM = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(_AROUND)], axis=1)  # of a tip of radius 1, tool axes
_AIR_N = 1e-3  # a smaller resistance counts as air


@dataclass(frozen=True, eq=False)
class Bone:
    """The bone that a wire is drilled into: volumes of a scene, CFCS, at the pose `T_mcs_cfcs`. Materials that are not
    in DENSITY_G_CM3 offer no resistance. `metal`: says which points (N, 3), CFCS, lie in an implant, which is not cut.
    Raises SetUpError if no volume's material is in it."""

    volumes: tuple[Volume, ...]
    T_mcs_cfcs: RigidTransform
    metal: Callable[[np.ndarray], np.ndarray] | None = None
    _index: tuple[np.ndarray, ...] = field(init=False)

    def __post_init__(self) -> None:
        solid = [volume for volume in self.volumes if volume.material in DENSITY_G_CM3]
        if not solid:
            raise SetUpError(f"no volume is of a material that can be drilled ({', '.join(DENSITY_G_CM3)})")
        object.__setattr__(self, "volumes", tuple(solid))
        back = self.T_mcs_cfcs.inv().as_matrix()
        index = []
        for volume in solid:  # MCS to voxel indices
            to_voxels = volume.axes / volume.voxel_mm[:, None]
            shift = to_voxels @ (back[:3, 3] - volume.origin_mm)
            index.append(np.column_stack([to_voxels @ back[:3, :3], shift]))
        object.__setattr__(self, "_index", tuple(np.ascontiguousarray(to_voxels_) for to_voxels_ in index))

    def density(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the density (N,) of mineralised tissue, g/cm³, at points (N, 3), MCS; 0 outside bone."""
        total = np.zeros(len(xyz_mm))
        for volume, index in zip(self.volumes, self._index, strict=True):
            _add_density(total, volume.values, index, xyz_mm, DENSITY_G_CM3[volume.material])
        return total

    def is_metal(self, xyz_mm: np.ndarray) -> bool:
        """Return whether any of the points (N, 3), MCS, lies in an implant."""
        return self.metal is not None and bool(self.metal(self.T_mcs_cfcs.inv().apply(xyz_mm)).any())

    def first_met_mm(self, start_mm: np.ndarray, end_mm: np.ndarray, density: float = 0.5) -> float:
        """Return the distance from `start_mm` towards `end_mm`, (3,), at which the line meets bone of this density.

        Raises SetUpError if it meets none.
        """
        start, end = np.asarray(start_mm, dtype=np.float64), np.asarray(end_mm, dtype=np.float64)
        length = float(np.linalg.norm(end - start))
        along = np.arange(0.0, length, 0.05)
        met = np.flatnonzero(self.density(start + along[:, None] * (end - start) / length) >= density)
        if not len(met):
            raise SetUpError("the line meets no bone")
        return float(along[met[0]])


class Wire:
    """State of a wire in a guide, with its tip in air or bone.

    Axially: a spring from chuck to tip, whose tip cuts at the rate that the thrust allows. Laterally: a cantilever from
    the guide's mouth, pushed down the slope of the bone it touches; once bone surrounds the tip, the wire is pinned at
    its entry and the tip advances along its own slope. A hole that it was drawn out of stays open. Quasi-static: no
    vibration, no side-cutting, no heat. Metal that
    the tip's rim touches is not cut and does not guide: the thrust rises with the feed, until supervision stops it.
    """

    def __init__(self, bone: Bone, diameter_mm: float = WIRE_DIAMETER_MM) -> None:
        self.bone = bone
        self.radius_mm = diameter_mm / 2
        self.bending_n_mm2 = STEEL_N_PER_MM2 * np.pi * diameter_mm**4 / 64
        self.thrust_scale_n = THRUST_N * diameter_mm / WIRE_DIAMETER_MM
        self.thrust_n = 0.0
        self.tip_mm = np.zeros(3)
        self.slope = np.zeros(3)  # of the tip against the axis, across it
        self._gripped: tuple[np.ndarray, np.ndarray] | None = None  # slope and offset when a sleeve gripped the bone
        self.entry_mm: np.ndarray | None = None  # point at which bone holds the wire
        self._offset = np.zeros(3)  # of the tip from the axis, while the wire is free
        self._squeeze_mm = 0.0  # compression of the axial spring
        self._deepest_mm = 0.0  # beyond the entry point
        self._bottom_mm = np.zeros(3)  # the deepest tip in the bone
        self._holes: list[tuple[np.ndarray, np.ndarray]] = []  # entry and bottom of those it was drawn out of
        self._last: np.ndarray | None = None  # last tip of the straight wire
        self._samples, self._weights = _density_samples(self.radius_mm)
        _squeezed(1.0, 1.0, 1.0)  # compile now, not in a control loop at first contact

    def step(self, straight_mm: np.ndarray, axes: np.ndarray, free_mm: float, turning: bool, dt_s: float) -> float:
        """Advance the state by `dt_s` and return the thrust, N.

        `straight_mm` (3,): where the tip of a straight wire would be now. `axes` (3, 3): rows x, y, z of the tool, z
        along the wire. `free_mm`: from the guide's mouth to the tip, negative within the guide.
        """
        along = axes[2]
        moved = 0.0 if self._last is None else float((straight_mm - self._last) @ along)
        self._last = straight_mm
        free = max(free_mm, MIN_FREE_MM)
        if self.entry_mm is None:
            self.tip_mm = straight_mm - self._squeeze_mm * along + self._offset
        density = self._density(self.tip_mm + self._samples @ axes)
        front, x, y, axial = (self._weights @ density).tolist()
        before = self._squeeze_mm
        if self.bone.metal is not None and self.bone.is_metal(self.tip_mm + self.radius_mm * _RIM @ axes):
            self._cut(moved, inf, turning, dt_s)
        else:
            self._cut(moved, 0.0 if self._in_own_hole(along) else front, turning, dt_s)
        advance = moved - (self._squeeze_mm - before)
        if self.entry_mm is None:
            self._skive(x * axes[0] + y * axes[1], axial, axes, free if free_mm > 0 else 0.0)
            self.tip_mm = straight_mm - self._squeeze_mm * along + self._offset
            if density[-_AROUND:].min() > HELD_SHARE * CORTICAL_G_CM3:
                self.entry_mm = self._bottom_mm = self.tip_mm
                self._deepest_mm = 0.0
                grips = 0.0 < free_mm < GRIP_MM
                self._gripped = (1.5 * self._offset / free, self._offset) if grips else None
        else:
            self._follow(self.entry_mm, straight_mm, along, free, advance)
        return self.thrust_n

    def _density(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the density (N,) of what is left of the bone at points (N, 3)."""
        density = self.bone.density(xyz_mm)
        for entry, bottom in self._holes:
            length = float(np.linalg.norm(bottom - entry))
            axis, off = (bottom - entry) / max(length, 1e-9), xyz_mm - entry
            along = off @ axis
            aside = np.linalg.norm(off - along[:, None] * axis, axis=1)
            # An oblique surface lies before the point at which bone held the wire.
            density[(along > -GRIP_MM) & (along < length) & (aside <= self.radius_mm)] = 0.0
        return density

    def _in_own_hole(self, along: np.ndarray) -> bool:
        return self.entry_mm is not None and float((self.tip_mm - self.entry_mm) @ along) < self._deepest_mm - 0.02

    def _cut(self, moved_mm: float, density: float, turning: bool, dt_s: float) -> None:
        """Relax the spring by the depth cut: solve squeeze + dt feed(thrust) = previous squeeze (implicit step)."""
        resists = self.thrust_scale_n * (density / CORTICAL_G_CM3) ** 2
        squeeze = max(self._squeeze_mm + moved_mm, 0.0)
        if resists < _AIR_N:
            squeeze = 0.0
        elif turning and squeeze > 0.0 and resists < inf:
            power = 1 / FEED_POWER
            rate = dt_s * REVS_PER_S * FEED_PER_REV_MM * (AXIAL_N_PER_MM / resists) ** power
            squeeze = _squeezed(squeeze, rate, power)
        self._squeeze_mm, self.thrust_n = squeeze, AXIAL_N_PER_MM * squeeze

    def _skive(self, lateral: np.ndarray, axial: float, axes: np.ndarray, free_mm: float) -> None:
        """Move the tip down the slope until thrust and bending balance, unless bone beside it is in the way."""
        steep = sqrt(lateral @ lateral)
        push = np.zeros(3)
        if self.thrust_n > 0.0 and steep > 0.0:
            slope = min(steep / axial, MAX_SLOPE) if axial > 0 else MAX_SLOPE
            side = max(slope - FRICTION, 0.0) / (1 + FRICTION * slope)  # tan(angle - friction angle)
            push = -self.thrust_n * side * lateral / steep
        move = push * free_mm**3 / (3 * self.bending_n_mm2) - self._offset
        size = sqrt(move @ move)
        if size > 0.0:
            move *= min(SLIDE_MM / size, 1.0)
            beside = self.tip_mm + move * (1.4 * self.radius_mm / sqrt(move @ move)) - self.radius_mm * axes[2]
            blocked = float(self.bone.density(beside[None])[0]) / (HELD_SHARE * CORTICAL_G_CM3)
            self._offset = self._offset + max(1.0 - blocked, 0.0) * move
        self._offset = self._offset - (self._offset @ axes[2]) * axes[2]
        self.slope = 1.5 * self._offset / free_mm if free_mm > 0 else np.zeros(3)

    def _follow(
        self, entry: np.ndarray, straight_mm: np.ndarray, along: np.ndarray, free_mm: float, advance_mm: float
    ) -> None:
        """Advance a wire pinned at `entry` (3,): beyond it the wire is straight, with the slope of its bent part."""
        across = entry - straight_mm
        across = across - (across @ along) * along
        inside = float((self.tip_mm - entry) @ along)
        if self._gripped is None:
            self.slope = 1.5 * across / max(free_mm - inside, MIN_FREE_MM)
        else:
            slope, offset = self._gripped
            self.slope = slope + (across - offset) / SLEEVE_LENGTH_MM
        self.tip_mm = self.tip_mm + advance_mm * (along + self.slope)
        inside += advance_mm
        if inside > self._deepest_mm:
            self._deepest_mm, self._bottom_mm = inside, self.tip_mm
        if inside < 0.0:  # pulled out
            self._holes.append((entry, self._bottom_mm))
            self.entry_mm = None
            offset = self.tip_mm - straight_mm
            self._offset = offset - (offset @ along) * along


def _density_samples(radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (19, 3), tool axes, at which density is sampled, and the weights (4, 19) for the mean over the
    tip and the gradient along x, y, z. The last eight points lie around the wire behind the tip."""
    ring, disc = _RIM, 0.8 * radius_mm
    along = np.array([[0.0, 0.0, disc]])
    behind = 1.4 * radius_mm * ring - [0.0, 0.0, radius_mm]
    points = np.concatenate([np.zeros((1, 3)), disc * ring, along, -along, behind])
    weights = np.zeros((4, len(points)))
    weights[0, : 1 + _AROUND] = 1 / (1 + _AROUND)
    # Scaled so that lateral and axial gradients are equal for a face at 45° through the tip.
    weights[1:3, 1 : 1 + _AROUND] = ring[:, :2].T / (disc * np.abs(ring[:, 0]).sum())
    weights[3, 1 + _AROUND : 3 + _AROUND] = [0.5 / disc, -0.5 / disc]
    return points, weights


def sensed(thrust_n: float, rng: np.random.Generator) -> float:
    """Draw a reading of the force sensor, N."""
    return thrust_n + hypot(NOISE_SHARE * thrust_n, NOISE_N) * float(rng.standard_normal())


@kernel()
def _squeezed(total: float, rate: float, power: float) -> float:
    """Return the root y in (0, total) of y + rate y^power = total, by Newton's method from above (convex function)."""
    y = total
    for _ in range(60):
        step = (y + rate * y**power - total) / (1 + rate * power * y ** (power - 1))
        y -= step
        if step < 1e-12 * total:
            break
    return max(y, 0.0)


@kernel()
def _add_density(total: np.ndarray, values: np.ndarray, index: np.ndarray, points: np.ndarray, whole: float) -> None:
    """Add trilinear shares times the density `whole` of the solid material; nothing outside the volume."""
    for n in range(len(points)):
        x = index[0, 0] * points[n, 0] + index[0, 1] * points[n, 1] + index[0, 2] * points[n, 2] + index[0, 3]
        y = index[1, 0] * points[n, 0] + index[1, 1] * points[n, 1] + index[1, 2] * points[n, 2] + index[1, 3]
        z = index[2, 0] * points[n, 0] + index[2, 1] * points[n, 1] + index[2, 2] * points[n, 2] + index[2, 3]
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        if i < 0 or j < 0 or k < 0 or i + 1 >= values.shape[0] or j + 1 >= values.shape[1] or k + 1 >= values.shape[2]:
            continue
        a, b, c = x - i, y - j, z - k
        for di in range(2):
            for dj in range(2):
                for dk in range(2):
                    w = (a if di else 1 - a) * (b if dj else 1 - b) * (c if dk else 1 - c)
                    total[n] += whole * w * values[i + di, j + dj, k + dk]
