"""Reconstruction, image-matching curves, trajectories and verdicts; drawn aids and metrics of hip implants."""

from sightline.checks import Limits
from sightline.planning.aids import Aids, Circle, Drawing, Line
from sightline.planning.anatomy import Anatomy, locate
from sightline.planning.axis import Axis
from sightline.planning.corridor import Corridor, corridor
from sightline.planning.curve import MatchingCurve, matching_curve, snap
from sightline.planning.head import Sphere, outline
from sightline.planning.hole import Edge, HoleSeen, fit_hole
from sightline.planning.hole_advice import Turn, perfect_circle
from sightline.planning.hole_result import Hole, HolePose, Nail
from sightline.planning.metrics import Metric, metrics
from sightline.planning.picks import Pick
from sightline.planning.placed_wires import PlacedWire
from sightline.planning.plan import Plan, plan
from sightline.planning.procedures import PROCEDURES, PlanInput, Procedure, kind, procedures
from sightline.planning.proposal import Proposal, propose
from sightline.planning.proposal_rules import ProposalRule
from sightline.planning.reconstruct import reconstruct
from sightline.planning.relations import WireLines
from sightline.planning.results import SpacePoints, Verdict
from sightline.planning.shares import Share, error_shares, error_shares_of
from sightline.planning.trajectory import Trajectory
from sightline.planning.verdict import judge
from sightline.planning.wires import WirePicks, WirePlans, plan_wires
from sightline.planning.wires_proposal import propose_others, propose_wires

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
