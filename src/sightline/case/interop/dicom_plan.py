"""A plan as DICOM: each view's undistorted image, the same with the plan burnt in, and a presentation state over it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sightline.case.interop.dicom_capture import capture
from sightline.case.interop.dicom_parts import Filed, file_bytes
from sightline.case.interop.dicom_state import Referred, state
from sightline.case.interop.drawing import Drawn, burnt, on_plate
from sightline.case.interop.plan_file import PlanFile
from sightline.errors import UnusableInputError


def write(plan: PlanFile, filed: Filed, originals: Mapping[str, Path]) -> dict[str, bytes]:
    """Three files a view; and for each original (a DICOM file by view) a presentation state over the raw image.

    Raises UnusableInputError where the plan was made without images, or an original is not the view's image.
    """
    out: dict[str, bytes] = {}
    for k, (view, pinhole) in enumerate(plan.plates.items()):
        image = plan.pixels(view)
        if image is None:
            raise UnusableInputError(f"the plan has no image of view {view}: it was made from observations in CSV")
        drawn = on_plate(plan, pinhole)
        plain = capture(image, pinhole, filed, f"{view}, undistorted; {plan.statement}", 4 * k + 1)
        shown = burnt(image[0], drawn, plan.verdict)
        out[f"{view}.dcm"] = file_bytes(plain)
        out[f"{view}-plan.dcm"] = file_bytes(
            capture((shown, 255.0), pinhole, filed, f"{view}, plan drawn; {plan.statement}", 4 * k + 2)
        )
        out[f"{view}-state.dcm"] = file_bytes(state(Referred.of(plain), drawn, plan.statement, filed, 4 * k + 3))
        if view in originals:
            out[f"{view}-original-state.dcm"] = _over(plan, view, originals[view], filed, 4 * k + 4)
    unknown = set(originals) - set(plan.plates)
    if unknown:
        raise UnusableInputError(f"the plan has no view {', '.join(sorted(unknown))}")
    return out


def _over(plan: PlanFile, view: str, original: Path, filed: Filed, number: int) -> bytes:
    if plan.document.drawn is None or view not in plan.document.drawn:
        raise UnusableInputError("the plan does not say where it lies in the raw images; plan again with --out")
    given = plan.document.drawn[view]
    drawn = Drawn(
        *(np.array(px, dtype=np.float64).reshape(-1, 2) for px in (given.entry_px, given.end_px, given.wire_px))
    )
    drawn = Drawn(drawn.entry_px[0], drawn.end_px[0], drawn.wire_px)
    image = Referred.read(original)
    inside = all((px >= -0.5).all() and (px <= np.array(image.shape[::-1]) - 0.5).all() for px in drawn.wire_px)
    if not inside:
        raise UnusableInputError(f"{original.name} is not the image of view {view}: the wire lies outside it")
    return file_bytes(state(image, drawn, plan.statement, filed, number))
