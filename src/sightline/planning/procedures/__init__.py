"""Procedures as files: their schema, the shipped ones, and a user's own (docs/procedures.md)."""

from sightline.planning.procedures.procedure import PROCEDURES, PlanInput, Procedure, kind, procedures

__all__ = ["PROCEDURES", "PlanInput", "Procedure", "kind", "procedures"]
