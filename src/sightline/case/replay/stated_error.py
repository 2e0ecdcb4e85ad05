"""Compare the change of a recomputed result with the error that was stated for it."""

from typing import Any

import numpy as np
from scipy.special import chdtri

# Probability that any bead of an image changes by more than its true error allows [ours].
FALSE_ALARM = 1e-4


def beyond_stated(then: Any, now: Any) -> str:
    """Return the change that exceeds its stated error most, in words; "" if none does.

    `then`, `now`: contents of labelled beads, a plan or a check shot. Results without a stated error are not judged.
    """
    try:
        if "trajectory" in then:
            return _points(then["trajectory"], now["trajectory"])
        if "error_95" in then:
            return _points(then, now)
        if "ids" in then and then["covariance_px2"] is not None:
            return _beads(then, now)
    except (KeyError, TypeError, ValueError):  # another program recorded the entry: it is reported as different
        pass
    return ""


def _points(then: dict[str, Any], now: dict[str, Any]) -> str:
    """Compare the two points of a plan or a check shot, and a plan's direction."""
    stated = then["error_95"]
    if stated is None:
        return ""
    changes = {
        f"{key.removesuffix('_mm')} point": (_length(then[key], now[key]), bound, "mm")
        for key, bound in stated.items()
        if key.endswith("_mm")
    }
    if "direction" in then:
        one, other = then["direction"], now["direction"]
        angle = np.arctan2(np.linalg.norm(np.cross(one, other)), np.dot(one, other))
        changes["direction"] = float(np.rad2deg(angle)), stated["direction_deg"], "°"
    name = max(changes, key=lambda key: changes[key][0] / changes[key][1])
    change, bound, unit = changes[name]
    return "" if change <= bound else f"{name} by {change:.2g} {unit}, 95 % error stated {bound:.2g} {unit}"


def _beads(then: dict[str, Any], now: dict[str, Any]) -> str:
    """Compare the beads that both have labelled."""
    places = dict(zip(now["ids"], now["uv_px"], strict=True))
    kept = [k for k, name in enumerate(then["ids"]) if name in places]
    if not kept:
        return "no bead has its former label"
    off = np.array([np.subtract(places[then["ids"][k]], then["uv_px"][k]) for k in kept])
    covariance = np.array(then["covariance_px2"])[kept]
    square = np.einsum("ij,ij->i", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    worst = int(square.argmax())
    if square[worst] <= chdtri(2, FALSE_ALARM / len(kept)):
        return ""
    by, sd = np.linalg.norm(off[worst]), np.sqrt(np.trace(covariance[worst]) / 2)
    return f"bead {then['ids'][kept[worst]]} by {by:.2g} px, s.d. stated {sd:.2g} px"


def _length(one: Any, other: Any) -> float:
    return float(np.linalg.norm(np.subtract(one, other)))
