"""Every distribution that a simulated scene is drawn from, with its source. The benchmarks' scenes hang on them.

Tags as in docs/twin.md: [paper], [src], [mem], [calc], [ours].
"""

from dataclasses import dataclass
from math import pi, radians

DEGREE = pi / 180


@dataclass(frozen=True)
class Distortion:
    """How the distortion of an intensifier is drawn; docs/twin.md, Distortion."""

    pincushion_at_107_mm: tuple[float, float] = (0.03, 0.09)  # uniform [calc]: k1 = share / (107 mm)²
    earth_ut: tuple[float, float] = (18.65, -44.9)  # Loughborough: horizontal, up [calc, IGRF]
    stray_ut: float = 10.0  # s.d. per component, drawn afresh per exposure [ours]
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
    """How a C-arm stands to the frame. Angles rad, lengths mm. Normal with the s.d. given, unless said otherwise."""

    source_to_hip_mm: float = 620.0  # [ours]
    frame_tilt: float = radians(3.0)  # of the frame against the C-arm's orbit, per axis, both views alike [ours]
    orbit: float = radians(2.0)  # of each view's own direction, per axis: views are not exactly 90° apart [ours]
    tilt_limit: float = radians(15.0)  # between beam and nominal beam; beyond it: drawn again [ours]
    in_plane: float = pi  # uniform within +- this: the image may stand at any rotation [ours]
    hip_offset_mm: float = 10.0  # uniform within +- this, per axis: the beam's axis misses the hip [ours]
    piercing_mm: float = 4.0  # flex: piercing point, up to 10-16 mm over the orbit [src Daly 2008]
    sdd_mm: float = 3.0  # flex: source and detector 6-8 mm over the orbit [src Daly 2008]
    detector_tilt: float = radians(1.0)  # flex: up to 2.9° [src Daly 2008]
    beads_in_field: float = 0.6  # least share of each plate's beads in the field; fewer: drawn again [ours]


@dataclass(frozen=True)
class Arm:
    """How freely one C-arm is set up around a frame. Angles rad, uniform within +- what is given, each view by itself.

    What an operating room allows: a patient on a table between source and intensifier, the other leg beside it.
    """

    orbit: float = radians(8.0)  # off the view's own orbit [ours]
    tilt: float = radians(6.0)  # about the arm's support, cranial or caudal [ours]
    swivel: float = radians(6.0)  # of the whole arm; machines turn by 10-12.5° [mem]
    orbit_limits: tuple[float, float] = (radians(-40.0), radians(100.0))  # of the machine [mem]
    repeat_mm: float = 0.25  # what does not repeat at the same orbit, s.d. per axis; at most that [src Daly 2008]


@dataclass(frozen=True)
class HardScene:
    """What a hard image holds besides frame and hip [ours]. Counts are drawn uniformly, both ends included."""

    wires: tuple[int, int] = (0, 2)  # guide wires of 2.5 mm through the hip
    screws: tuple[int, int] = (0, 3)  # 4.5 mm, 40 mm long
    nails: tuple[int, int] = (0, 1)  # 11 mm down the shaft
    level: tuple[float, float] = (0.15, 0.5)  # mean of the middle of the image over white: above 0.3 much saturates
    tissue_scale: tuple[float, float] = (0.75, 1.15)  # of the body's cross-section: thin ones show bare air
    metal_reach_mm: float = 45.0  # from the hip, where wires and screws lie


@dataclass(frozen=True)
class HipPlace:
    """Where a hip lies in the frame: its ideal wire about the origin, so that both fields can show all of it."""

    off_centre_sd_mm: float = 4.0  # of the middle of the wire, per axis [ours]
    margin_px: float = 60.0  # the wire's ends lie at least this far inside both fields, where that is asked [ours]
