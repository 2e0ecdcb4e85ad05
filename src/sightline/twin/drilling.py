"""A guide wire drilled into the bone that the images show: thrust, skiving, bending, what the force sensor reads.

The bone is the scene's own volumes, so cortex, cancellous bone, their texture, a bore and a fracture are where the
images have them. Lengths mm, forces N, places in MCS.
"""

from dataclasses import dataclass, field
from math import hypot, sqrt

import numpy as np
from numba import njit
from scipy.spatial.transform import RigidTransform

from sightline.errors import SetUpError
from sightline.twin.implants import WIRE_MM
from sightline.twin.volumes import Volume

# Thrust (physics.md, Drilling [ours]): 35 N (d/2.5)(f_rev/0.06)^0.6 (density/1.9)².
THRUST_N, FEED_PER_REV_MM, FEED_POWER, CORTICAL_G_CM3 = 35.0, 0.06, 0.6, 1.9
REVS_PER_S = 1000 / 60  # physics.md [ours]
AXIAL_N_PER_MM = 100.0  # wire in its chuck against bone: physics.md [ours]
NOISE_SHARE, NOISE_N = 0.1, 0.3  # of the force sensor, s.d.: physics.md [ours]
DENSITY_G_CM3 = {"bone": CORTICAL_G_CM3, "composite": 1.64}  # where the share is 1; glass-filled epoxy [mem]
STEEL_N_PER_MM2 = 193e3  # physics.md
STEEPEST = 3.0  # the side of a trocar tip 1.5 diameters long (implants.py) rests on no steeper slope
FRICTION = 0.3  # steel on wet bone [mem]
SHORTEST_FREE_MM = 5.0  # free length that the play of the guide leaves at least [ours]
# A sleeve that ends so near to where bone takes hold of the wire stands on the bone, and its teeth grip: its mouth
# stays, and an arm that gives or plays turns it about there, over its length [ours: 8 mm across, on 45° of cortex].
GRIP_MM, SLEEVE_LENGTH_MM = 10.0, 80.0
HELD_SHARE = 0.3  # of cortical bone all round the tip: it is in a hole and goes on along itself [ours]
SLIDE_MM = 0.02  # sideways in one step at most: the tip does not jump over bone [ours]
_AROUND = 8
_AIR_N = 1e-3  # bone that resists less is none


@dataclass(frozen=True, eq=False)
class Bone:
    """What the wire meets: volumes of a scene, CFCS, and where they are, `T_mcs_cfcs`. Materials without a density
    in DENSITY_G_CM3 let the wire pass. Raises SetUpError where none has one."""

    volumes: tuple[Volume, ...]
    T_mcs_cfcs: RigidTransform
    _index: tuple[np.ndarray, ...] = field(init=False)

    def __post_init__(self) -> None:
        solid = [volume for volume in self.volumes if volume.material in DENSITY_G_CM3]
        if not solid:
            raise SetUpError(f"no volume is of a material that is drilled ({', '.join(DENSITY_G_CM3)})")
        object.__setattr__(self, "volumes", tuple(solid))
        back = self.T_mcs_cfcs.inv().as_matrix()
        index = []
        for volume in solid:  # MCS to indices of voxels
            turn = volume.axes / volume.voxel_mm[:, None]
            index.append(np.column_stack([turn @ back[:3, :3], turn @ (back[:3, 3] - volume.origin_mm)]))
        object.__setattr__(self, "_index", tuple(np.ascontiguousarray(one) for one in index))

    def density(self, xyz_mm: np.ndarray) -> np.ndarray:
        """(N,) g/cm³ of mineralised tissue at points (N, 3) MCS; 0 outside of bone."""
        total = np.zeros(len(xyz_mm))
        for volume, index in zip(self.volumes, self._index, strict=True):
            _add_density(total, volume.values, index, xyz_mm, DENSITY_G_CM3[volume.material])
        return total

    def first_met_mm(self, start_mm: np.ndarray, end_mm: np.ndarray, density: float = 0.5) -> float:
        """How far from start (3,) towards end (3,) the line meets bone of this density. Raises SetUpError."""
        start, end = np.asarray(start_mm, dtype=np.float64), np.asarray(end_mm, dtype=np.float64)
        length = float(np.linalg.norm(end - start))
        along = np.arange(0.0, length, 0.05)
        met = np.flatnonzero(self.density(start + along[:, None] * (end - start) / length) >= density)
        if not len(met):
            raise SetUpError("the line meets no bone")
        return float(along[met[0]])


class Wire:
    """A wire in a guide, its tip in air or bone: a state that is stepped.

    Along itself: a spring from chuck to tip, whose tip cuts as fast as the thrust lets it. Across: a cantilever from
    the guide's mouth, pushed down the slope of the bone it touches; once bone holds it all round, pinned where it
    entered, and the tip goes on along its own slope. Quasi-static: no vibration, no side-cutting, no heat.
    """

    def __init__(self, bone: Bone, diameter_mm: float = WIRE_MM) -> None:
        self.bone = bone
        self.radius_mm = diameter_mm / 2
        self.bending_n_mm2 = STEEL_N_PER_MM2 * np.pi * diameter_mm**4 / 64
        self.thrust_scale_n = THRUST_N * diameter_mm / WIRE_MM
        self.thrust_n = 0.0
        self.tip_mm = np.zeros(3)
        self.slope = np.zeros(3)  # of the tip against the axis, across it
        self._gripped: tuple[np.ndarray, np.ndarray] | None = None  # with a gripping sleeve: slope, axis's offset then
        self.entry_mm: np.ndarray | None = None  # where bone holds it, once it does
        self._offset = np.zeros(3)  # of the tip from the axis, while nothing holds it
        self._squeeze_mm = 0.0
        self._deepest_mm = 0.0  # beyond the entry point
        self._last: np.ndarray | None = None  # tip of the straight wire
        self._feelers, self._feelings = _feelers(self.radius_mm)
        _squeezed(1.0, 1.0, 1.0)  # compiled here, not in the loop of a robot at its first touch

    def step(self, straight_mm: np.ndarray, axes: np.ndarray, free_mm: float, turning: bool, dt_s: float) -> float:
        """Thrust, N, after `dt_s`. `straight_mm` (3,): where the tip of a straight wire is now; `axes` (3, 3): rows x,
        y, z of the tool, z the wire's axis; `free_mm` from the guide's mouth to the tip, negative within the guide."""
        along = axes[2]
        moved = 0.0 if self._last is None else float((straight_mm - self._last) @ along)
        self._last = straight_mm
        free = max(free_mm, SHORTEST_FREE_MM)
        if self.entry_mm is None:
            self.tip_mm = straight_mm - self._squeeze_mm * along + self._offset
        front, lateral, axial, ring = self._feel(axes)
        before = self._squeeze_mm
        self._cut(moved, 0.0 if self._in_own_hole(along) else front, turning, dt_s)
        advance = moved - (self._squeeze_mm - before)
        if self.entry_mm is None:
            self._skive(lateral, axial, axes, free if free_mm > 0 else 0.0)
            self.tip_mm = straight_mm - self._squeeze_mm * along + self._offset
            if ring.min() > HELD_SHARE * CORTICAL_G_CM3:
                self.entry_mm, self._deepest_mm = self.tip_mm, 0.0
                grips = 0.0 < free_mm < GRIP_MM
                self._gripped = (1.5 * self._offset / free, self._offset) if grips else None
        else:
            self._follow(self.entry_mm, straight_mm, along, free, advance)
        return self.thrust_n

    def _feel(self, axes: np.ndarray) -> tuple[float, np.ndarray, float, np.ndarray]:
        """Mean density under the tip, its gradient across (3,) and along, the densities all round behind it (8,)."""
        density = self.bone.density(self.tip_mm + self._feelers @ axes)
        front, x, y, axial = (self._feelings @ density).tolist()
        return front, x * axes[0] + y * axes[1], axial, density[-_AROUND:]

    def _in_own_hole(self, along: np.ndarray) -> bool:
        return self.entry_mm is not None and float((self.tip_mm - self.entry_mm) @ along) < self._deepest_mm - 0.02

    def _cut(self, moved_mm: float, density: float, turning: bool, dt_s: float) -> None:
        """The spring gives what the thrust cuts: squeeze + dt feed(thrust) = what it was, implicitly."""
        resists = self.thrust_scale_n * (density / CORTICAL_G_CM3) ** 2
        squeeze = max(self._squeeze_mm + moved_mm, 0.0)
        if resists < _AIR_N:
            squeeze = 0.0
        elif turning and squeeze > 0.0:
            power = 1 / FEED_POWER
            rate = dt_s * REVS_PER_S * FEED_PER_REV_MM * (AXIAL_N_PER_MM / resists) ** power
            squeeze = _squeezed(squeeze, rate, power)
        self._squeeze_mm, self.thrust_n = squeeze, AXIAL_N_PER_MM * squeeze

    def _skive(self, lateral: np.ndarray, axial: float, axes: np.ndarray, free_mm: float) -> None:
        """The tip moves down the slope as far as thrust and bending balance, and wherever bone does not stand."""
        steep = sqrt(lateral @ lateral)
        push = np.zeros(3)
        if self.thrust_n > 0.0 and steep > 0.0:
            slope = min(steep / axial, STEEPEST) if axial > 0 else STEEPEST
            side = max(slope - FRICTION, 0.0) / (1 + FRICTION * slope)  # tan(angle - friction angle)
            push = -self.thrust_n * side * lateral / steep
        move = push * free_mm**3 / (3 * self.bending_n_mm2) - self._offset
        size = sqrt(move @ move)
        if size > 0.0:
            move *= min(SLIDE_MM / size, 1.0)
            beside = self.tip_mm + move * (1.4 * self.radius_mm / sqrt(move @ move)) - self.radius_mm * axes[2]
            stands = float(self.bone.density(beside[None])[0]) / (HELD_SHARE * CORTICAL_G_CM3)
            self._offset = self._offset + max(1.0 - stands, 0.0) * move
        self._offset = self._offset - (self._offset @ axes[2]) * axes[2]
        self.slope = 1.5 * self._offset / free_mm if free_mm > 0 else np.zeros(3)

    def _follow(
        self, entry: np.ndarray, straight_mm: np.ndarray, along: np.ndarray, free_mm: float, advance_mm: float
    ) -> None:
        """Pinned at the entry (3,): beyond it the wire is straight, with the slope that the bent part before it has."""
        across = entry - straight_mm
        across = across - (across @ along) * along
        inside = float((self.tip_mm - entry) @ along)
        if self._gripped is None:
            self.slope = 1.5 * across / max(free_mm - inside, SHORTEST_FREE_MM)
        else:
            slope, offset = self._gripped
            self.slope = slope + (across - offset) / SLEEVE_LENGTH_MM
        self.tip_mm = self.tip_mm + advance_mm * (along + self.slope)
        inside += advance_mm
        self._deepest_mm = max(self._deepest_mm, inside)
        if inside < 0.0:  # pulled out
            self.entry_mm = None
            offset = self.tip_mm - straight_mm
            self._offset = offset - (offset @ along) * along


def _feelers(radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (19, 3) in the tool's axes where the tip feels bone, and what their densities mean (4, 19): the mean over
    the tip, the gradient along x, y, z. The last eight lie around the wire behind the tip."""
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(_AROUND)], axis=1)
    disc = 0.8 * radius_mm
    along = np.array([[0.0, 0.0, disc]])
    behind = 1.4 * radius_mm * ring - [0.0, 0.0, radius_mm]
    points = np.concatenate([np.zeros((1, 3)), disc * ring, along, -along, behind])
    meaning = np.zeros((4, len(points)))
    meaning[0, : 1 + _AROUND] = 1 / (1 + _AROUND)
    # Gradients as steep as each other where a face at 45° passes through the tip.
    meaning[1:3, 1 : 1 + _AROUND] = ring[:, :2].T / (disc * np.abs(ring[:, 0]).sum())
    meaning[3, 1 + _AROUND : 3 + _AROUND] = [0.5 / disc, -0.5 / disc]
    return points, meaning


def sensed(thrust_n: float, rng: np.random.Generator) -> float:
    """N: a reading of the force sensor."""
    return thrust_n + hypot(NOISE_SHARE * thrust_n, NOISE_N) * float(rng.standard_normal())


@njit(cache=True)
def _squeezed(total: float, rate: float, power: float) -> float:
    """The root y in (0, total) of y + rate y^power = total: Newton from above, where the curve is convex."""
    y = total
    for _ in range(60):
        step = (y + rate * y**power - total) / (1 + rate * power * y ** (power - 1))
        y -= step
        if step < 1e-12 * total:
            break
    return max(y, 0.0)


@njit(cache=True)
def _add_density(total: np.ndarray, values: np.ndarray, index: np.ndarray, points: np.ndarray, whole: float) -> None:
    """Adds trilinear shares times the density of the `whole`; nothing outside the volume."""
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
