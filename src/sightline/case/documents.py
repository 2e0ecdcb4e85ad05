"""Results as documents: what is written of a view and of a check."""

from typing import Any

from sightline.case.views import CalibratedImage
from sightline.checks import Check


def view_document(image: CalibratedImage) -> dict[str, Any]:
    """A calibrated view as JSON types: geometry, what is left of each bead, checks."""
    view, seen = image.view, image.seen
    left = view.residuals
    return {
        "view": view.name,
        "source": seen.source,
        "method": view.method,
        "mirrored": view.mirrored,
        "coordinates": "CFCS",
        "focal_point_mm": view.focal_point_mm.tolist(),
        "residual_rms_mm": left.rms_mm,
        "leave_one_out_rms_mm": left.leave_one_out_rms_mm,
        "left_out": list(left.left_out),
        "beads": [
            {"id": i, "uv_px": uv.tolist(), "residual_mm": r.tolist(), "used": bool(used)}
            for i, uv, r, used in zip(left.ids, left.uv_px, left.residual_mm, left.used, strict=True)
        ],
        "checks": [check_document(check) for check in view.checks],
    }


def check_document(check: Check) -> dict[str, Any]:
    """A check as JSON types."""
    return dict(vars(check))
