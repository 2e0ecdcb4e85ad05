"""Whether the halves of a hole's rims agree on its axis: a jackknife of blocks.

An edge that is taken for a rim, such as that of other metal, moves a whole piece of it. Points that follow each other
are then wrong together, which no point's own variance holds.
"""

from collections.abc import Sequence

import numpy as np


def rims_disagree(  # noqa: PLR0917
    ends_mm: np.ndarray,
    covariance_mm2: np.ndarray,
    gain: np.ndarray,
    left: np.ndarray,
    redundant: np.ndarray,
    rims: Sequence[np.ndarray],
) -> float:
    """Return how much the axis changes when half a rim is left out, over what its errors explain: 1 is expected.

    Squared changes across the axis, in units of its covariance, are added for both halves of each rim of each view.
    `ends_mm` (6,), `covariance_mm2` (6, 6): both ends of the axis; `gain` (6, K): their response to the K residuals of
    the adjustment; `left` (K,), `redundant` (K, K): its weighted residuals and their covariance; `rims`: the places of
    each rim's points, in their order along it.
    """
    across = np.kron(np.eye(2), np.linalg.svd((ends_mm[3:] - ends_mm[:3])[None])[2][1:])
    precision, gain = np.linalg.inv(across @ covariance_mm2 @ across.T), across @ gain
    seen = expected = 0.0
    for half in (half for rim in rims for half in np.array_split(rim, 2) if len(half)):
        # Without these points the axis moves by the gain times what the other points predict for them.
        response = np.linalg.solve(redundant[np.ix_(half, half)], gain[:, half].T).T
        change = response @ left[half]
        seen += float(change @ precision @ change)
        expected += float(np.trace(precision @ response @ gain[:, half].T))
    return seen / expected if expected > 0 else 1.0
