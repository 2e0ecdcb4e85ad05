"""MuJoCo, the extra `robot`, imported where something needs it."""

import os
from importlib import import_module
from typing import Any

from sightline.errors import SetUpError


def import_mujoco(purpose: str) -> Any:
    """Return the module. Raises SetUpError, which names the `purpose`, if it is not installed."""
    try:
        return import_module("mujoco")
    except ImportError as error:
        raise SetUpError(f"{purpose} needs MuJoCo: pip install 'sightline[robot]'") from error
    except (AttributeError, RuntimeError):
        if "MUJOCO_GL" not in os.environ:
            raise
        # The graphics that it names are not there. Here nothing is drawn.
        named, os.environ["MUJOCO_GL"] = os.environ["MUJOCO_GL"], "disable"
        try:
            return import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = named
