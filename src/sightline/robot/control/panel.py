"""The robot's own panel: controls that only a person at the robot can use."""


class Panel:
    """Reset button and key switch. The stop button and the hold-to-run switch act on the drives and come with the
    plant's readings (`PlantFlag`)."""

    def __init__(self, *, key_switch: bool = False) -> None:
        self.key_switch = key_switch  # if fitted, a reset over the link is refused
        self._pressed = False

    def reset(self) -> None:
        """Press the reset button: a person has dealt with the fault. Any thread may call it."""
        self._pressed = True

    def take_reset(self) -> bool:
        """Return whether the button was pressed since the last call."""
        pressed, self._pressed = self._pressed, False
        return pressed
