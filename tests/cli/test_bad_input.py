"""Bad input through the real command line: a clear message, the right exit code, no traceback, nothing half-written."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sightline.detection.csv_files import write_observations
from sightline.detection.results import Observations
from sightline.frame import Frame
from sightline.imaging import Radiograph, read_image, write_dicom

UNUSABLE, REFUSED = 2, 3
INSIDE = "pa:512,512 lateral:512,512"


@dataclass(frozen=True)
class World:
    """What a case may spoil: good images, good observations, the set-up behind them, a folder of its own."""

    pair: dict[str, Path]
    beads: dict[str, Observations]
    beads_csv: Path
    frame: Frame
    setup: Any
    folder: Path

    def write(self, name: str, data: bytes) -> Path:
        (self.folder / name).write_bytes(data)
        return self.folder / name

    def image(self, pixels: np.ndarray) -> Path:
        return write_dicom(Radiograph(pixels, 4095.0), self.folder / "image.dcm")

    def csv(self, *views: Observations) -> Path:
        return write_observations(views, self.folder / "beads.csv")

    def frame_file(self, change: Callable[[dict[str, Any]], object]) -> Path:
        self.frame.save(self.folder / "frame.json")
        document = json.loads((self.folder / "frame.json").read_text())
        change(document)
        return self.write("frame.json", json.dumps(document).encode())

    def pixel(self, view: str, xyz_mm: tuple[float, float, float]) -> str:
        u, v = self.setup.views[view].project(np.array([xyz_mm]))[0]
        return f"{view}:{u:.2f},{v:.2f}"

    def plan(self, entry: str, end: str, *more: object) -> list[object]:
        return ["plan", self.beads_csv, self.beads_csv, "--entry", entry, "--end", end, *more]

    def both(self, xyz_mm: tuple[float, float, float]) -> str:
        return f"{self.pixel('pa', xyz_mm)} {self.pixel('lateral', xyz_mm)}"


def only(beads: Observations, rows: Any) -> Observations:
    """Some of the beads of a view."""
    assert beads.covariance_px2 is not None
    ids = tuple(np.array(beads.ids)[rows])
    return Observations(beads.view, ids, beads.uv_px[rows], beads.covariance_px2[rows])


def flat(discs: int = 0) -> np.ndarray:
    """An evenly lit noisy image with a few balls."""
    light = np.full((512, 512), 2000.0)
    for k in range(discs):
        cv2.circle(light, (150 + 100 * k, 200 + 60 * (k % 2)), 9, 300.0, -1, cv2.LINE_AA)
    light = cv2.GaussianBlur(light, (0, 0), 1.5)
    return np.clip(np.random.default_rng(2).normal(light, 30.0), 0, 4095).astype(np.uint16)


def half_field(w: World) -> list[object]:
    """The XRII plate lies half outside the field: the image is black there."""
    pixels = read_image(w.pair["pa"]).pixels.copy()
    pixels[:, pixels.shape[1] // 3 :] = 0
    return ["calibrate", w.image(pixels)]


def half_plate(w: World) -> list[object]:
    """Observations of a fifth of the XRII plate only."""
    beads = w.beads["pa"]
    near = {f.id for f in w.frame.view("pa").xrii.fiducials if f.xyz_mm[0] < 20.0}
    rows = [i for i, name in enumerate(beads.ids) if name in near or "-s-" in name]
    kept = [i for i in rows if beads.uv_px[i, 0] < np.median(beads.uv_px[:, 0])]
    return ["calibrate", w.csv(only(beads, kept))]


def twice(document: dict[str, Any]) -> None:
    document["views"]["pa"]["xrii"][1]["id"] = document["views"]["pa"]["xrii"][0]["id"]


def parallel_views(w: World) -> list[object]:
    """A frame whose "lateral" plates are its PA plates turned by half a degree: the lines of sight nearly coincide."""
    c, s = np.cos(np.deg2rad(0.5)), np.sin(np.deg2rad(0.5))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])

    def nearly_one(document: dict[str, Any]) -> None:
        document.pop("covariance_mm2", None)
        plates = json.loads(json.dumps(document["views"]["pa"]))
        for bead in plates["xrii"] + plates["source"]:
            bead["id"] = "t" + bead["id"]
            bead["xyz"] = (turn @ bead["xyz"]).tolist()
        document["views"]["lateral"] = plates

    path = w.frame_file(nearly_one)
    frame = Frame.load(path)
    focal = np.array([15.0, -10.0, -620.0])
    views = []
    for name, source in (("pa", focal), ("lateral", turn @ focal)):
        plates = frame.view(name)
        on_plate = plates.xrii.plane.central_projection(source, np.array([f.xyz_mm for f in plates.fiducials]))
        noise = np.random.default_rng(6).normal(0, 0.1, on_plate.shape)
        uv_px = 512 + 4.0 * on_plate + noise
        ids = tuple(f.id for f in plates.fiducials)
        views.append(Observations(name, ids, uv_px, np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0)))
    beads = w.csv(*views)
    picks = ["--entry", "pa:480,500 lateral:480,500", "--end", "pa:550,530 lateral:550,530"]
    return ["plan", beads, beads, "--frame", path, *picks]


# What is wrong -> (the command line, its exit code, what the message says)
CASES: dict[str, tuple[Callable[[World], list[object]], int, str]] = {
    "not an image": (lambda w: ["detect", w.write("a.dcm", b"%PDF-1.7")], UNUSABLE, "not an image"),
    "empty": (lambda w: ["detect", w.write("a.dcm", b"")], UNUSABLE, "is empty"),
    "absent": (lambda w: ["detect", w.folder / "a.dcm"], UNUSABLE, "cannot read a.dcm"),
    "truncated": (
        lambda w: ["calibrate", w.write("a.dcm", w.pair["pa"].read_bytes()[:-9999])],
        UNUSABLE,
        "damaged",
    ),
    "wrong frame for the image": (lambda w: ["calibrate", w.pair["pa"], "--frame", "stereo"], REFUSED, "frame|datum"),
    "wrong frame for the observations": (
        lambda w: ["calibrate", w.beads_csv, "--view", "pa", "--frame", "stereo"],
        UNUSABLE,
        "stereo",
    ),
    "wrong view for the image": (lambda w: ["calibrate", w.pair["pa"], "--view", "lateral"], REFUSED, "'pa'|pa view"),
    "one view given twice": (
        lambda w: ["plan", w.pair["pa"], w.pair["pa"], "--entry", INSIDE, "--end", INSIDE],
        UNUSABLE,
        "one PA and one lateral",
    ),
    "PA and lateral swapped": (
        lambda w: ["plan", w.pair["lateral"], w.pair["pa"], "--entry", INSIDE, "--end", INSIDE],
        UNUSABLE,
        "swapped",
    ),
    "no beads": (lambda w: ["detect", w.image(flat())], REFUSED, "no bead"),
    "no beads, for the calibration": (lambda w: ["calibrate", w.image(flat())], REFUSED, "bead"),
    "three beads": (lambda w: ["calibrate", w.image(flat(discs=3))], REFUSED, "bead"),
    "three beads observed": (lambda w: ["calibrate", w.csv(only(w.beads["pa"], [0, 1, 9]))], REFUSED, "bead"),
    "most of the plate outside the field": (half_field, REFUSED, "plate"),
    "part of the plate observed": (half_plate, REFUSED, "plate"),
    "a frame file with a wrong unit": (
        lambda w: ["frame", "show", w.frame_file(lambda d: d.update(units="inch"))],
        UNUSABLE,
        "mm",
    ),
    "a frame file with a duplicate id": (lambda w: ["frame", "show", w.frame_file(twice)], UNUSABLE, "twice|duplicate"),
    "a frame that is not there": (lambda w: ["calibrate", w.beads_csv, "--frame", "delta"], UNUSABLE, "gamma"),
    "NaN in an image": (lambda w: ["detect", w.folder / "nan.npy"], UNUSABLE, "not finite"),
    "NaN in observations": (
        lambda w: ["calibrate", w.write("a.csv", b"view,id,u_px,v_px\npa,pa-x-0-0,nan,2\n")],
        UNUSABLE,
        "line 2",
    ),
    "NaN in a frame file": (
        lambda w: ["frame", "show", w.frame_file(lambda d: d["views"]["pa"]["xrii"][0].update(diameter=float("nan")))],
        UNUSABLE,
        "finite|NaN|nan",
    ),
    "NaN as a plan point": (lambda w: w.plan("pa:nan,2 lateral:3,4", INSIDE), UNUSABLE, "pa:U,V"),
    "a plan point that is none": (lambda w: w.plan("512", INSIDE), UNUSABLE, "pa:U,V"),
    "a plan point outside the field": (
        lambda w: w.plan("pa:-900,-900 lateral:512,512", w.both((5, 5, 5))),
        REFUSED,
        "outside",
    ),
    "a plan point outside the calibrated region": (
        lambda w: w.plan(w.both((0, 0, 0)), "pa:60,60 lateral:60,60"),
        REFUSED,
        "outside|hull",
    ),
    "lines of sight nearly parallel": (parallel_views, REFUSED, "parallel"),
    "a report where none can be written": (
        lambda w: w.plan(w.both((-30, 0, -30)), w.both((20, 0, 20)), "--out", w.write("file", b"") / "report"),
        UNUSABLE,
        "cannot",
    ),
}


@pytest.fixture
def world(pair, observations, beads_csv: Path, frame: Frame, setup, tmp_path: Path) -> World:
    np.save(tmp_path / "nan.npy", np.full((64, 64), np.nan))
    return World(pair, observations, beads_csv, frame, setup, tmp_path)


@pytest.mark.parametrize("case", CASES)
def test_bad_input_ends_in_a_message_that_says_what_to_do(run, world: World, case: str) -> None:
    make, code, says = CASES[case]
    arguments = make(world)
    before = sorted(world.folder.rglob("*"))
    ran = run(*arguments, "--json")
    message = ran.document["error"]["message"] if "error" in ran.document else failed_sentences(ran.document)
    assert ran.code == code, message
    assert_matches(says, message)
    assert str(world.pair["pa"].parent) not in message, "a message names images, not where they lie"
    assert ran.err == ""
    assert sorted(world.folder.rglob("*")) == before, "something was left behind"


def failed_sentences(document: dict[str, Any]) -> str:
    """A result that is printed but must not be trusted says so in its checks."""
    return " ".join(f"{check['name']}: {check['sentence']}" for check in document["checks"] if not check["passed"])


def assert_matches(says: str, message: str) -> None:
    assert any(part in message for part in says.split("|")), message
    assert "Traceback" not in message
    assert len(message) > 20


def test_a_mirror_image_is_found_and_said(run, world: World) -> None:
    """Its geometry is as good as any other; the person must know before picking a side."""
    pixels = read_image(world.pair["pa"]).pixels[:, ::-1].copy()
    ran = run("calibrate", world.image(pixels), "--json")
    assert ran.code in (0, REFUSED)
    if "error" in ran.document:
        assert "mirror" in ran.document["error"]["message"]
    else:
        assert ran.document["mirrored"] is True


def test_a_view_without_covariance_is_no_go() -> None:
    """Such a view comes from another system's matrix, through Python; its plan is NO-GO: error unknown."""
    import sightline as sl
    from sightline.planning import kind, plan

    def camera(focal_mm: np.ndarray, toward: np.ndarray) -> np.ndarray:
        across = np.cross([0.0, 1.0, 0.0], toward)
        turn = np.stack([across, np.cross(toward, across), toward])
        inner = np.array([[4000.0, 0, 512], [0, 4000.0, 512], [0, 0, 1]])
        return inner @ np.column_stack([turn, -turn @ focal_mm])

    matrices = [
        camera(np.array([0, 0, -620.0]), np.array([0, 0, 1.0])),
        camera(np.array([-620.0, 0, 0]), np.array([1.0, 0, 0])),
    ]
    views = [sl.view_from_matrix(matrix, name=name) for matrix, name in zip(matrices, ("pa", "lateral"), strict=True)]
    planned = plan(
        views, np.array([[500.0, 512], [500, 512]]), np.array([[620.0, 512], [620, 512]]), kind=kind("free-wire")
    )
    assert not planned.verdict.go
    failed = [check for check in planned.verdict.checks if not check.passed]
    assert any("unknown" in check.sentence for check in failed)
    with pytest.raises(sl.SightlineError, match="covariance"):
        _ = planned.trajectory.points.covariance_mm2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["not an image", "three beads observed", "NaN in observations"])
def test_the_installed_command_shows_a_person_one_line_and_no_traceback(world: World, name: str) -> None:
    make, code, says = CASES[name]
    script = [sys.executable, "-c", "from sightline.cli import main; main()", *map(str, make(world)), "--quiet"]
    done = subprocess.run(  # noqa: S603
        script, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("sightline: ")
    assert_matches(says, done.stderr)
