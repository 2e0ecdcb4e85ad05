"""Whole scenes drawn from their distributions, and their truth."""
