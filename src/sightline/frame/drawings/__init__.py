"""Drawings, bill and meshes with which a workshop makes a frame."""
