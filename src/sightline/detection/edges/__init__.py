"""Edges of bones and of metal, to which picks are snapped."""
