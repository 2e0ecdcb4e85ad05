"""Why an image shows too few beads, as far as its own pixels tell."""

from collections.abc import Sequence

import numpy as np

from sightline.detection.motion import DIRECTED, smear
from sightline.detection.results import Rejected
from sightline.imaging import Radiograph
from sightline.imaging.defects import MOST_CLIPPED, clipped_share, torn

NO_RIM = "no rim"  # how this reason begins
_FEWEST = 5  # spots that tell anything of an image [ours]


def cause_of(image: Radiograph, beads: np.ndarray, rejected: Sequence[Rejected]) -> str | None:
    """What is wrong with an image in which so few beads were found, and what to do; None where it does not tell.

    `beads` (N, 3): u, v and radius, px.
    """
    share = 100 * clipped_share(image)
    if share > MOST_CLIPPED:
        return (
            f"the image is saturated: {share:.0f} % of its field is clipped; expose less, or export it without a window"
        )
    others = np.array([(*one.uv_px, one.radius_px) for one in rejected]).reshape(-1, 3)
    moved = smear(image, beads, others)
    if moved is not None:
        return (
            f"the image is smeared by movement at about {moved.angle_deg:.0f}° to its rows: rims are softer there than "
            f"across ({moved.directed:.2f}, at most {DIRECTED:g}); hold still, and take it again in a single exposure"
        )
    # Here alone: it takes as long as half of detection, and beads show a tear in a view's checks. After movement, since
    # smeared lines resemble each other once shifted.
    tear = torn(image)
    if tear is not None:
        return tear.sentence
    soft = sum(one.reason.startswith(NO_RIM) for one in rejected)
    if soft >= max(_FEWEST, len(beads) / 2):
        return f"the image is blurred: {soft} spots fade out without a rim, {len(beads)} have one; focus, or hold still"
    return None
