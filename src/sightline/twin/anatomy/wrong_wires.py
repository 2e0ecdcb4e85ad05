"""Wires that are wrong by a known amount, made of a bone's standard wire: for studies of the checks of plans."""

from collections.abc import Callable

import numpy as np

from sightline.errors import SetUpError
from sightline.twin.anatomy.bone_model import BoneModel

MAX_LONGER_MM = 60.0  # a wire that ends farther beyond is another wire [ours]
MAX_ASIDE_MM = 80.0  # of the end, to leave a corridor or to reach what must not be touched [ours]
STEP_MM = 3.0  # a wire that is wrong for a smaller movement only, and not for a larger one, may be missed [ours]
FAR, CORTEX = "through the far surface", "out of the cortex"


def wrong_wires(bone: BoneModel, beyond_mm: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return wrong wires (2, 3) by kind, anatomical coordinates, with the entry of the first standard wire.

    - FAR: the end lies `beyond_mm` outside the far surface (of a head: through its joint surface)
    - CORTEX: the axis leaves the bone sideways by `beyond_mm`, towards a drawn direction
    - "into the NAME": the axis passes `beyond_mm` inside something of `BoneModel.keep_out`

    A kind that this bone does not allow is left out: no far surface within MAX_LONGER_MM, or no wire whose end has
    moved by less than MAX_ASIDE_MM. Raises SetUpError if `beyond_mm` is not above zero.
    """
    if not beyond_mm > 0:
        raise SetUpError("a wrong wire needs a distance above zero")
    entry, end = bone.wires_mm[0]
    along = (end - entry) / np.linalg.norm(end - entry)
    wires = {}
    far = bone.surface_near(end, along)
    deeper = smallest_amount(lambda s: float(bone.distance_mm(far + s * along, "outline")), beyond_mm, MAX_ASIDE_MM)
    if np.linalg.norm(far - end) < MAX_LONGER_MM and deeper is not None:
        wires[FAR] = np.stack([entry, far + deeper * along])
    aside = np.linalg.svd(along[None])[2][1:].T @ _unit(rng.standard_normal(2))
    for kind, of, towards in [
        (CORTEX, "outline", aside),
        *((f"into the {name}", name, _towards(bone, name, along)) for name in bone.keep_out),
    ]:
        moved = smallest_amount(
            lambda s, of=of, towards=towards: -bone.clearance_mm(np.stack([entry, end + s * towards]), of),
            beyond_mm,
            MAX_ASIDE_MM,
        )
        if moved is not None:
            wires[kind] = np.stack([entry, end + moved * towards])
    return wires


def _towards(bone: BoneModel, of: str, along: np.ndarray) -> np.ndarray:
    """Return the unit vector (3,), across the wire, towards what is nearest of `of`."""
    entry, end = bone.wires_mm[0]
    at = entry + np.linspace(0, 1, 200)[:, None] * (end - entry)
    nearest = at[bone.distance_mm(at, of).argmin()]
    steps = 0.01 * np.eye(3)
    slope = bone.distance_mm(nearest - steps, of) - bone.distance_mm(nearest + steps, of)
    return _unit(slope - (slope @ along) * along)


def smallest_amount(violation_mm: Callable[[float], float], wanted_mm: float, limit: float) -> float | None:
    """Return the smallest amount at which a violation is as wanted, to 0.001 mm; None up to `limit`."""
    high = next((s for s in np.arange(STEP_MM, limit, STEP_MM) if violation_mm(s) >= wanted_mm), None)
    if high is None:
        return None
    low = high - STEP_MM
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (low, middle) if violation_mm(middle) >= wanted_mm else (middle, high)
    return float(high)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
