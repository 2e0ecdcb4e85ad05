"""What a person does at the robot itself, and no program can do from afar."""

from threading import Event


class Panel:
    """Reset button and key switch. The stop button and the hold-to-run switch act on the drives and are read with the
    plant (`PlantFlag`)."""

    def __init__(self, *, key_switch: bool = False) -> None:
        self.key_switch = key_switch  # with one, nothing sent over the link resets
        self._reset = Event()

    def reset(self) -> None:
        """A person has seen to the fault, and presses the button. Any thread."""
        self._reset.set()

    def take_reset(self) -> bool:
        """Whether the button was pressed since last asked."""
        pressed = self._reset.is_set()
        self._reset.clear()
        return pressed
