"""What the robot's zero of depth rests on."""

from enum import StrEnum


class ZeroSource(StrEnum):
    """A source of the zero of depth."""

    PLAN = "plan"
    CONTACT = "contact"
    SHOT = "shot"
