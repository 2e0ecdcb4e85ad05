"""Bones as shapes: their exact distances, their volumes, and what a person draws of them."""
