"""A plate as a part to be manufactured: a sheet with a blind bore for each ball, in coordinates from one corner."""

from dataclasses import dataclass

import numpy as np

from sightline.errors import FrameError
from sightline.frame.deviations import plates
from sightline.frame.model import Frame
from sightline.frame.plate import Fiducial, Plate

THICKNESS_MM = 8.0  # [ours] as in the twin
FLOOR_MM = 1.5  # [ours] minimum material in front of and behind a ball
RIM_MM = 15.0  # [ours] from the outermost ball's centre to the edge: space for screws, outside the field
SCREW_MM, SCREW_INSET_MM = 5.5, 7.0  # [ours] clearance of M5, and its distance from both edges
CHAMFER_MM = 6.0  # [ours] one corner is cut, so that no plate is mounted mirrored
WALL_MM = 1.0  # [ours] minimum material between two bores
WASHER_MM = 1.5  # [ours] thickness, as in the twin
# ISO 286-2, H8: upper deviation of a bore up to this diameter, mm; the lower one is zero [mem].
_H8 = ((3.0, 0.014), (6.0, 0.018), (10.0, 0.022), (18.0, 0.027), (30.0, 0.033), (50.0, 0.039))
SIGMAS = 2.0  # [ours] a tolerance on a drawing is plus or minus two standard deviations


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


@dataclass(frozen=True)
class Part:
    """A plate to be made, viewed on its front face: x to the right, y up, from the lower left corner (edges A and B).

    `front`, `right`, `up`: directions of the front face's normal and of the sheet's axes in CFCS. `position_mm`:
    position tolerance of a bore, plus or minus, per axis.
    """

    view: str
    role: str
    bores: tuple[Bore, ...]
    width_mm: float
    height_mm: float
    thickness_mm: float
    position_mm: float
    front: str
    right: str
    up: str

    @property
    def name(self) -> str:
        """Name of the part's files."""
        return f"{self.view}-{self.role}"

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """Corners, counter-clockwise from the datum corner; the opposite corner is cut."""
        w, h, cut = self.width_mm, self.height_mm, CHAMFER_MM
        return ((0.0, 0.0), (w, 0.0), (w, h - cut), (w - cut, h), (0.0, h))

    @property
    def screws(self) -> tuple[tuple[float, float], ...]:
        """Centres of the through holes for mounting."""
        a, w, h = SCREW_INSET_MM, self.width_mm, self.height_mm
        return ((a, a), (w - a, a), (w - a, h - a), (a, h - a))


def parts_of(frame: Frame) -> tuple[Part, ...]:
    """Return the plates of a frame as parts. Raises FrameError for a plate that cannot be made this way."""
    sd = frame.effective_tolerances.bead_mm
    return tuple(_part(view, role, plate, round(SIGMAS * sd, 3)) for view, role, plate in plates(frame))


def _part(view: str, role: str, plate: Plate, position_mm: float) -> Part:
    plane = plate.plane
    xy, height = plane.to_plane(plate.xyz_mm), plane.height_mm(plate.xyz_mm)
    thickness = max(THICKNESS_MM, max(_thickness_mm(ball) for ball in plate.fiducials) + 2 * FLOOR_MM)
    corner = xy.min(axis=0) - RIM_MM
    width, tall = (np.ptp(xy, axis=0) + 2 * RIM_MM).round(3).tolist()
    order = np.lexsort((xy[:, 0].round(2), -xy[:, 1].round(2)))  # reading order, from the top left
    bores = []
    for number, k in enumerate(order, start=1):
        ball = plate.fiducials[k]
        x, y = (xy[k] - corner).round(3).tolist()
        depth = round(thickness / 2 + _thickness_mm(ball) / 2 - float(height[k]), 3)
        bores.append(Bore(number, ball, x, y, depth))
        if not _thickness_mm(ball) <= depth <= thickness - WALL_MM:
            raise FrameError(
                f"{view} {role} plate: {ball.id} lies {height[k]:+.2f} mm off the plane of the others, too far for a "
                f"plate of {thickness:g} mm; correct its coordinates"
            )
    part = Part(
        view, role, tuple(bores), width, tall, thickness, position_mm,
        _direction(plane.normal), _direction(plane.axes[0]), _direction(plane.axes[1]),
    )  # fmt: skip
    _refuse_thin_walls(part)
    return part


def _thickness_mm(ball: Fiducial) -> float:
    """Return a fiducial's extent across the plate."""
    return WASHER_MM if ball.shape == "washer" else ball.diameter_mm


def _refuse_thin_walls(part: Part) -> None:
    holes = [(bore.x_mm, bore.y_mm, bore.ball.diameter_mm / 2, bore.ball.id) for bore in part.bores]
    holes += [(x, y, SCREW_MM / 2, "a screw's hole") for x, y in part.screws]
    at, radius = np.array([hole[:2] for hole in holes]), np.array([hole[2] for hole in holes])
    wall = np.linalg.norm(at[:, None] - at, axis=-1) - radius[:, None] - radius
    np.fill_diagonal(wall, np.inf)
    if wall.min() < WALL_MM:
        first, second = np.unravel_index(np.argmin(wall), wall.shape)
        raise FrameError(
            f"{part.view} {part.role} plate: the wall between {holes[first][3]} and {holes[second][3]} is "
            f"{wall.min():.2f} mm (at least {WALL_MM:g} mm is needed); move a ball"
        )


def _direction(vector: np.ndarray) -> str:
    """Return a unit vector in words: +X, or its components where it is not along an axis."""
    axis = int(np.argmax(np.abs(vector)))
    if abs(vector[axis]) > np.cos(1e-3):
        return f"{'+' if vector[axis] > 0 else '-'}{'XYZ'[axis]}"
    return "(" + ", ".join(f"{x:+.4f}" for x in vector) + ")"
