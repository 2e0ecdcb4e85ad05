"""The steps of a procedure. Their names on the page are in the texts."""

from enum import StrEnum


class ProcedureStep(StrEnum):
    """A step, in their order. The value is its key in the texts, in the page's address and in test hooks."""

    IMAGES = "images"
    CALIBRATE = "calibrate"
    PLAN = "plan"
    DRILL = "drill"
    VERIFY = "verify"

    @property
    def number(self) -> int:
        """Its number, from 1."""
        return list(ProcedureStep).index(self) + 1
