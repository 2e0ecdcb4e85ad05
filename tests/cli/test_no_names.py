"""Outside a case, too: files are often named after patients, and nothing that a command writes or prints says so."""

import re
import shutil
from base64 import b64decode
from hashlib import sha256
from pathlib import Path

import pytest

WIRE = ("--entry", "pa:512,512 lateral:512,512", "--end", "pa:470,470 lateral:540,500")
COMMANDS: dict[str, tuple[str, ...]] = {
    "calibrate": ("calibrate", "{pa}", "--csv", "{out}/beads.csv"),
    "undistort": ("undistort", "{pa}", "--out", "{out}", "--spacing", "1"),
    "plan": ("plan", "{csv}", "{csv}", *WIRE, "--out", "{out}"),
    "export views": ("export", "views", "{pa}", "--to", "opencv,rtk,xreg", "--out", "{out}"),
}


@pytest.fixture(scope="module")
def named(pair, beads_csv, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files as a person may have saved them."""
    folder = tmp_path_factory.mktemp("saved")
    found = {name: Path(shutil.copy(pair[name], folder / f"{name}.Miller^Anna")) for name in ("pa", "lateral")}
    return {**found, "csv": Path(shutil.copy(beads_csv, folder / "Miller_Anna.csv"))}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_name_of_a_file_leaves_a_command(run, named: dict[str, Path], tmp_path: Path, name: str) -> None:
    (tmp_path / "out").mkdir()
    ran = run(*(word.format(**named, out=tmp_path / "out") for word in COMMANDS[name]), "--json")
    assert ran.code in (0, 3), ran.out  # 3: these are no good picks
    nameless(ran.out + ran.err, tmp_path / "out")


def test_neither_do_a_report_with_images_and_the_files_made_of_it(run, named: dict[str, Path], tmp_path: Path) -> None:
    ran = run("plan", named["pa"], named["lateral"], *WIRE, "--out", tmp_path / "plan")
    nameless(ran.out + ran.err, tmp_path / "plan")
    page = (tmp_path / "plan" / "report.html").read_text()
    for view in ("pa", "lateral"):
        assert as_in_a_case(named[view], ".dcm") in page
    kinds = ("slicer,itk,dicom,csv", "--side", "left", "--case", "0042")
    ran = run("export", "plan", tmp_path / "plan", "--to", *kinds, "--out", tmp_path / "out")
    assert ran.code == 0, ran.err
    nameless(ran.out + ran.err, tmp_path / "out")


def test_a_view_names_its_file_as_a_case_would(run, named: dict[str, Path]) -> None:
    told = run("calibrate", named["csv"], "--view", "pa", "--json").document["source"]
    assert told == as_in_a_case(named["csv"], ".csv")


def as_in_a_case(file: Path, suffix: str) -> str:
    return sha256(file.read_bytes()).hexdigest()[:12] + suffix


def nameless(said: str, folder: Path) -> None:
    files = [file for file in folder.rglob("*") if file.is_file()]
    assert said
    assert files
    # Among the letters of an embedded picture any four come by chance; it is looked at unpacked.
    embedded = re.compile(rb"base64,([A-Za-z0-9+/=]+)")
    every = [said.encode(), *(file.read_bytes() for file in files)]
    pictures = [b64decode(text) for data in every for text in embedded.findall(data)]
    for data in (*(embedded.sub(b"", data) for data in every), *pictures):
        assert b"MILLER" not in data.upper()
        assert b"ANNA" not in data.upper()
