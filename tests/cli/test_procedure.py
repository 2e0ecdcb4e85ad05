"""`sightline procedure`: a procedure written by somebody without Python, from a copy to a plan in a case."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.cli.picked import typed

from sightline.case.journal import Case, Kind
from sightline.case.replay.recompute import Recomputed
from sightline.planning import PROCEDURES
from sightline.planning.procedures.procedure import FOLDER, copy_text


@pytest.fixture
def wire(setup) -> list[str]:
    return typed(setup)


def test_shipped_procedures_are_listed_and_shown(run) -> None:
    listed = run("procedure", "list", "--json").document["procedures"]
    assert {one["key"] for one in listed} == {one.document.key for one in PROCEDURES.values()}
    shown = run("procedure", "show", "hip-screw", "--json").document
    assert shown["fingerprint"] == PROCEDURES["hip-screw"].fingerprint
    said = run("procedure", "show", "hip-screw").out
    for words in ("lateral cortex", "direction_deg", "0.6", "wire length", "50 to 145", "what the paper reached"):
        assert words in " ".join(said.split()), words


def test_a_procedure_of_ones_own_is_written_checked_planned_and_kept(run, beads_csv: Path, wire, tmp_path) -> None:
    """A person copies a procedure, edits a limit in a text editor, checks the file and plans with it."""
    mine, case = tmp_path / "my-wire.json", tmp_path / "case"
    assert run("procedure", "new", mine, "--like", "free-wire").code == 0
    again = run("procedure", "new", mine, "--like", "free-wire")
    assert (again.code, "my-wire.json exists" in again.err) == (2, True)
    unfound = run("procedure", "new", tmp_path / "my-wire", "--like", "free-wire")
    assert (unfound.code, "name it my-wire.json" in unfound.said) == (2, True)
    mine.write_text(mine.read_text().replace('"position_mm": {"limit": 1,', '"position_mm": {"limit": 0.001,'))
    checked = run("procedure", "check", mine, "--json")
    assert (checked.code, checked.document["key"]) == (0, "my-wire")

    plan = ["plan", beads_csv, beads_csv, *wire, "--procedure"]
    assert run(*plan, "free-wire", "--json").code == 0
    strict = run(*plan, mine, "--case", case, "--out", tmp_path / "out", "--json")
    assert strict.code == 3
    failed = {check["name"]: check["limit"] for check in strict.document["checks"] if not check["passed"]}
    assert failed == {"entry error": 0.001, "end error": 0.001}
    assert strict.document["procedure"] == {"name": "free wire", "fingerprint": checked.document["fingerprint"]}
    assert checked.document["fingerprint"] in (tmp_path / "out" / "report.html").read_text()

    mine.unlink()  # the case keeps the file's content
    outcomes = run("case", "replay", case, "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}
    gone = run(*plan, mine)
    assert (gone.code, "unknown procedure" in gone.err) == (2, True)


def test_files_of_the_users_folder_are_listed_with_what_is_wrong(run, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    (tmp_path / "my-hip.json").write_bytes(copy_text("hip-screw", "my-hip"))
    (tmp_path / "torn.json").write_text("{")
    found = run("procedure", "list", "--json").document
    assert [one["key"] for one in found["procedures"] if one["file"] != "shipped"] == ["my-hip"]
    assert "not JSON" in found["unusable"]["torn"]


def _old(content: dict[str, Any]) -> dict[str, Any]:
    """A planned entry as versions recorded it whose procedures were not files."""
    old = json.loads(json.dumps(content))
    del old["procedure"], old["implant"], old["asked"]["procedure"]
    old["kind"] = old["asked"]["kind"] = "interlocking"
    return old


@pytest.mark.parametrize("flag", ["--procedure", "--procedure"])
def test_interlocking_of_old_cases_and_flags_is_distal_interlocking(run, beads_csv, wire, tmp_path, flag) -> None:
    case = tmp_path / "case"
    given = ["plan", beads_csv, beads_csv, *wire, flag, "interlocking", "--case", case, "--json"]
    assert run(*given).document["kind"] == "distal-interlocking:distal"
    with Case.open(case, read_only=True) as opened:
        entry = opened.latest(Kind.PLANNED)
        assert entry is not None
        old = _old(entry.content)
        assert Recomputed(opened).content(replace(entry, content=old)) == old
