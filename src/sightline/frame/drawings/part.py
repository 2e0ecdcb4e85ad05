"""A plate, or a face of a solid, to be manufactured: blind bores for the balls, in coordinates from one corner."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.errors import FrameError
from sightline.frame.model import Frame
from sightline.frame.plate import Fiducial, Plate, RigidBody

# The parts' dimensions [ours]: stiff enough for the tolerances in PMMA, and every workshop can make them.
THICKNESS_MM = 8.0  # of a plate: a datum ball of 5 mm with FLOOR_MM on both sides
FLOOR_MM = 1.5  # minimum material in front of and behind a ball
RIM_MM = 15.0  # from the outermost ball's centre to the edge: space for screws, outside the field
SCREW_MM, SCREW_INSET_MM = 5.5, 7.0  # clearance of M5, and its distance from both edges
CHAMFER_MM = 6.0  # one corner is cut, so that no plate is mounted mirrored
WALL_MM = 1.0  # minimum material between two bores
WASHER_MM = 1.5  # thickness
COVER_MM = 3.5  # from the outermost balls' centres to the faces of a solid, as in the built-in blocks
# H8: upper deviation of a bore up to this diameter, mm; the lower one is zero [src ISO 286-1, table 1, IT8].
_H8 = ((3.0, 0.014), (6.0, 0.018), (10.0, 0.022), (18.0, 0.027), (30.0, 0.033), (50.0, 0.039))
SIGMAS = 2.0  # of a tolerance on a drawing: 95 % [src JCGM 100, 6.3.3]


@dataclass(frozen=True)
class Bore:
    """One bore: `number` on the drawing, centre (x, y) from the datum corner, depth from the front face. mm."""

    number: int
    ball: Fiducial
    x_mm: float
    y_mm: float
    depth_mm: float

    @property
    def upper_mm(self) -> float:
        """Upper deviation of the bore's diameter from the ball's, mm: ISO H8."""
        return next((mm for up_to, mm in _H8 if self.ball.diameter_mm <= up_to), _H8[-1][1])


@dataclass(frozen=True, eq=False)
class Part:
    """A plate to be made, or one face of a solid, viewed on its front face: x to the right, y up, from the lower left.

    `name`: of its files; `view`: the plate's view, None for a face. `axes` (3, 3): right, up and front, the directions
    of x, y and the front face's normal in CFCS; `corner_mm` (3,): the front face's lower left corner, datum of edges A
    and B, CFCS. `position_mm`: position tolerance of a bore, plus or minus, per axis.
    """

    name: str
    title: str
    view: str | None
    bores: tuple[Bore, ...]
    width_mm: float
    height_mm: float
    thickness_mm: float
    position_mm: float
    axes: np.ndarray
    corner_mm: np.ndarray

    @property
    def right(self) -> str:
        """The direction of x in CFCS, in words."""
        return _direction(self.axes[0])

    @property
    def up(self) -> str:
        """The direction of y in CFCS, in words."""
        return _direction(self.axes[1])

    @property
    def front(self) -> str:
        """The direction of the front face's normal in CFCS, in words."""
        return _direction(self.axes[2])

    @property
    def chamfer_mm(self) -> float:
        """The leg of the cut corner; 0 for a face of a solid."""
        return 0.0 if self.view is None else CHAMFER_MM

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """Corners, counter-clockwise from the datum corner; a plate's opposite corner is cut."""
        w, h, cut = self.width_mm, self.height_mm, self.chamfer_mm
        return ((0.0, 0.0), (w, 0.0), *(((w, h - cut), (w - cut, h)) if cut else ((w, h),)), (0.0, h))

    @property
    def screws(self) -> tuple[tuple[float, float], ...]:
        """Centres of the through holes for mounting a plate; a face has none."""
        a, w, h = SCREW_INSET_MM, self.width_mm, self.height_mm
        return () if self.view is None else ((a, a), (w - a, a), (w - a, h - a), (a, h - a))


TITLES = {"xrii": "XRII plate", "source": "source plate", "plate": "plate"}


def parts_of(frame: Frame) -> tuple[Part, ...]:
    """Return the plates of a frame as parts, or the six faces of its solid and the plate on the detector.

    Raises FrameError for a plate or a solid that cannot be made this way.
    """
    position = round(SIGMAS * frame.effective_tolerances.bead_mm, 3)
    if frame.solid is not None:
        faces = faces_of(frame.solid, position)
        for face in faces:
            _refuse_thin_walls(face)
        _refuse_bores_that_meet(faces)
        return faces if frame.detector is None else (*faces, _plate("detector", "plate", frame.detector, position))
    return tuple(_plate(view, role, plate, position) for view, role, plate in frame.named_plates)


def _plate(view: str, role: str, plate: Plate, position_mm: float) -> Part:
    plane = plate.plane
    xy, height = plane.to_plane(plate.xyz_mm), plane.height_mm(plate.xyz_mm)
    extents = np.array([_thickness_mm(ball) for ball in plate.fiducials])
    thickness = max(THICKNESS_MM, float(extents.max()) + 2 * FLOOR_MM)
    depth = thickness / 2 + extents / 2 - height
    title = f"{view} {TITLES[role]}"
    corner = xy.min(axis=0) - RIM_MM
    width, tall = (np.ptp(xy, axis=0) + 2 * RIM_MM).round(3).tolist()
    for ball, extent, deep, off in zip(plate.fiducials, extents, depth.round(3), height, strict=True):
        if not extent <= deep <= thickness - WALL_MM:
            raise FrameError(
                f"{title}: {ball.id} lies {off:+.2f} mm off the plane of the others, too far for a plate of "
                f"{thickness:g} mm; correct its coordinates"
            )
    part = Part(
        f"{view}-{role}", title, view, _bores(plate.fiducials, xy - corner, depth), width, tall, thickness, position_mm,
        np.array([*plane.axes, plane.normal]), plane.to_space(corner) + plane.normal * thickness / 2,
    )  # fmt: skip
    _refuse_thin_walls(part)
    return part


def faces_of(solid: RigidBody, position_mm: float = 0.0) -> tuple[Part, ...]:
    """Return the six faces of the box about the balls; each ball is bored from the face that is nearest to it.

    Whether the bores have walls between them is not checked.
    """
    extents = np.array([_thickness_mm(ball) for ball in solid.fiducials])
    cover = max(COVER_MM, float(extents.max()) / 2 + WALL_MM)
    # Rounded like all sizes of a part, so that the faces meet at their edges.
    low, high = (solid.xyz_mm.min(axis=0) - cover).round(3), (solid.xyz_mm.max(axis=0) + cover).round(3)
    below = np.stack([solid.xyz_mm - low, high - solid.xyz_mm], axis=2).reshape(-1, 6)  # -X, +X, -Y, ... of each ball
    parts = []
    for face in range(6):
        front = np.eye(3)[face // 2] * (1 if face % 2 else -1)
        up = np.eye(3)[1 if face // 2 == 2 else 2]
        axes = np.array([np.cross(up, front), up, front])
        corner = np.where(axes[:2].sum(axis=0) - front < 0, high, low)  # along its axes from low to high, or back
        own = np.flatnonzero(below.argmin(axis=1) == face)
        width, tall, thickness = np.abs(axes @ (high - low)).round(3).tolist()
        xy = (solid.xyz_mm[own] - corner) @ axes[:2].T
        bores = _bores([solid.fiducials[k] for k in own], xy, below[own, face] + extents[own] / 2)
        name = _direction(front)
        parts.append(
            Part(f"face{name.lower()}", f"face {name}", None, bores, width, tall, thickness, position_mm, axes, corner)
        )
    return tuple(parts)


def _bores(balls: Sequence[Fiducial], xy_mm: np.ndarray, depth_mm: np.ndarray) -> tuple[Bore, ...]:
    """Return the bores of balls at (N, 2) from the datum corner, in reading order from the top left."""
    order = np.lexsort((xy_mm[:, 0].round(2), -xy_mm[:, 1].round(2)))
    (x, y), depth = xy_mm.round(3).T.tolist(), depth_mm.round(3).tolist()
    return tuple(Bore(number, balls[k], x[k], y[k], depth[k]) for number, k in enumerate(order, start=1))


def _refuse_bores_that_meet(faces: Sequence[Part]) -> None:
    """Raise FrameError where bores of different faces leave too little wall between them, with rounded floors."""
    bores = [(face, bore) for face in faces for bore in face.bores]
    for k, (face, bore) in enumerate(bores):
        for other_face, other in bores[:k]:
            if other_face is face:
                continue
            (low, high), (other_low, other_high) = _axis(face, bore), _axis(other_face, other)
            apart = np.linalg.norm(np.maximum(0.0, np.maximum(low - other_high, other_low - high)))
            wall = float(apart) - (bore.ball.diameter_mm + other.ball.diameter_mm) / 2
            if wall < WALL_MM:
                raise FrameError(_thin(f"{other_face.title} and {face.title}", other.ball.id, bore.ball.id, wall))


def _axis(face: Part, bore: Bore) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest coordinates (3,) of a bore's axis, from the ball's centre to the face, CFCS."""
    mouth = face.corner_mm + bore.x_mm * face.axes[0] + bore.y_mm * face.axes[1]
    centre = np.array(bore.ball.xyz_mm)
    return np.minimum(mouth, centre), np.maximum(mouth, centre)


def _thickness_mm(ball: Fiducial) -> float:
    """Return a fiducial's extent across the plate."""
    return WASHER_MM if ball.shape == "washer" else ball.diameter_mm


def _refuse_thin_walls(part: Part) -> None:
    holes = [(bore.x_mm, bore.y_mm, bore.ball.diameter_mm / 2, bore.ball.id) for bore in part.bores]
    holes += [(x, y, SCREW_MM / 2, "a screw's hole") for x, y in part.screws]
    if len(holes) < 2:
        return
    at, radius = np.array([hole[:2] for hole in holes]), np.array([hole[2] for hole in holes])
    wall = np.linalg.norm(at[:, None] - at, axis=-1) - radius[:, None] - radius
    np.fill_diagonal(wall, np.inf)
    if wall.min() < WALL_MM:
        first, second = np.unravel_index(np.argmin(wall), wall.shape)
        raise FrameError(_thin(part.title, holes[first][3], holes[second][3], wall.min()))


def _thin(where: str, one: str, other: str, wall_mm: float) -> str:
    return (
        f"{where}: the wall between {one} and {other} is {wall_mm:.2f} mm (at least {WALL_MM:g} mm is needed); move a "
        "ball"
    )


def _direction(vector: np.ndarray) -> str:
    """Return a unit vector in words: +X, or its components where it is not along an axis."""
    axis = int(np.argmax(np.abs(vector)))
    if abs(vector[axis]) > np.cos(1e-3):
        return f"{'+' if vector[axis] > 0 else '-'}{'XYZ'[axis]}"
    return "(" + ", ".join(f"{x:+.4f}" for x in vector) + ")"
