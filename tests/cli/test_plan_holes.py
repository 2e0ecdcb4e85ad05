"""`sightline plan` of the holes of a nail: found in images, kept in a case, found again; and what is refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.picked import VIEWS, picks_file

from sightline.case.contents import PlanRequest
from sightline.case.interop.plan_file import PlanFile
from sightline.case.journal import Case, Kind
from sightline.case.views import calibrate_pair, see_pair
from sightline.errors import RefusedError
from sightline.frame import Frame
from sightline.imaging import Radiograph, write_dicom
from sightline.rehearsal.patient import NAILED, RehearsedPatient, draw_patient
from sightline.twin import render
from sightline.twin.scenes.bone_scene import placed_bone

KEYS = ("distal", "proximal")


def by_view(uv: Any, prefix: str = "") -> dict[str, Any]:
    return {f"{prefix}{view}": np.round(each, 2).tolist() for view, each in zip(VIEWS, uv, strict=True)}


@pytest.fixture(scope="module")
def patient(few_pixels: None) -> RehearsedPatient:
    return draw_patient(NAILED, 14, Frame.load("block60"))


@pytest.fixture(scope="module")
def asked(patient: RehearsedPatient) -> PlanRequest:
    return patient.asked(patient.generator("picks"), 0.5)[0]


@pytest.fixture(scope="module")
def files(patient: RehearsedPatient, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("nail")
    return [write_dicom(patient.images[view], folder / f"{view}.dcm") for view in VIEWS]


@pytest.fixture
def plan(run, asked: PlanRequest, files: list[Path], tmp_path: Path) -> Callable[..., Any]:
    """`plan(OPTIONS)`: both holes planned, with a file of their picks."""
    nail = asked.nail
    sizes = {name: getattr(nail.nail, f"{name}") for name in ("diameter_mm", "hole_mm", "bore_mm", "spacing_mm")}
    edges = by_view(nail.strokes_px.reshape(2, 4, 2))
    holes = {key: by_view(uv) for key, uv in nail.clicks_px.items()}
    marks = zip(asked.landmark_names, asked.landmarks_uv_px.swapaxes(0, 1), strict=True)
    content = {
        "nail": {"nail": {**sizes, "material": nail.nail.material}, "edges": edges, "holes": holes},
        "landmarks": [{"name": name, **by_view(uv)} for name, uv in marks],
    }

    def planned(*more: object, **change: Any) -> Any:
        picks = picks_file(tmp_path, **(content | change))
        given = ("--frame", "block60", "--procedure", NAILED, "--side", "right", "--picks", picks, "--json")
        return run("plan", *files, *given, *more)

    return planned


@pytest.mark.slow
def test_both_holes_are_planned_kept_and_found_again(run, plan, files, patient, asked, tmp_path: Path) -> None:
    case = tmp_path / "case"
    ran = plan("--case", case, "--out", tmp_path / "plan")
    assert ran.code == 0, ran.out
    assert ran.document["verdict"] == "go" and list(ran.document["wires"]) == list(KEYS)
    for wire_mm, (key, one) in zip(patient.wires_mm, ran.document["wires"].items(), strict=True):
        path, hole = one["trajectory"], one["hole"]
        along = (wire_mm[1] - wire_mm[0]) / np.linalg.norm(wire_mm[1] - wire_mm[0])
        off = np.linalg.norm(np.cross(np.array([path["entry_mm"], path["end_mm"]]) - wire_mm[0], along), axis=1)
        assert off.max() < 1.5 * path["error_95"]["entry_mm"]  # the seed is fixed
        assert path["entry_mm"][0] > path["end_mm"][0]  # from lateral
        assert 0.0 < hole["error_95"]["axis_mm"] < 0.3 and [turn["view"] for turn in hole["perfect_circle"]] == [*VIEWS]
        assert PlanFile.read(tmp_path / "plan", key).go
    page = (tmp_path / "plan" / "report-distal.html").read_text()
    assert page.count('class="nail"') >= 4 and "rim of the hole" in page  # both holes in both images
    assert "for a perfect circle turn the C-arm by orbit" in page and "No check covers" not in page
    with Case.open(case, read_only=True) as kept:
        nails = [entry.content["asked"]["nail"] for entry in kept.entries(Kind.PLANNED)]
        assert nails[0] == nails[1] and list(nails[0]["clicks_px"]) == list(KEYS)

    again = plan(in_bone=["distal"])
    assert again.code == 0, again.out
    (key,) = again.document["wires"]
    first, second = (made.document["wires"][key]["trajectory"] for made in (ran, again))
    assert key == "proximal" and first["entry_mm"] == second["entry_mm"]
    assert "spacing" in {check["name"] for check in again.document["relations"]}

    outcomes = run("case", "replay", case, "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}
    found = patient.asked(patient.generator("picks"), 0.5)[0].landmarks_uv_px.swapaxes(0, 1)
    marks = [{"name": key, **by_view(uv, "check-")} for key, uv in zip(asked.landmark_names, found, strict=True)]
    before = ["check-shot", *files, "--case", case, "--picks", picks_file(tmp_path, landmarks=marks), "--json"]
    refused = run(*before, "--wire", "distal")  # the images of the plan, without a drill
    assert refused.code == 3 and "no wire is seen" in refused.document["error"]["message"], refused.out


def half_hidden(patient: RehearsedPatient, folder: Path) -> list[Path]:
    """The images with metal over the half of each lens that the exit rim bounds."""
    files = []
    for view in VIEWS:
        pixels, white = patient.images[view].pixels.copy(), patient.images[view].white
        v, u = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
        for wire_mm in patient.wires_mm:
            entry, end = patient.setup.views[view].project(wire_mm)
            middle, along = (entry + end) / 2, (entry - end) / np.linalg.norm(entry - end)
            s = (u - middle[0]) * along[0] + (v - middle[1]) * along[1]
            x = (u - middle[0]) * along[1] - (v - middle[1]) * along[0]
            near = (np.abs(s) < 19) & (np.abs(x) < 16)
            pixels[near & (s > -2)] = np.quantile(pixels[near], 0.1)
        files.append(write_dicom(Radiograph(pixels, white), folder / f"half-{view}.dcm"))
    return files


@pytest.mark.slow
def test_what_shows_no_two_holes_of_this_nail_is_refused(asked, files, patient, tmp_path: Path) -> None:
    drawn, frame = asked.nail, Frame.load("block60")
    bent = replace(patient.bone.dimensions, bend_rad=np.deg2rad(9.0), bend_angle_rad=np.pi / 2)
    scene = placed_bone(patient.setup, "nailed-femur", bent, patient.bone.origin_mm, np.random.default_rng(1)).scene
    rng = np.random.default_rng(2)
    bowed = [write_dicom(render(patient.setup, view, scene, rng), tmp_path / f"{view}.dcm") for view in VIEWS]
    right, bowed, half = (
        calibrate_pair(see_pair(*pair, frame), frame, "smooth")
        for pair in (files, bowed, half_hidden(patient, tmp_path))
    )
    wide = replace(drawn, nail=replace(drawn.nail, hole_mm=5.4))
    for images, given, words in (
        (right, wide, "mm in the images and 5.4 mm as stated"),
        (bowed, drawn, "the nail is bent by 8.9° over 100 mm"),
        (half, drawn, "shows 1 points of the hole's rims (at least 5 are needed)"),
    ):
        with pytest.raises(RefusedError) as refused:
            replace(asked, nail=given).plan_wires(images)
        assert words in str(refused.value)
