"""What is in the beam: materials, meshes, volumes, solids and scenes of them."""
