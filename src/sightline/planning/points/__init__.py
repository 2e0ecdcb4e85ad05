"""Picks in several views and what they determine: points in space, image-matching curves, trajectories."""
