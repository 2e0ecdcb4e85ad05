"""Plane maps between an image and a plane: three methods, their fit to controls, and the region in which they hold."""
