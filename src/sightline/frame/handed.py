"""Is a frame file the one before it, measured again, or its mirror image?

A left-handed file gives a calibration as good as the right one, and every point mirrored.
"""

from collections.abc import Iterable

import numpy as np

from sightline.checks import Check
from sightline.errors import FrameError
from sightline.frame.identify import rigid_fit
from sightline.frame.model import Frame

LARGEST_CHANGE_MM = 1.0  # [ours] rms; a frame whose beads moved more is another one, as in "plate-flat"
CLEARLY = 2.0  # [ours] times better must the mirror image fit: beads in one plane are their own mirror image
FEWEST_COMMON = 4  # beads: three always lie in a plane


def before_check(frame: Frame, before: Frame) -> Check:
    """Do the beads lie as in the file before, but for a rigid motion? Raises FrameError on fewer than 4 common ids."""
    upright, mirrored = _misfits_mm(frame, before)
    passed = upright <= LARGEST_CHANGE_MM
    sentence = f"Laid onto those of the file before, the beads have an rms distance of {upright:.2f} mm"
    if _is_mirror_image(upright, mirrored):
        sentence += (
            f", mirrored of {mirrored:.2f} mm: this file is the mirror image of that one; "
            "write the coordinates in a right-handed system"
        )
    elif not passed:
        sentence += ": this is another frame, or its beads are numbered otherwise; give the file of this frame"
    return Check("frame-before", passed, upright, LARGEST_CHANGE_MM, "mm", f"{sentence}.")


def refuse_mirror_image(frame: Frame, before: Iterable[Frame]) -> None:
    """Refuse the mirror image of a frame with the same name and serial. Raises FrameError."""
    for other in before:
        if other.key == frame.key and len(_common(frame, other)) >= FEWEST_COMMON and is_mirror_image(frame, other):
            raise FrameError(
                f"frame {frame.key.rstrip('/')} is the mirror image of the file of the same frame before it; one of "
                "them is left-handed: correct it, and see that 'sightline frame check FILE --before FILE' passes"
            )


def is_mirror_image(frame: Frame, before: Frame) -> bool:
    """Does only the mirror image of a frame fit the one before? Raises FrameError on fewer than four common ids."""
    return _is_mirror_image(*_misfits_mm(frame, before))


def _is_mirror_image(upright_mm: float, mirrored_mm: float) -> bool:
    return CLEARLY * mirrored_mm < upright_mm


def _common(frame: Frame, before: Frame) -> list[str]:
    first, second = (_places(one) for one in (frame, before))
    return sorted(first.keys() & second.keys())


def _places(frame: Frame) -> dict[str, tuple[float, float, float]]:
    return {f.id: f.xyz_mm for view in frame.views.values() for f in view.fiducials}


def _misfits_mm(frame: Frame, before: Frame) -> tuple[float, float]:
    """Rms distances of the common beads after the best rigid motion: as they are, and mirrored."""
    ids = _common(frame, before)
    if len(ids) < FEWEST_COMMON:
        raise FrameError(
            f"the frames {frame.key.rstrip('/')} and {before.key.rstrip('/')} have {len(ids)} ids in common and "
            f"{FEWEST_COMMON} are needed to compare them; give two files of one frame"
        )
    now, then = (np.array([_places(one)[i] for i in ids], dtype=np.float64) for one in (frame, before))
    return _misfit_mm(now, then), _misfit_mm(-now, then)


def _misfit_mm(from_mm: np.ndarray, to_mm: np.ndarray) -> float:
    off = rigid_fit(from_mm, to_mm).apply(from_mm) - to_mm
    return float(np.sqrt((off**2).sum(axis=1).mean()))
