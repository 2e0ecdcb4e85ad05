"""A frame file compared with an earlier file of the same frame."""

from sightline.checks import Check
from sightline.errors import FrameError
from sightline.frame.handed import MIN_COMMON, common_ids, fits_mirrored, misfits_mm
from sightline.frame.model import Frame

MAX_CHANGE_MM = 1.0  # [ours] rms; a frame whose beads moved more is another one, as in "plate-flat"


def before_check(frame: Frame, before: Frame) -> Check:
    """Do the beads lie as in the file before, but for a rigid motion? Raises FrameError on fewer than 4 common ids."""
    now, then = frame.xyz_mm_by_id, before.xyz_mm_by_id
    if (common := len(common_ids(now, then))) < MIN_COMMON:
        raise FrameError(
            f"the frames {frame.key.rstrip('/')} and {before.key.rstrip('/')} have {common} ids in common and "
            f"{MIN_COMMON} are needed to compare them; give two files of one frame"
        )
    upright, mirrored = misfits_mm(now, then)
    passed = upright <= MAX_CHANGE_MM
    sentence = f"Laid onto those of the file before, the beads have an rms distance of {upright:.2f} mm"
    if fits_mirrored(upright, mirrored):
        sentence += (
            f", mirrored of {mirrored:.2f} mm: this file is the mirror image of that one; "
            "write the coordinates in a right-handed system"
        )
    elif not passed:
        sentence += ": this is another frame, or its beads are numbered otherwise; give the file of this frame"
    return Check("frame-before", passed, upright, MAX_CHANGE_MM, "mm", f"{sentence}.")
