"""Matter in the beam: materials, volumes, meshes, CT scans, and their integrals along rays."""

from sightline.imaging.volumes.ct import CtScan, read_ct
from sightline.imaging.volumes.filled import filled
from sightline.imaging.volumes.meshes import Mesh, read_mesh
from sightline.imaging.volumes.volume import Volume

__all__ = ["CtScan", "Mesh", "Volume", "filled", "read_ct", "read_mesh"]
