"""Matter in the beam: materials, volumes, meshes, CT scans, and their integrals along rays."""
