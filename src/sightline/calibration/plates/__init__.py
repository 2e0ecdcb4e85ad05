"""Fits of the beads of a frame with plates: plane map and focal point, by three methods."""
