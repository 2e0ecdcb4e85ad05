"""A CT or a mesh and calibrated views: what a view sees of it."""
