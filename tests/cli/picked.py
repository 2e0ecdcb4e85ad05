"""Files of picks for the command line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

VIEWS = ("pa", "lateral")


def place(setup: Any, xyz_mm: np.ndarray, prefix: str = "") -> dict[str, list[float]]:
    """The pixels of a point in both views of a set-up, as a file of picks has them."""
    return {f"{prefix}{view}": setup.views[view].project(xyz_mm).round(3).tolist() for view in VIEWS}


def wire(setup: Any, ends_mm: Sequence[np.ndarray], *snapped: str) -> dict[str, Any]:
    """Entry and end of a wire."""
    entry, end = (place(setup, xyz_mm) for xyz_mm in ends_mm)
    return {"entry": entry, "end": end, "snapped": list(snapped)}


def picks_file(folder: Path, **content: Any) -> Path:
    """Write a file of picks."""
    file = folder / f"picks-{len(list(folder.glob('picks-*.json')))}.json"
    file.write_text(json.dumps({"schema": "sightline-picks/1", **content}))
    return file
