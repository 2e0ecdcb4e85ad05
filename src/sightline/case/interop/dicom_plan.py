"""A plan as DICOM: the undistorted image of each view, a copy with the plan burnt in, and a presentation state."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sightline.case.interop.dicom_capture import capture
from sightline.case.interop.dicom_parts import ExportIdentity, file_bytes
from sightline.case.interop.dicom_state import ReferencedImage, state
from sightline.case.interop.overlay import PlanOverlay, burn_in, on_plate
from sightline.case.interop.plan_file import PlanFile
from sightline.errors import UnusableInputError


def write(plan: PlanFile, identity: ExportIdentity, originals: Mapping[str, Path]) -> dict[str, bytes]:
    """Return three files per view, and for each of `originals` (a DICOM file by view) a presentation state over it.

    Raises UnusableInputError if the plan was made without images, or an original is not the image of its view.
    """
    out: dict[str, bytes] = {}
    for k, (view, pinhole) in enumerate(plan.plates.items()):
        image = plan.pixels(view)
        if image is None:
            raise UnusableInputError(f"the plan has no image of view {view}: it was made from observations in CSV")
        drawn = on_plate(plan, pinhole)
        plain = capture(image, pinhole, identity, f"{view}, undistorted; {plan.statement}", 4 * k + 1)
        shown = burn_in(image[0], drawn, plan.verdict)
        out[f"{view}.dcm"] = file_bytes(plain)
        out[f"{view}-plan.dcm"] = file_bytes(
            capture((shown, 255.0), pinhole, identity, f"{view}, plan drawn; {plan.statement}", 4 * k + 2)
        )
        over_plain = state(ReferencedImage.of(plain), drawn, plan.statement, identity, 4 * k + 3)
        out[f"{view}-state.dcm"] = file_bytes(over_plain)
        if view in originals:
            out[f"{view}-original-state.dcm"] = _over_original(plan, view, originals[view], identity, 4 * k + 4)
    unknown = set(originals) - set(plan.plates)
    if unknown:
        raise UnusableInputError(f"the plan has no view {', '.join(sorted(unknown))}")
    return out


def _over_original(plan: PlanFile, view: str, original: Path, identity: ExportIdentity, number: int) -> bytes:
    if plan.document.drawn is None or view not in plan.document.drawn:
        raise UnusableInputError("the plan does not say where it lies in the raw images; plan again with --out")
    given = plan.document.drawn[view]
    entry, end, wire = (np.array(px, dtype=np.float64) for px in (given.entry_px, given.end_px, given.wire_px))
    drawn = PlanOverlay(entry, end, wire.reshape(-1, 2))
    image = ReferencedImage.read(original)
    inside = all((px >= -0.5).all() and (px <= np.array(image.shape[::-1]) - 0.5).all() for px in drawn.wire_px)
    if not inside:
        raise UnusableInputError(f"{original.name} is not the image of view {view}: the wire lies outside it")
    return file_bytes(state(image, drawn, plan.statement, identity, number))
