"""Comparison of a frame file with an earlier file of the same frame."""

from sightline.checks import Check
from sightline.errors import FrameError
from sightline.frame.handed import MIN_COMMON, common_ids, fits_mirrored, misfits_mm
from sightline.frame.model import Frame

MAX_CHANGE_MM = 1.0  # [ours] rms; a larger change means another frame, as in "plate-flat"


def before_check(frame: Frame, before: Frame) -> Check:
    """Return the check that the beads lie as in the earlier file, up to a rigid motion.

    Raises FrameError for fewer than 4 common ids.
    """
    now, then = frame.xyz_mm_by_id, before.xyz_mm_by_id
    if (common := len(common_ids(now, then))) < MIN_COMMON:
        raise FrameError(
            f"the frames {frame.key.rstrip('/')} and {before.key.rstrip('/')} have {common} ids in common (at least "
            f"{MIN_COMMON} are needed to compare them); give two files of one frame"
        )
    upright, mirrored = misfits_mm(now, then)
    passed = upright <= MAX_CHANGE_MM
    sentence = f"Aligned with the earlier file, the beads differ by {upright:.2f} mm rms"
    if fits_mirrored(upright, mirrored):
        sentence += (
            f", mirrored by {mirrored:.2f} mm: this file is the mirror image of the earlier one; write the coordinates "
            "in a right-handed system"
        )
    elif not passed:
        sentence += ": this is another frame, or its beads are numbered differently; give an earlier file of this frame"
    return Check("frame-before", passed, upright, MAX_CHANGE_MM, "mm", f"{sentence}.")
