"""Input that cannot be used, through the real command line: exit code, a message that says what to do, nothing written.

A line of CASES is what a person types; words in capitals are files of FILES, `@x,y,z` is a point in both images.
"""

import json
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from nibabel.nifti1 import Nifti1Header, Nifti1Image
from tests.cli.picked import picks_file

from sightline.case.journal import Case
from sightline.detection.csv_files import write_observations
from sightline.detection.results import Observations
from sightline.frame import Frame
from sightline.imaging import Radiograph, read_image, write_dicom

P = "'pa:512,512 lateral:512,512'"
WIRE = f"--entry {P} --end {P}"


@dataclass(frozen=True)
class World:
    """What a case may spoil: good images, good observations, the set-up behind them, a folder of its own."""

    pair: dict[str, Path]
    beads: dict[str, Observations]
    beads_csv: Path
    frame: Frame
    setup: Any
    folder: Path

    def write(self, name: str, data: bytes = b"") -> Path:
        (self.folder / name).write_bytes(data)
        return self.folder / name

    def image(self, pixels: np.ndarray) -> Path:
        return write_dicom(Radiograph(pixels, 4095.0), self.folder / "image.dcm")

    def frame_file(self, change: Callable[[dict[str, Any]], object]) -> Path:
        self.frame.save(self.folder / "frame.json")
        document = json.loads((self.folder / "frame.json").read_text())
        change(document)
        return self.write("frame.json", json.dumps(document).encode())

    def both(self, xyz_mm: list[float]) -> str:
        uv = {name: self.setup.views[name].project(np.array([xyz_mm]))[0] for name in ("pa", "lateral")}
        return " ".join(f"{name}:{u:.2f},{v:.2f}" for name, (u, v) in uv.items())

    def first(self, count: int) -> Path:
        pa = self.beads["pa"]
        few = replace(pa, ids=pa.ids[:count], uv_px=pa.uv_px[:count], covariance_px2=pa.covariance_px2[:count])
        return write_observations([few], self.folder / "beads.csv")


def flat(discs: int = 0) -> np.ndarray:
    """An evenly lit noisy image with a few balls."""
    light = np.full((512, 512), 2000.0)
    for k in range(discs):
        cv2.circle(light, (150 + 100 * k, 200 + 60 * (k % 2)), 9, 300.0, -1, cv2.LINE_AA)
    light = cv2.GaussianBlur(light, (0, 0), 1.5)
    return np.clip(np.random.default_rng(2).normal(light, 30.0), 0, 4095).astype(np.uint16)


def half_field(w: World) -> Path:
    """The XRII plate lies half outside the field: the image is black there."""
    pixels = read_image(w.pair["pa"]).pixels.copy()
    pixels[:, pixels.shape[1] // 3 :] = 0
    return w.image(pixels)


def wide_frame(document: dict[str, Any]) -> None:
    for view in document["views"].values():
        for bead in view["xrii"] + view["source"]:
            bead["xyz"] = [3 * c for c in bead["xyz"]]


def scan_without_spacing(w: World) -> Path:
    header = Nifti1Header()
    header.set_data_shape((60, 60, 60))
    header["sform_code"] = 1
    Nifti1Image(np.full((60, 60, 60), -1000, dtype=np.int16), None, header).to_filename(w.folder / "scan.nii.gz")
    return w.folder / "scan.nii.gz"


def folder_of(w: World, name: str, data: bytes = b"") -> Path:
    (w.folder / "images").mkdir()
    if name:
        w.write(f"images/{name}", data)
    return w.folder / "images"


DICM = b"\0" * 128 + b"DICM" + b"\0" * 40
FILES: dict[str, Callable[[World], object]] = {
    "PA": lambda w: w.pair["pa"],
    "CSV": lambda w: w.beads_csv,
    "OUT": lambda w: w.folder / "out",
    "NOTHING": lambda w: w.folder / "a.dcm",
    "PDF": lambda w: w.write("a.dcm", b"%PDF-1.7"),
    "EMPTY": lambda w: w.write("a.dcm"),
    "TRUNCATED": lambda w: w.write("a.dcm", w.pair["pa"].read_bytes()[:-9999]),
    "TORN": lambda w: w.write("torn.dcm", w.pair["pa"].read_bytes()[:1500]),
    "NAN_IMAGE": lambda w: w.folder / "nan.npy",
    "NAN_CSV": lambda w: w.write("a.csv", b"view,id,u_px,v_px\npa,pa-x-0-0,nan,2\n"),
    "FLAT": lambda w: w.image(flat()),
    "THREE_BALLS": lambda w: w.image(flat(discs=3)),
    "THREE_BEADS": lambda w: w.first(3),
    "HALF_FIELD": half_field,
    "WIDE_FRAME": lambda w: w.frame_file(wide_frame),
    "FILE": lambda w: w.write("file"),
    "BELOW_FILE": lambda w: w.write("file") / "below",
    "SCAN": scan_without_spacing,
    "NOTES": lambda w: w.write("notes.txt", b"hello"),
    "EMPTY_CASE": lambda w: (Case.create(w.folder / "empty").close(), w.folder / "empty")[1],
    "EMPTY_FOLDER": lambda w: folder_of(w, ""),
    "BROKEN_FOLDER": lambda w: folder_of(w, "broken.dcm", DICM),
    "BROKEN": lambda w: w.write("broken.dcm", DICM),
    "POINTS": lambda w: w.write("points.csv", b"name,x_mm,y_mm,z_mm\nball0,1,2,3\n"),
    "BAD_POINTS": lambda w: w.write("points.csv", b"name,x_mm,y_mm,z_mm\nball0,1,2,three\n"),
}
CASES = (
    ("detect PDF", 2, "not an image"),
    ("detect EMPTY", 2, "is empty"),
    ("detect NOTHING", 2, "cannot read a.dcm"),
    ("detect NAN_IMAGE", 2, "not finite"),
    ("detect FLAT", 3, "no bead"),
    ("calibrate FLAT", 3, "bead"),
    ("calibrate THREE_BALLS", 3, "bead"),
    ("calibrate THREE_BEADS", 3, "bead"),
    ("calibrate HALF_FIELD", 3, "plate"),
    ("calibrate TRUNCATED", 2, "damaged"),
    ("calibrate NAN_CSV", 2, "line 2"),
    ("calibrate PA --frame stereo", 3, "frame|datum"),
    ("calibrate CSV --view pa --frame stereo", 2, "stereo"),
    ("calibrate CSV --frame delta", 2, "gamma"),
    ("calibrate PA --view lateral", 3, "'pa'|pa view"),
    ("calibrate CSV", 2, "--view"),
    ("calibrate CSV --view pa --datum x=1,2", 2, "are for images"),
    ("calibrate CSV --view pa --frame-index 0", 2, "are for images"),
    *((f"calibrate PA --datum={datum}", 2, "not ID=U,V") for datum in ("x=1", "x=1,2,3", "1,2")),
    ("calibrate PA --datum=x=nan,2", 2, "not finite"),
    ("calibrate PA --datum=x=1,2 --datum=x=3,4", 2, "given twice"),
    ("undistort CSV --out OUT", 2, "give the image"),
    ("undistort PA --out OUT --spacing 0", 2, "spacing"),
    ("undistort x.png --out OUT --frame block60", 2, "is a solid"),
    ("watch x --frame block60", 2, "is a solid"),
    ("watch", 2, "give one source"),
    ("watch somewhere --rehearse 1", 2, "give one source"),
    ("watch nowhere.mp4", 2, "no file or folder"),
    ("watch EMPTY_FOLDER", 2, "no image"),
    ("plan CSV CSV --entry 'pa:nan,2 lateral:3,4' --end " + P, 2, "pa:U,V"),
    ("plan CSV CSV --entry 512 --end " + P, 2, "pa:U,V"),
    ("plan CSV CSV --entry 'pa:-900,-900 lateral:512,512' --end @5,5,5", 3, "outside"),
    ("plan CSV CSV --entry @0,0,0 --end 'pa:60,60 lateral:60,60'", 3, "outside|hull"),
    ("plan CSV CSV --entry 'pa:512,512 depth:9000' --end 'pa:400,400 depth:300'", 2, "9000 mm is outside the lateral"),
    (f"plan CSV CSV --entry {P}", 2, "--end is missing"),
    (f"plan CSV CSV {WIRE} --procedure cannulated-hip-screws", 2, "has several wires"),
    ("plan CSV CSV --procedure tunnel", 2, "unknown procedure 'tunnel'"),
    ("plan CSV CSV --entry @-30,0,-30 --end @20,0,20 --out BELOW_FILE", 2, "cannot"),
    (f"plan {WIRE}", 2, "give the PA and the lateral image, or --case"),
    (f"plan CSV {WIRE}", 2, "the lateral image is missing"),
    (f"plan --case nowhere {WIRE}", 2, "no case"),
    (f"plan --case EMPTY_CASE {WIRE}", 2, "no usable PA and no lateral image"),
    (f"plan none.csv none.csv --case OUT {WIRE}", 2, "none.csv"),
    ("plan CSV CSV CSV " + WIRE, 2, "whose plates are for the views pa and lateral only"),
    ("check-shot --case EMPTY_CASE", 2, "plan --case"),
    ("case report EMPTY_CASE --out OUT", 2, "holds no plan yet"),
    *((f"case {command} EMPTY_FOLDER", 2, "no case in") for command in ("check", "replay", "show")),
    ("frame new OUT --csv no.csv", 2, "cannot read no.csv"),
    ("frame new OUT --csv no.csv --rows 9", 2, "leave out the other values"),
    ("frame new OUT --like delta", 2, "no frame file 'delta'"),
    ("frame new OUT --like block60 --rows 9", 2, "block60 is copied"),
    ("frame new OUT --like block60 --units mm", 2, "--csv alone"),
    ("frame new OUT --rows 2", 2, "4 to 20 rows"),
    ("frame new OUT --pitch-mm -1", 2, "pitch above zero"),
    ("frame new OUT --datums 2", 2, "ask for 6"),
    ("frame new FILE", 2, "exists"),
    ("frame fit CSV --frame gamma --out FILE", 2, "exists"),
    ("frame self-check CSV CSV --out FILE", 2, "exists"),
    ("frame self-check 1.dcm 2.dcm 3.dcm 4.dcm --frame block60", 2, "do not show its size"),
    ("frame self-check 1.dcm 2.dcm --frame block60 --distance b1,b1,55,0.02", 2, "two different balls"),
    ("frame draw no.json --out OUT", 2, "no.json"),
    ("frame draw block30 --out FILE", 2, "file"),
    ("frame draw block30 --out OUT --clearance-mm 3", 2, "less than or equal to 1"),
    ("assess CSV CSV --truth POINTS", 2, "give the test points' pixels in --truth, or give the images themselves"),
    ("assess CSV CSV --truth BAD_POINTS", 2, "points.csv, line 2"),
    ("simulate SCAN --out OUT", 2, "spacing"),
    ("simulate object --frame WIDE_FRAME --out OUT", 2, "into the field"),
    ("simulate knee --out OUT", 2, "there is no specimen 'knee'"),
    ("simulate --preset 8in --out OUT", 2, "9in-pal"),
    ("simulate --frame block60 --preset 9in-1k --out OUT", 2, "flat-panel"),
    ("simulate hip --at 1,2 --out OUT", 2, "is not a point"),
    ("simulate hip --at 1,2,3 --out OUT", 2, "has a fixed position"),
    ("simulate --png --tags --out OUT", 2, "no geometry tags"),
    ("simulate NOTES --out OUT", 2, "NIfTI"),
    ("simulate hip --with cast --out OUT", 2, "guide-wire, lag-screw, angled-plate"),
    ("simulate object --with lag-screw --out OUT", 2, "a hip"),
    ("demo --procedure hip --out OUT", 2, "hip-screw"),
    ("export views PA --to maya --out OUT", 2, "unknown format of a view"),
    ("export views CSV CSV --raw --out OUT", 2, "no pixels"),
    ("export views PA --raw --out OUT", 3, "too distorted for a pinhole"),
    ("export undistorted CSV CSV --out OUT", 2, "no pixels"),
    ("export undistorted PA --to gif --out OUT", 2, "not an image format"),
    ("export plan nowhere --out OUT", 2, "cannot read"),
    ("export deidentify PA TORN --out OUT", 2, "torn|damaged"),
    ("acquire folder NOTHING --case OUT", 2, "there is no such folder"),
    ("acquire dicom --peer nobody --case OUT", 2, "a peer is AET@HOST"),
    ("acquire dicom --case OUT", 2, "--peer"),
    ("acquire folder EMPTY_FOLDER --case OUT --robot 127.0.0.1:9", 2, "needs --watch"),
    ("acquire folder EMPTY_FOLDER --case OUT --watch --robot 127.0.0.1:9", 2, "connect"),
    ("acquire video absent.avi --case OUT", 2, "cannot be opened"),
    ("acquire video BROKEN --case OUT", 2, "broken.dcm"),
    ("compare NOTHING --out OUT", 2, "not a folder"),
    ("compare EMPTY_FOLDER --out OUT", 2, "no image"),
    ("compare BROKEN_FOLDER --out OUT", 2, "broken.dcm"),
    ("study tabel1 --out OUT", 2, "table1"),
    ("study budget --trials 0 --out OUT", 2, "trials"),
    ("study budget --trials 1 --out FILE", 2, "cannot write"),
    ("robot serve --rehearse 9 --frame-serial SN-1", 2, "leave out --frame-serial"),
    ("robot serve --rehearse -1", 2, "rehearse"),
    ("robot serve --rehearse 9 --frame unobtainium", 2, "unobtainium"),
    ("robot reset nowhere", 2, "is not an address"),
    *(
        (f"robot check {address}", 2, "is not an address")
        for address in ("nowhere", "127.0.0.1:", ":1", "127.0.0.1:99999", "127.0.0.1:x")
    ),
    ("robot check 127.0.0.1:1", 2, "cannot connect"),
)  # fmt: skip
BOTH = {"pa": [500, 500], "lateral": [500, 500]}
ENDS = {"entry": BOTH, "end": BOTH}
EDGE = [[1, 2], [3, 4], [5, 6], [7, 8]]
SIZES = {"diameter_mm": 11, "hole_mm": 5, "bore_mm": 5, "material": "titanium"}
NAIL = {"nail": SIZES, "edges": {"pa": EDGE, "lateral": EDGE}, "holes": {"distal": BOTH}}
PICKED, OF_NAIL = f"plan CSV CSV {WIRE}", "plan CSV CSV --procedure distal-interlocking"
# The line, the content of a file of picks, the message.
PICKS: tuple[tuple[str, dict[str, Any], str], ...] = (
    (PICKED, {"head": {"pa": [1, 2, 3]}}, "head needs a circle in pa and lateral"),
    (PICKED, {"head": {"pa": [500, 500, -9], "lateral": [5, 5, 9]}}, "head.pa[2] Input should be greater than 0"),
    (PICKED, {"landmarks": [{"name": "patella", **BOTH}]}, "lesser-trochanter"),
    (PICKED, {"landmarks": [{"pa": [500, 500]}]}, "landmarks[0] needs its pixels in two images"),
    (PICKED, {"landmarks": [{**BOTH, "depth": 300}]}, "is not a key of a file of picks"),
    (PICKED, {"landmarks": [{**BOTH, "oblique": [1, 2]}]}, "points are picked in an oblique image"),
    (PICKED, {"aids": {"shaft": {"pa": [[1, 2]], "lateral": [[3, 4]]}}}, "a line needs two finite pixels"),
    (PICKED, {"aids": {"skull": {"pa": [[1, 2]]}}}, "has no aid 'skull'; choose one of head, shaft"),
    (PICKED, {"fit": ["head"], "head": {"pa": [5, 5, 9], "lateral": [5, 5, 9]}}, "table of beads"),
    (PICKED, {"fit": ["neck"]}, "the neck, which is not drawn"),
    (PICKED, {"mirrored": ["AP"]}, "'AP' is not a view"),
    ("plan CSV CSV", {"wires": {"guide-wire": {"entry": {"pa": [1, 2]}, "end": BOTH}}}, "needs entry and end, each"),
    ("plan CSV CSV", {"wires": {"tibia": ENDS}}, "has no wire 'tibia'; its wires are guide-wire"),
    ("plan CSV CSV", {"in_bone": ["guide-wire"]}, "give entry and end of each"),
    ("plan CSV CSV", {}, "no wire is picked"),
    ("plan CSV CSV", {"schema": "sightline-picks/9"}, "schema"),
    (OF_NAIL, {}, "no wire is picked"),
    (OF_NAIL, {"nail": {**NAIL, "holes": {}}}, "nail needs its edges in pa and lateral, and a hole"),
    (OF_NAIL, {"nail": {**NAIL, "edges": {"pa": EDGE}}}, "nail needs its edges in pa and lateral, and a hole"),
    (OF_NAIL, {"nail": {**NAIL, "holes": {"distal": {"pa": [1, 2]}}}}, "needs each hole's pixel in pa and lateral"),
    (OF_NAIL, {"nail": {**NAIL, "nail": {**SIZES, "hole_mm": 12}}}, "a nail of 11.0 mm cannot have holes"),
    (OF_NAIL, {"nail": {**NAIL, "nail": {**SIZES, "material": "brass"}}}, "titanium"),
    (OF_NAIL, {"nail": {**NAIL, "nail": "brass-11"}}, "is not a nail's file; give one, or one of steel-10"),
    (OF_NAIL, {"nail": NAIL, "in_bone": ["distal"]}, "leave one to plan"),
    (OF_NAIL, {"nail": NAIL, "wires": {"distal": ENDS}}, "leave wires out"),
)  # fmt: skip


@pytest.fixture
def world(pair, observations, beads_csv: Path, frame: Frame, setup, tmp_path: Path) -> World:
    np.save(tmp_path / "nan.npy", np.full((64, 64), np.nan))
    return World(pair, observations, beads_csv, frame, setup, tmp_path)


def words_of(line: str, world: World) -> list[object]:
    words: list[object] = []
    for word in shlex.split(line):
        if word.startswith("@"):
            words.append(world.both([float(number) for number in word[1:].split(",")]))
        else:
            words.append(FILES[word](world) if word in FILES else word)
    return words


def message_of(ran: Any) -> str:
    """The error, or the sentences of failed checks, or what the parser of the command line says."""
    if not ran.out.startswith("{"):
        return re.sub(r"\W*│\W*|\s+", " ", ran.err + ran.out)
    document = ran.document
    if "error" in document:
        return document["error"]["message"]
    return " ".join(f"{check['name']}: {check['sentence']}" for check in document["checks"] if not check["passed"])


def refused(run, world: World, words: list[object], code: int, says: str) -> None:
    before = sorted(world.folder.rglob("*"))
    ran = run(*words, "--json")
    message = message_of(ran)
    assert ran.code == code, message
    assert any(part in message for part in says.split("|")), message
    assert "Traceback" not in message + ran.err
    assert str(world.pair["pa"].parent) not in message, "a message names images, not where they lie"
    assert sorted(world.folder.rglob("*")) == before, "something was left behind"


@pytest.mark.parametrize(("line", "code", "says"), CASES, ids=[case[0] for case in CASES])
def test_what_cannot_be_used_ends_in_a_message_and_writes_nothing(run, world, line: str, code: int, says: str) -> None:
    refused(run, world, words_of(line, world), code, says)


@pytest.mark.parametrize(("line", "content", "says"), PICKS)
def test_picks_that_cannot_be_used_are_refused(run, world, line: str, content: dict[str, Any], says: str) -> None:
    picks = picks_file(world.folder, **content)
    refused(run, world, [*words_of(line, world), "--picks", picks], 2, says)
