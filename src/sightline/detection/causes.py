"""Why an image shows too few beads, as far as its own pixels tell."""

from collections.abc import Sequence

from sightline.detection.results import Rejected
from sightline.imaging import Radiograph
from sightline.imaging.defects import MOST_CLIPPED, clipped_share, torn

NO_RIM, NOT_ROUND = "no rim", "not round"  # how these reasons begin
_FEWEST = 5  # spots that tell anything of an image [ours]
_SMEARED = 20  # spots that are not round besides three for each bead: 7-27 in whole images, 78 and more smeared [twin]


def cause_of(image: Radiograph, beads: int, rejected: Sequence[Rejected]) -> str | None:
    """What is wrong with an image in which so few `beads` were found, and what to do; None where it does not tell."""
    share = 100 * clipped_share(image)
    if share > MOST_CLIPPED:
        return (
            f"the image is saturated: {share:.0f} % of its field is clipped; expose less, or export it without a window"
        )
    tear = torn(image)  # here alone: it takes as long as half of detection, and beads show a tear in a view's checks
    if tear is not None:
        return tear.sentence
    soft, uneven = (sum(one.reason.startswith(why) for one in rejected) for why in (NO_RIM, NOT_ROUND))
    if soft >= max(_FEWEST, beads / 2):
        return f"the image is blurred: {soft} spots fade out without a rim, and {beads} have one; focus, or hold still"
    if beads >= _FEWEST and uneven > 3 * beads + _SMEARED:
        return f"the image is smeared: {uneven} spots are sharp on some sides only, {beads} on all; hold still"
    return None
