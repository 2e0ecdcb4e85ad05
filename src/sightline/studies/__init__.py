"""Accuracy studies: bounds, figures, tables."""
