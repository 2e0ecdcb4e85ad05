"""Files of picks for the command line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sightline.planning.procedures.procedure import copy_text

VIEWS = ("pa", "lateral")
WIRE_MM = np.array([[31.3, 28.9, -9.7], [-30.1, -27.7, 8.3]])
LANDMARKS_MM = np.array([[-21.3, -17.9, 4.4], [12.2, 30.1, -16.8]])


def typed(setup: Any, wire_mm: np.ndarray = WIRE_MM, shift_px: Any = 0.0) -> list[str]:
    """The options of a wire's entry and end; its lateral pixels are shifted."""
    texts = []
    for xyz_mm in wire_mm:
        (u, v), (s, t) = (setup.views[view].project(xyz_mm[None])[0] for view in VIEWS)
        ds, dt = np.broadcast_to(shift_px, 2)
        texts.append(f"pa:{u:.2f},{v:.2f} lateral:{s + ds:.2f},{t + dt:.2f}")
    return ["--entry", texts[0], "--end", texts[1]]


def marks_of(setup: Any, bone: Any, prefix: str = "") -> list[dict[str, Any]]:
    """The landmarks of a bone, as a file of picks has them."""
    return [
        {"name": "-".join(name.split()), **place(setup, xyz_mm, prefix)} for name, xyz_mm in bone.landmarks_mm.items()
    ]


def place(setup: Any, xyz_mm: np.ndarray, prefix: str = "") -> dict[str, list[float]]:
    """The pixels of a point in both views of a set-up, as a file of picks has them."""
    return {f"{prefix}{view}": setup.views[view].project(xyz_mm).round(3).tolist() for view in VIEWS}


def wire(setup: Any, ends_mm: Sequence[np.ndarray], *snapped: str) -> dict[str, Any]:
    """Entry and end of a wire."""
    entry, end = (place(setup, xyz_mm) for xyz_mm in ends_mm)
    return {"entry": entry, "end": end, "snapped": list(snapped)}


def screws_file(folder: Path, relation: str = "", *, without: str = "", **change: Any) -> Path:
    """Write the shipped file of three wires without checks of the bone, with a changed relation or without one."""
    given = json.loads(copy_text("cannulated-hip-screws", "mine"))
    given["checks"] = []
    given["relations"] = [one for one in given["relations"] if one["relation"] != without]
    for one in given["relations"]:
        one.update(change if one["relation"] == relation else {})
    (folder / "mine.json").write_text(json.dumps(given))
    return folder / "mine.json"


def picks_file(folder: Path, **content: Any) -> Path:
    """Write a file of picks."""
    file = folder / f"picks-{len(list(folder.glob('picks-*.json')))}.json"
    file.write_text(json.dumps({"schema": "sightline-picks/1", **content}))
    return file
