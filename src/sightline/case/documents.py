"""A calibrated view as JSON."""

from typing import Any

from sightline.case.views import CalibratedImage


def view_document(image: CalibratedImage) -> dict[str, Any]:
    """Return a calibrated view as JSON types: geometry, the residual of each bead, checks."""
    view, seen = image.view, image.seen
    residuals = view.residuals
    return {
        "view": view.name,
        "source": seen.source,
        "method": view.method,
        "mirrored": view.mirrored,
        "coordinates": "CFCS",
        "focal_point_mm": view.focal_point_mm.tolist(),
        "residual_rms_mm": residuals.rms_mm,
        "leave_one_out_rms_mm": residuals.leave_one_out_rms_mm,
        "left_out": list(residuals.left_out),
        "beads": [
            {"id": i, "uv_px": uv.tolist(), "residual_mm": r.tolist(), "used": bool(used)}
            for i, uv, r, used in zip(
                residuals.ids, residuals.uv_px, residuals.residual_mm, residuals.used, strict=True
            )
        ],
        "checks": [vars(check) for check in view.checks],
    }
