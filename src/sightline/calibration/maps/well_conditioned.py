"""Refusal of ill-conditioned calibrations."""

from collections.abc import Generator
from contextlib import contextmanager

import numpy as np

from sightline.errors import CalibrationRefusedError


@contextmanager
def well_conditioned() -> Generator[None]:
    """Raise CalibrationRefusedError where a factorisation within finds a matrix that is not positive definite."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise CalibrationRefusedError(
            "the beads' covariances make the calibration ill-conditioned; check the stated noise, and that no bead is "
            "given twice"
        ) from None
