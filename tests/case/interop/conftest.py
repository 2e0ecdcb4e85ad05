"""A plan as `sightline plan --out` writes it, on a set-up of the twin with images of noise."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.case.conftest import HOSTILE, LANDMARKS_MM, WIRE_MM

from sightline.case.interop.plan_file import PlanFile, bundle, sealed
from sightline.case.views import NAMES, calibrate_pair
from sightline.cli.base import as_json
from sightline.cli.plan import plan_document
from sightline.planning import kind, plan


@pytest.fixture(scope="session")
def plan_folder(pair, frame, setup, tmp_path_factory: pytest.TempPathFactory) -> Path:
    images = calibrate_pair(pair, frame, "smooth")
    entry, end = (np.stack([setup.views[name].project(one[None])[0] for name in NAMES]) for one in WIRE_MM)
    landmarks = np.stack([setup.views[name].project(LANDMARKS_MM) for name in NAMES])
    planned = plan(
        [image.view for image in images],
        entry,
        end,
        pick_sd_px=0.1,
        landmarks_uv_px=landmarks,
        procedure=kind("free-wire"),
        side="right",
    )
    taken, files = bundle(planned, images, frame)
    folder = tmp_path_factory.mktemp("plan")
    text = as_json(sealed({**plan_document(planned, images), **taken, "checks": planned.verdict.checks}))
    assert HOSTILE.replace('"', "") in text  # plan.json names the images' files; no export may
    (folder / "plan.json").write_text(text)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


@pytest.fixture(scope="session")
def go_plan(plan_folder: Path) -> PlanFile:
    out = PlanFile.read(plan_folder)
    assert out.go, out.failed
    return out


@pytest.fixture(scope="session")
def no_go_plan(plan_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> PlanFile:
    document: dict[str, Any] = json.loads((plan_folder / "plan.json").read_text())
    folder = tmp_path_factory.mktemp("no-go")
    for image in plan_folder.glob("*.png"):
        (folder / image.name).write_bytes(image.read_bytes())
    document["go"] = False
    document["checks"][0]["passed"] = False
    document["verdict"] = "no-go"
    (folder / "plan.json").write_text(json.dumps(sealed(document)))
    return PlanFile.read(folder)
