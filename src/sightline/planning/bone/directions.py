"""Anatomical directions in the coordinates of a Γ or biplane frame (docs/conventions.md)."""

import numpy as np

from sightline.errors import ReconstructionRefusedError, UnusableInputError

ANTERIOR = np.array([0.0, 0.0, 1.0])
MEDIAL = np.array([-1.0, 0.0, 0.0])
# Cosine of 73°: an axis at a larger angle to a direction does not show which of its ends points there [ours].
_MIN_COSINE = 0.3


def anatomical(orbit_deg: float, tilt_deg: float) -> np.ndarray:
    """Return the unit vector (3,) of a direction: lateral, caudal, anterior.

    `orbit_deg` 0 is towards anterior, 90 towards the operated side; `tilt_deg` is positive towards the head.
    """
    orbit, tilt = np.deg2rad([orbit_deg, tilt_deg])
    return np.array([np.cos(tilt) * np.sin(orbit), -np.sin(tilt), np.cos(tilt) * np.cos(orbit)])


def caudal(side: str) -> np.ndarray:
    """Return the caudal direction (3,): +Y for a right hip, -Y for a left one. Raises UnusableInputError."""
    if side not in ("right", "left"):
        raise UnusableInputError(f"the side is {side!r}; give 'right' or 'left'")
    return np.array([0.0, 1.0 if side == "right" else -1.0, 0.0])


def towards(direction: np.ndarray, goal: np.ndarray, what: str) -> np.ndarray:
    """Return `direction` (3,) or its opposite, whichever points to `goal`. Raises ReconstructionRefusedError.

    `what`: the axis's name in the message.
    """
    along = float(direction @ goal)
    if abs(along) < _MIN_COSINE:
        raise ReconstructionRefusedError(
            f"{what} is nearly perpendicular to its expected direction; check the side and which lines were drawn"
        )
    return direction * np.sign(along)


def lies(value_mm: float, ways: tuple[str, str]) -> str:
    """Return a signed distance as text, "6.9 mm in front of", in words for a positive and for a negative one."""
    return f"{abs(value_mm):.1f} mm {ways[value_mm < 0.0]}"
