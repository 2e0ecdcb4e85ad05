"""Radiographs: reading, writing, the field of view."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sightline.imaging.defects import image_checks
from sightline.imaging.files import as_radiograph, frames_in, read_image, taken_at, write_png
from sightline.imaging.radiograph import GeometryTags, Radiograph
from sightline.imaging.sources import Source, SourceFrame

if TYPE_CHECKING:
    from sightline.imaging.dicom import write as write_dicom

__all__ = [
    "GeometryTags",
    "Radiograph",
    "Source",
    "SourceFrame",
    "as_radiograph",
    "frames_in",
    "image_checks",
    "read_image",
    "taken_at",
    "write_dicom",
    "write_png",
]


def __getattr__(name: str) -> Any:
    if name == "write_dicom":  # imported on first use, with pydicom, which arrays do not need
        return import_module("sightline.imaging.dicom").write
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
