"""What Sightline raises: every message says what is wrong and what to do."""


class SightlineError(Exception):
    """Base of all errors raised on purpose; `exit_code` is what the command line returns."""

    exit_code = 2


class UnusableInputError(SightlineError):
    """A file or an argument cannot be used at all (exit code 2)."""


class ImageError(UnusableInputError):
    """A file is not an image that Sightline can read."""


class SourceError(SightlineError):
    """A source of images cannot be opened, or has stopped giving them."""


class FrameError(UnusableInputError):
    """A frame file is malformed or describes no usable frame."""


class ObservationsError(UnusableInputError):
    """Bead observations are malformed, not finite, or do not belong to the frame."""


class SetUpError(UnusableInputError):
    """A simulated set-up or scene cannot be drawn as asked."""


class MessageError(UnusableInputError):
    """An OpenIGTLink message is malformed, or cannot be written as asked."""


class LinkError(SightlineError):
    """A connection to a robot or to its client cannot be made, or was lost."""


class CaseError(UnusableInputError):
    """A case cannot be opened, read or written, or is asked to hold what no case may."""


class OvertakenError(CaseError):
    """Another entry was recorded since the last one that the caller had seen; nothing was appended."""


class RefusedError(SightlineError):
    """The input is readable, but a trustworthy result cannot be computed from it (exit code 3)."""

    exit_code = 3


class DetectionRefusedError(RefusedError):
    """An image shows no beads that can be told from its background."""


class MovedRefusedError(RefusedError):
    """Images that should show the same have moved against each other."""


class LabellingRefusedError(RefusedError):
    """The beads found cannot be told apart with certainty."""


class WireRefusedError(RefusedError):
    """The wire cannot be found in an image with certainty."""


class CalibrationRefusedError(RefusedError):
    """A view cannot be calibrated from the beads given."""


class OutsideRegionError(RefusedError):
    """A point lies where the view's map is not defined."""


class ReconstructionRefusedError(RefusedError):
    """Lines of sight do not determine a point."""


class ErrorUnknownError(RefusedError):
    """An uncertainty is asked of a view that has none."""


class RobotRefusedError(RefusedError):
    """The robot cannot, or must not, do what is asked of it."""
