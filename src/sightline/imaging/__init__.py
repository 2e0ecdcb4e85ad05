"""Radiographs: reading, writing, the field of view."""

from sightline.imaging.dicom import write as write_dicom
from sightline.imaging.files import read_image, write_png
from sightline.imaging.radiograph import GeometryTags, Radiograph

__all__ = ["GeometryTags", "Radiograph", "read_image", "write_dicom", "write_png"]
