"""Scenes of points that benchmarks and tests share."""
