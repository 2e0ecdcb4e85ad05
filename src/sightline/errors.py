"""Exceptions of Sightline: every message says what is wrong and what to do."""


class SightlineError(Exception):
    """Base of all errors that Sightline raises; `exit_code` is the command line's exit code.

    >>> try:
    ...     sl.Frame.load("delta")
    ... except sl.SightlineError as error:
    ...     print(type(error).__name__)
    FrameError
    """

    exit_code = 2


class UnusableInputError(SightlineError):
    """A file or an argument cannot be used at all (exit code 2)."""


class ImageError(UnusableInputError):
    """A file is not an image that Sightline can read."""


class SourceError(SightlineError):
    """A source of images cannot be opened, or has stopped giving images."""


class FrameError(UnusableInputError):
    """A frame file is malformed or describes no usable frame."""


class ObservationsError(UnusableInputError):
    """Bead observations are malformed, not finite, or do not belong to the frame."""


class SetUpError(UnusableInputError):
    """A simulated set-up or scene cannot be generated as requested."""


class MessageError(UnusableInputError):
    """An OpenIGTLink message is malformed, or cannot be written as requested."""


class LinkError(SightlineError):
    """A connection to a robot or to its client cannot be made, or was lost."""


class CaseError(UnusableInputError):
    """A case cannot be opened, read or written, or may not hold the given data."""


class OvertakenError(CaseError):
    """Another entry was recorded since the last one that the caller had seen; nothing was appended."""


class RefusedError(SightlineError):
    """The input is readable, but a trustworthy result cannot be computed from it (exit code 3)."""

    exit_code = 3


class DetectionRefusedError(RefusedError):
    """An image shows no beads that can be distinguished from its background."""


class MovedRefusedError(RefusedError):
    """Something moved between images of the same scene."""


class LabellingRefusedError(RefusedError):
    """The beads found cannot be labelled with certainty."""


class WireRefusedError(RefusedError):
    """The wire cannot be found in an image with certainty."""


class CalibrationRefusedError(RefusedError):
    """A view cannot be calibrated from the given beads."""


class OutsideRegionError(RefusedError):
    """A point lies outside the region in which a view's map is defined."""


class ReconstructionRefusedError(RefusedError):
    """Lines of sight do not determine a point."""


class ErrorUnknownError(RefusedError):
    """A view has no error model, but its uncertainty is needed."""


class RobotRefusedError(RefusedError):
    """The robot cannot, or must not, do what was requested. `reason`: what the robot itself said; "" without it."""

    def __init__(self, message: str, reason: str = "") -> None:
        super().__init__(message)
        self.reason = reason
