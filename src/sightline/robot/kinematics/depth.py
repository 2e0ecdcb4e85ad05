"""The zero of depth: the planned entry point, corrected by bone contact and the check shot.

Plan, contact and shot are combined with weights from their variances; every depth is stated with its remaining error.
"""

from dataclasses import dataclass
from math import hypot, isfinite, sqrt

from sightline.common.checks import CLEAR_MM, Limits
from sightline.errors import RobotRefusedError

# Error of the planned entry along the wire, 1 s.d.: targets with a 95 % error above 1 mm are refused [target.py].
PLAN_SD_MM = 0.5
# The point of a wire touches an oblique cortex beside its axis, so contact is detected this far before the axis meets
# bone. In healthy to osteoporotic femurs, fed at 1 mm/s: 0.55 mm, s.d. 0.12, along 60 ideal wires; 0.70 and 0.14 along
# lines some millimetres aside [benchmarks/robot/supervision.py]. This includes the delay of the force filter; at 5 mm/s
# it is 0.1 mm more. A sharper point touches up to 0.6 mm later.
CONTACT_LEAD_MM, POINT_SD_MM = 0.6, 0.35
SURFACE_SD_MM = 0.5  # of the bone surface as a person marks it in the images, along the wire [ours]
CONTACT_SD_MM = hypot(POINT_SD_MM, SURFACE_SD_MM)
# Share of a difference between plan and contact by which contact moves the zero, and with it the wire's end: the error
# of contact alone moves both by 0.25 mm, 1 s.d.
CONTACT_WEIGHT = PLAN_SD_MM**2 / (PLAN_SD_MM**2 + CONTACT_SD_MM**2)
CONTACT_SHIFT_SD_MM = CONTACT_WEIGHT * CONTACT_SD_MM
SHOT_SD_MM = 0.2  # of the tip along the wire for a shot that states no error: clicked landmarks [docs/check-shot.md]
# Largest correction of the zero: four standard deviations of plan and contact.
MAX_ZERO_SHIFT_MM = 3.0
PAUSE_MM = 10.0  # before the end point, for the second shot [physics.md, Drilling]
HOLE_PAUSE_MM = 6.0  # before a nail: there a view from 40° shows the tip beside the nail [calc]


@dataclass(frozen=True)
class DepthZero:
    """The feed with the tip at the entry point, and its standard deviation; mm."""

    feed_mm: float
    sd_mm: float = PLAN_SD_MM

    def depth_mm(self, feed_mm: float) -> float:
        """Return the depth of the tip beyond the entry point at this feed, mm."""
        return feed_mm - self.feed_mm

    def corrected(self, feed_mm: float, depth_mm: float, sd_mm: float) -> "DepthZero":
        """Return the zero corrected by a measured depth of the tip with standard deviation `sd_mm`. Raises
        RobotRefusedError if the correction exceeds MAX_ZERO_SHIFT_MM."""
        off = self.depth_mm(feed_mm) - depth_mm
        if not (isfinite(off) and abs(off) <= MAX_ZERO_SHIFT_MM and 0 < sd_mm <= MAX_ZERO_SHIFT_MM):
            raise RobotRefusedError(
                f"what was seen puts the tip at {depth_mm:.1f} mm, the encoders at {self.depth_mm(feed_mm):.1f} mm: "
                f"more than {MAX_ZERO_SHIFT_MM:g} mm apart, something has moved; take new images and plan again"
            )
        weight = self.sd_mm**2 / (self.sd_mm**2 + sd_mm**2)
        return DepthZero(self.feed_mm + weight * off, self.sd_mm * sqrt(1 - weight))


def contact_range(before_mm: float = 0.0) -> tuple[float, float]:
    """Return the first and the last depth, mm, at which contact with bone is plausible.

    `before_mm`: how far before the entry point bone may begin (`Limits.before_mm`).
    """
    earliest = -before_mm - MAX_ZERO_SHIFT_MM - CONTACT_LEAD_MM
    return earliest, (-CLEAR_MM if before_mm > 0 else MAX_ZERO_SHIFT_MM) - CONTACT_LEAD_MM


def pause_depth(depth_mm: float, limits: Limits) -> float:
    """Return the depth, mm, of the pause for the second shot, for a wire that is drilled to `depth_mm`.

    A drill that goes through what lies in the bone, such as a nail's hole, pauses before it.
    """
    if limits.through_walls:
        return -HOLE_PAUSE_MM
    return max(depth_mm - PAUSE_MM, 0.0)
