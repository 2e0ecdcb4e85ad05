"""Where depth is counted from: the entry point as planned, then as contact and the second shot tell, each by its error.

What is told late is not taken whole: plan, contact and shot are weighed by their variances, and the error that is left
is stated beside every depth.
"""

from dataclasses import dataclass
from math import hypot, isfinite, sqrt

from sightline.errors import RobotRefusedError

# Of the planned entry along the wire, 1 s.d.: a target that may err by more than 1 mm (95 %) is refused [target.py].
PLAN_SD_MM = 0.5
# The point of a wire touches an oblique cortex beside its axis: contact is noticed so far before the axis meets bone.
# Healthy to osteoporotic femurs, fed at 1 mm/s: 0.55 mm, s.d. 0.12, along 60 ideal wires, 0.70 and 0.14 along lines
# some millimetres beside [benchmarks/bench_supervision.py], the delay of the force's filter in it; at 5 mm/s 0.1 mm
# more. A sharper point touches up to so much later.
CONTACT_LEAD_MM, POINT_SD_MM = 0.6, 0.35
SURFACE_SD_MM = 0.5  # of where a person sees the bone's surface in the images, along the wire [ours]
CONTACT_SD_MM = hypot(POINT_SD_MM, SURFACE_SD_MM)
SHOT_SD_MM = 0.2  # of the tip along the wire, where a shot states no error: clicked landmarks [docs/check-shot.md]
# What is told may differ from what is known by so much: four standard deviations of plan and contact.
LIMIT_MM = 3.0


@dataclass(frozen=True)
class DepthZero:
    """The feed with the tip at the entry point, and its error, 1 s.d.; mm."""

    feed_mm: float
    sd_mm: float = PLAN_SD_MM

    def depth_mm(self, feed_mm: float) -> float:
        """How far beyond the entry point the tip is."""
        return feed_mm - self.feed_mm

    def told(self, feed_mm: float, depth_mm: float, sd_mm: float) -> "DepthZero":
        """After it was seen that the tip is at this depth, give or take `sd_mm`. Raises RobotRefusedError where that
        cannot be."""
        off = self.depth_mm(feed_mm) - depth_mm
        if not (isfinite(off) and abs(off) <= LIMIT_MM and 0 < sd_mm <= LIMIT_MM):
            raise RobotRefusedError(
                f"what was seen puts the tip at {depth_mm:.1f} mm, the encoders at {self.depth_mm(feed_mm):.1f} mm: "
                f"more than {LIMIT_MM:g} mm apart, something has moved; take new images and plan again"
            )
        weight = self.sd_mm**2 / (self.sd_mm**2 + sd_mm**2)
        return DepthZero(self.feed_mm + weight * off, self.sd_mm * sqrt(1 - weight))


def before_contact(depth_mm: float) -> bool:
    """Whether bone may yet be met where it is planned."""
    return depth_mm + CONTACT_LEAD_MM <= LIMIT_MM
