"""Anatomical directions in the coordinates of a Γ or biplane frame (docs/conventions.md)."""

import numpy as np

from sightline.errors import ReconstructionRefusedError, UnusableInputError

ANTERIOR = np.array([0.0, 0.0, 1.0])
MEDIAL = np.array([-1.0, 0.0, 0.0])
# An axis that runs less than this along a direction does not tell which of its ends points there [ours]: cosine of 73°.
_LEAST_ALONG = 0.3


def caudal(side: str) -> np.ndarray:
    """(3,): +Y for a right hip, -Y for a left one. Raises UnusableInputError."""
    if side not in ("right", "left"):
        raise UnusableInputError(f"the side is {side!r}; it is 'right' or 'left'")
    return np.array([0.0, 1.0 if side == "right" else -1.0, 0.0])


def towards(direction: np.ndarray, goal: np.ndarray, what: str) -> np.ndarray:
    """A direction (3,), or its opposite, whichever points to `goal`. Raises ReconstructionRefusedError."""
    along = float(direction @ goal)
    if abs(along) < _LEAST_ALONG:
        raise ReconstructionRefusedError(
            f"{what} runs across the direction in which it is expected; check the side and which lines were drawn"
        )
    return direction * np.sign(along)
