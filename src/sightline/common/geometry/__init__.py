"""Rays, planes, intersections of lines, covariance propagation."""
