"""The distributions that simulated scenes are drawn from, with their sources. The benchmarks' scenes depend on them.

Tags as in docs/twin.md: [paper], [src], [mem], [calc], [ours].
"""

from dataclasses import dataclass
from math import pi, radians

DEGREE = pi / 180


@dataclass(frozen=True)
class Distortion:
    """Distribution of the distortion of an intensifier; see docs/twin.md, Distortion."""

    pincushion_at_107_mm: tuple[float, float] = (0.03, 0.09)  # uniform [calc]: k1 = share / (107 mm)²
    earth_ut: tuple[float, float] = (18.65, -44.9)  # Loughborough: horizontal, up [calc, IGRF]
    stray_ut: float = 10.0  # s.d. per component, drawn for each exposure [ours]
    gradient_ut_per_mm: float = 3.0 / 107.5  # s.d. of one component of the stray gradient [ours]
    shift_mm_per_ut: float = 0.055  # [calc] 2.6 mm lateral, 1.0 mm PA; the paper saw 2-3 mm between them
    turn_rad_per_ut: tuple[float, float] = (0.02 * DEGREE, 0.08 * DEGREE)  # log-uniform [ours]
    turn_fade: tuple[float, float] = (-0.79, 0.23)  # of u², u⁴ [calc on measured dots]
    shift_fade: tuple[float, float] = (-1.41, 0.88)  # of u², u⁴ [calc on measured dots]
    asymmetric_mm: float = 0.4  # rms of a random cubic over the field [calc]
    correlation_mm: tuple[float, float] = (30.0, 60.0)  # uniform; length l of exp(-d²/2l²) [calc]
    beyond_degree5_mm: tuple[float, float] = (0.05, 0.10)  # uniform; expected rms left after a fit of degree 5 [calc]


@dataclass(frozen=True)
class Pose:
    """Distribution of the pose of a C-arm relative to the frame. Angles rad, lengths mm. Values are standard deviations
    of normal distributions unless stated otherwise."""

    source_to_hip_mm: float = 620.0  # [ours]
    frame_tilt: float = radians(3.0)  # of the frame against the C-arm's orbit, per axis, the same in both views [ours]
    orbit: float = radians(2.0)  # of each view's direction, per axis: views are not exactly 90° apart [ours]
    tilt_limit: float = radians(15.0)  # between beam and nominal beam; poses beyond it are drawn again [ours]
    in_plane: float = pi  # uniform within +- this: the image may have any rotation [ours]
    hip_offset_mm: float = 10.0  # uniform within +- this, per axis: the beam's axis misses the hip [ours]
    piercing_mm: float = 4.0  # flex: piercing point, up to 10-16 mm over the orbit [src Daly 2008]
    sdd_mm: float = 3.0  # flex: source and detector 6-8 mm over the orbit [src Daly 2008]
    detector_tilt: float = radians(1.0)  # flex: up to 2.9° [src Daly 2008]
    # Instead, of a flat panel before a solid: 3 mm of the principal point, which has 5 mm with `piercing_mm` [ours]. A
    # tilt of 1° would be 18 mm, and the measured piercing points move by 10-16 mm over the whole orbit.
    panel_tilt: float = radians(0.17)
    beads_in_field: float = 0.6  # minimum share of each plate's beads in the field; else drawn again [ours]


@dataclass(frozen=True)
class Arm:
    """Distribution of the stance of one C-arm around a frame. Angles rad, uniform within +- the value, per view.

    The ranges are those of an operating room, with a patient on a table between source and intensifier and the other
    leg beside it.
    """

    orbit: float = radians(8.0)  # off the view's own orbit [ours]
    tilt: float = radians(6.0)  # about the arm's support, cranial or caudal [ours]
    swivel: float = radians(6.0)  # of the whole arm; machines turn by 10-12.5° [mem]
    orbit_limits: tuple[float, float] = (radians(-40.0), radians(100.0))  # of the machine [mem]
    repeat_mm: float = 0.25  # repeatability at the same orbit, s.d. per axis; an upper bound [src Daly 2008]


@dataclass(frozen=True)
class HardScene:
    """Content of a hard image besides frame and hip [ours]. Counts are drawn uniformly, both ends included."""

    wires: tuple[int, int] = (0, 2)  # guide wires of 2.5 mm through the hip
    screws: tuple[int, int] = (0, 3)  # 4.5 mm, 40 mm long
    nails: tuple[int, int] = (0, 1)  # 11 mm down the shaft
    level: tuple[float, float] = (0.15, 0.5)  # mean of the image's middle over white; above 0.3 much saturates
    tissue_scale: tuple[float, float] = (0.75, 1.15)  # of the body's cross-section; thin bodies leave air in the image
    metal_reach_mm: float = 45.0  # wires and screws lie within this distance of the hip


@dataclass(frozen=True)
class SolidPlace:
    """Place of a solid beside a hip, and where the beams are aimed."""

    # The middle of the solid from the middle of the wire, mm: lateral, caudal, anterior. It is 80 mm away, caudal
    # of the entry and a little in front: there its shadow falls beside the wire in each view.
    solid_mm: tuple[float, float, float] = (0.0, 76.8, 22.4)  # [ours]
    aim: float = 0.4  # share of the way from the middle of the wire to the solid at which the beams are aimed [ours]


# Beside a hip in the field of a 9-inch intensifier, 140 mm: 51 mm away, where a block of 30 mm is in both images.
NEAR_PLACE = SolidPlace((0.0, 48.0, 18.0), 0.45)  # [ours]


@dataclass(frozen=True)
class PlateMount:
    """How a plate is put on a detector, standard deviations: once for all images."""

    shift_mm: float = 3.0  # per axis across the detector [ours]
    stand_off_mm: float = 1.0  # [ours]
    turn: float = radians(5.0)  # in its plane [ours]
    tilt: float = radians(0.3)  # per axis: 1 mm over its width [ours]


@dataclass(frozen=True)
class HipPlace:
    """Position of a hip: its ideal wire is near `SetUp.hip_mm`, so that both fields can show all of it."""

    off_centre_sd_mm: float = 4.0  # of the middle of the wire, per axis [ours]
    margin_px: float = 60.0  # minimum distance of the wire's ends from the edge of both fields, where required [ours]
