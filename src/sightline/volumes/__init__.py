"""Matter in the beam: materials, volumes, meshes, CT scans, and their integrals along rays."""

from sightline.volumes.ct import CtScan, read_ct
from sightline.volumes.filled import filled
from sightline.volumes.meshes import Mesh, read_mesh
from sightline.volumes.volume import Volume

__all__ = ["CtScan", "Mesh", "Volume", "filled", "read_ct", "read_mesh"]
