"""Reconstruction, image-matching curves, trajectories, go and no-go."""

from sightline.planning.results import SpacePoints, Verdict

__all__ = ["SpacePoints", "Verdict"]
