"""Procedures as files: their schema, the shipped ones, and a user's own (docs/procedures.md)."""

from sightline.planning.procedures.files import PROCEDURES, kind, procedures
from sightline.planning.procedures.procedure import PlanInput, Procedure

__all__ = ["PROCEDURES", "PlanInput", "Procedure", "kind", "procedures"]
