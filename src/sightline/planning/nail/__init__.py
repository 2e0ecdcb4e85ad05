"""Holes of nails, measured by their rims, and files of nails."""
