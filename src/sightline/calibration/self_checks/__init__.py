"""Frames measured by their own images."""
