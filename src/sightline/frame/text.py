"""Write the text of frame files (docs/frame-file.md) in a readable layout. It is not checked here: see `files`."""

import json
from collections.abc import Mapping
from typing import Any

from sightline.frame.plate import RigidBody


def body_document(body: RigidBody) -> list[dict[str, Any]]:
    """Return the document of a plate or a solid as plain values, unchecked."""
    out: list[dict[str, Any]] = []
    for f in body.fiducials:
        one: dict[str, Any] = {"id": f.id, "xyz": list(f.xyz_mm), "diameter": f.diameter_mm, "datum": f.datum}
        out.append(one if f.shape == "ball" else {**one, "shape": f.shape})
    return out


def json_of(document: Mapping[str, Any]) -> bytes:
    """Return the text of a frame file, with a line for each fiducial and each row of the covariance."""
    blocks = ("views", "solid", "covariance_mm2")
    parts = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in document.items() if key not in blocks]
    if "views" in document:
        views = [_view_text(name, view) for name, view in document["views"].items()]
        parts.append(' "views": {\n' + ",\n".join(views) + "\n }")
    parts += [f' "{key}": ' + _lines(document[key], "  ") for key in ("solid", "covariance_mm2") if key in document]
    return ("{\n" + ",\n".join(parts) + "\n}\n").encode()


def _view_text(name: str, view: dict[str, list[Any]]) -> str:
    plates = ",\n".join(f'   "{role}": {_lines(fiducials, "    ")}' for role, fiducials in view.items())
    return f"  {json.dumps(name)}: {{\n{plates}\n  }}"


def _lines(entries: list[Any], indent: str) -> str:
    return "[\n" + ",\n".join(indent + json.dumps(entry) for entry in entries) + f"\n{indent[:-1]}]"
