"""Reconstruction, image-matching curves, trajectories and verdicts; drawn aids and metrics of hip implants."""

from sightline.common.checks import Limits
from sightline.planning.bone.aids import Aids, Circle, Drawing, Line
from sightline.planning.bone.anatomy import Anatomy, locate
from sightline.planning.bone.drawings import Axis
from sightline.planning.bone.head import Sphere, outline
from sightline.planning.bone.metrics import Metric, metrics
from sightline.planning.check.wires import PlacedWire
from sightline.planning.nail.hole import Edge, HoleSeen, fit_hole
from sightline.planning.nail.result import Hole, HolePose, Nail, Turn, perfect_circle
from sightline.planning.plan import Plan, plan
from sightline.planning.points.curve import Corridor, MatchingCurve, corridor, matching_curve, snap
from sightline.planning.points.picks import Pick
from sightline.planning.points.reconstruct import reconstruct
from sightline.planning.points.results import SpacePoints, Verdict
from sightline.planning.points.trajectory import Share, Trajectory, error_shares, error_shares_of
from sightline.planning.procedures import PROCEDURES, PlanInput, Procedure, kind, procedures
from sightline.planning.procedures.proposal import Proposal, ProposalRule, propose
from sightline.planning.verdict.plan_checks import judge
from sightline.planning.verdict.relations import WireLines
from sightline.planning.wires import WirePicks, WirePlans, plan_wires, propose_others, propose_wires

__all__ = [
    "PROCEDURES",
    "Aids",
    "Anatomy",
    "Axis",
    "Circle",
    "Corridor",
    "Drawing",
    "Edge",
    "Hole",
    "HolePose",
    "HoleSeen",
    "Limits",
    "Line",
    "MatchingCurve",
    "Metric",
    "Nail",
    "Pick",
    "PlacedWire",
    "Plan",
    "PlanInput",
    "Procedure",
    "Proposal",
    "ProposalRule",
    "Share",
    "SpacePoints",
    "Sphere",
    "Trajectory",
    "Turn",
    "Verdict",
    "WireLines",
    "WirePicks",
    "WirePlans",
    "corridor",
    "error_shares",
    "error_shares_of",
    "fit_hole",
    "judge",
    "kind",
    "locate",
    "matching_curve",
    "metrics",
    "outline",
    "perfect_circle",
    "plan",
    "plan_wires",
    "procedures",
    "propose",
    "propose_others",
    "propose_wires",
    "reconstruct",
    "snap",
]
