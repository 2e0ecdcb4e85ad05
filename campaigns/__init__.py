"""Campaigns: one input spoilt in many ways, drawn by seeds, and how each try ended.

`python -m campaigns` runs them. Finished tries are kept: a run goes on where it stopped. Truth comes from the twin.
"""
