"""What a person does at the robot itself, and no program can do from afar."""


class Panel:
    """Reset button and key switch. The stop button and the hold-to-run switch act on the drives and are read with the
    plant (`PlantFlag`)."""

    def __init__(self, *, key_switch: bool = False) -> None:
        self.key_switch = key_switch  # with one, nothing sent over the link resets
        self._pressed = False

    def reset(self) -> None:
        """A person has seen to the fault, and presses the button. Any thread."""
        self._pressed = True

    def take_reset(self) -> bool:
        """Whether the button was pressed since last asked."""
        pressed, self._pressed = self._pressed, False
        return pressed
