"""Radiographs: reading, writing, the field of view."""

from sightline.imaging.radiograph import GeometryTags, Radiograph

__all__ = ["GeometryTags", "Radiograph"]
