"""Results as files: what is written of a view, and folders of documents."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sightline.atomic import write_whole
from sightline.case.views import CalibratedImage
from sightline.checks import Check
from sightline.errors import UnusableInputError


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


def write_folder(folder: Path, documents: Mapping[str, bytes]) -> list[Path]:
    """Write files into a folder, made where it is missing; each is whole or not there. Raises UnusableInputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInputError(
            f"cannot make the folder {folder}: {error.strerror}; name another with --out"
        ) from error
    return [write_whole(folder / name, data) for name, data in documents.items()]
