"""Frames in files."""

from pathlib import Path

from sightline.frame.builtin import BUILTIN, builtin_frame
from sightline.frame.model import Frame


def load_frame(source: str | Path) -> Frame:
    """See `Frame.load`."""
    if isinstance(source, str) and source in BUILTIN:
        return builtin_frame(source)
    raise NotImplementedError


def save_frame(frame: Frame, path: str | Path) -> None:
    """See `Frame.save`."""
    raise NotImplementedError
