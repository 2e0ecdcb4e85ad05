"""`sightline demo`: a procedure on the twin, from images to a checked wire."""
