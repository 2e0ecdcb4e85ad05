"""What is in the beam: solids, and scenes of them."""
