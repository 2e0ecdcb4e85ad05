"""Calibration of all images of a solid of balls in one adjustment."""
