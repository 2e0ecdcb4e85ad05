"""Detection of a frame file that is the mirror image of another file of the same frame.

A left-handed file gives residuals as small as the right one, but every reconstructed point is mirrored.
"""

from collections.abc import Mapping

import numpy as np

from sightline.common.geometry.rigid import rigid_fit

MIN_COMMON = 4  # beads: three always lie in one plane
MIRRORED_RATIO = 2.0  # [ours] of the misfits, upright to mirrored: beads in one plane are their own mirror image

Places = Mapping[str, tuple[float, float, float]]  # of beads by id, mm


def is_mirror_image(places: Places, before: Places) -> bool:
    """Return whether only the mirror image fits the beads `before`; False with fewer than four common ids."""
    return len(common_ids(places, before)) >= MIN_COMMON and fits_mirrored(*misfits_mm(places, before))


def fits_mirrored(upright_mm: float, mirrored_mm: float) -> bool:
    """Return whether the mirrored misfit is clearly smaller than the upright one."""
    return MIRRORED_RATIO * mirrored_mm < upright_mm


def common_ids(places: Places, before: Places) -> list[str]:
    """Return the ids that both have, sorted."""
    return sorted(places.keys() & before.keys())


def misfits_mm(places: Places, before: Places) -> tuple[float, float]:
    """Return the rms distances of the common beads after the best rigid motion: as they are, and mirrored."""
    ids = common_ids(places, before)
    now, then = (np.array([one[i] for i in ids], dtype=np.float64) for one in (places, before))
    return _misfit_mm(now, then), _misfit_mm(-now, then)


def _misfit_mm(from_mm: np.ndarray, to_mm: np.ndarray) -> float:
    off = rigid_fit(from_mm, to_mm).apply(from_mm) - to_mm
    return float(np.sqrt((off**2).sum(axis=1).mean()))
