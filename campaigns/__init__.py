"""Campaigns: inputs damaged in many random ways, and how each try ended.

`python -m campaigns` runs them. Finished tries are kept, so a run resumes where it stopped. Truth comes from the twin.
"""
