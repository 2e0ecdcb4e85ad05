"""Reconstruction, image-matching curves, trajectories, go and no-go."""

from sightline.planning.curve import MatchingCurve, matching_curve, snap
from sightline.planning.picks import Pick
from sightline.planning.plan import Plan, plan
from sightline.planning.reconstruct import reconstruct
from sightline.planning.results import SpacePoints, Verdict
from sightline.planning.trajectory import Trajectory
from sightline.planning.verdict import Limits, judge

__all__ = [
    "Limits",
    "MatchingCurve",
    "Pick",
    "Plan",
    "SpacePoints",
    "Trajectory",
    "Verdict",
    "judge",
    "matching_curve",
    "plan",
    "reconstruct",
    "snap",
]
