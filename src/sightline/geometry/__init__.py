"""Rays, planes, meeting points of lines, covariance propagation."""
