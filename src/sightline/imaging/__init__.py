"""Radiographs: reading, writing, the field of view."""

from sightline.imaging.defects import image_checks
from sightline.imaging.dicom import write as write_dicom
from sightline.imaging.files import as_radiograph, frames_in, read_image, suffix_of, taken_at, write_png
from sightline.imaging.radiograph import GeometryTags, Radiograph
from sightline.imaging.source import Source, SourceFrame

__all__ = [
    "GeometryTags",
    "Radiograph",
    "Source",
    "SourceFrame",
    "as_radiograph",
    "frames_in",
    "image_checks",
    "read_image",
    "suffix_of",
    "taken_at",
    "write_dicom",
    "write_png",
]
