"""Beads in an image: candidates, noise, and sub-pixel fits with their covariances."""
