"""The drilled wire in an image of the check shot."""
