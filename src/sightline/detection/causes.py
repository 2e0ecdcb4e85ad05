"""Find why an image shows too few beads, from its pixels."""

from collections.abc import Sequence

import numpy as np

from sightline.detection.motion import DIRECTED, smear
from sightline.detection.results import RejectedCandidate
from sightline.imaging import Radiograph
from sightline.imaging.defects import MAX_CLIPPED, clipped_share, torn

NO_RIM = "no rim"  # start of this reason
_MIN_SPOTS = 5  # for a statement about the image [ours]


def cause_of(image: Radiograph, beads: np.ndarray, rejected: Sequence[RejectedCandidate]) -> str | None:
    """Return what is wrong with an image in which few beads were found, and what to do; None where it is not clear.

    `beads` (N, 3): u, v and radius, px.
    """
    share = 100 * clipped_share(image)
    if share > MAX_CLIPPED:
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
    # Only here, because it takes half as long as detection, and beads reveal a tear in the view's checks. After the
    # check for movement, since smeared lines match each other once shifted.
    tear = torn(image)
    if tear is not None:
        return tear.sentence
    soft = sum(one.reason.startswith(NO_RIM) for one in rejected)
    if soft >= max(_MIN_SPOTS, len(beads) / 2):
        return f"the image is blurred: {soft} spots fade out without a rim, {len(beads)} have one; focus, or hold still"
    return None
