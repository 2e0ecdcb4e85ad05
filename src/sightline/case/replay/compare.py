"""Compare a recomputed result with its entry: where they differ, and whether within tolerance or stated error."""

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
from scipy.special import chdtri

from sightline.common.checks import FALSE_ALARM
from sightline.common.geometry.lines import angle_rad

# Tolerances for other versions and machines, by the end of a number's key. They are those of the tests' golden data,
# but twice as large for mm, since here a view is computed from its image; the last two are for all others [ours].
TOLERANCES = {"uv_px": 2e-3, "radius_px": 5e-3, "_mm": 2e-3}
RELATIVE, ABSOLUTE = 1e-2, 1e-4
# Not compared: sentences for people, which versions word differently, and rejected candidates: one at a limit may come
# or go.
_FREE = ("sentence", "missing", "refused", "rejected")


@dataclass(frozen=True)
class Difference:
    """One difference. `where`: its place, as in `beads[3].uv_px[0]`; `by`: `|now - then|` for numbers, else None;
    `close`: whether it is within tolerance."""

    where: str
    then: Any
    now: Any
    by: float | None
    close: bool


def largest(changes: Iterable[Difference], unit: str) -> Difference | None:
    """Return the largest change of a number whose key ends in `unit`, `px` or `mm`; None if there is none."""
    ours = [change for change in changes if change.by is not None and re.search(rf"_{unit}(\[\d+\])*$", change.where)]
    return max(ours, key=lambda change: change.by or 0.0, default=None)


def differences(then: Any, now_text: str) -> tuple[Difference, ...]:
    """Return the differences of a document from a JSON text: those beyond tolerance first, then by size."""
    every = list(_walk("", "", then, json.loads(now_text)))
    return tuple(sorted(every, key=lambda difference: (difference.close, -(difference.by or 0.0))))


def _walk(where: str, key: str, then: Any, now: Any) -> Iterator[Difference]:
    # Keys that the version which wrote `then` did not know are not compared.
    if isinstance(then, dict) and isinstance(now, dict) and then.keys() <= now.keys():
        for name in then:
            yield from _walk(f"{where}.{name}".lstrip("."), name, then[name], now[name])
    elif isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for k, (item, other) in enumerate(zip(then, now, strict=True)):
            yield from _walk(f"{where}[{k}]", key, item, other)
    elif _is_number(then) and _is_number(now):
        by = abs(float(now) - float(then))
        if by > 0.0:
            yield Difference(where, then, now, by, by <= _allowed(key, float(then)))
    elif then != now:
        yield Difference(where, _short(then), _short(now), None, any(name in where for name in _FREE))


def _is_number(value: Any) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _allowed(key: str, value: float) -> float:
    for ending, tolerance in TOLERANCES.items():
        if key.endswith(ending):
            return tolerance
    return ABSOLUTE + RELATIVE * abs(value)


def _short(value: Any) -> Any:
    if isinstance(value, dict | list):
        return f"{len(value)} entries"
    return value


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
        f"{key.removesuffix('_mm')} point": (float(np.linalg.norm(np.subtract(then[key], now[key]))), bound, "mm")
        for key, bound in stated.items()
        if key.endswith("_mm")
    }
    if "direction" in then:
        angle = angle_rad(*(np.array(each["direction"]) for each in (then, now)))
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
