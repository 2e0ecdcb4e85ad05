"""Procedures as files: the shipped ones, a user's own, and what is refused in a sentence."""

import json
import re
from math import atan2, radians
from pathlib import Path
from typing import Any

import pytest

from sightline.common.checks import Limits
from sightline.errors import UnusableInputError
from sightline.planning import PROCEDURES, Aids, ProposalRule, kind, locate, procedures
from sightline.planning.bone.metrics import metric
from sightline.planning.procedures.document import CHECKS, LOCATED, ProcedureDocument, open_ends
from sightline.planning.procedures.procedure import FOLDER, copy_text, document_from_json, keeping, kept, shipped
from sightline.planning.verdict.bone_checks import MEASURES

from .standin import stand_in


def _changed(path: tuple[Any, ...], value: Any, like: str = "hip-screw") -> str:
    """The text of a file like another one, with one value in it changed, or removed for None."""
    given = json.loads(copy_text(like, "mine"))
    at = given
    for step in path[:-1]:
        at = at[step]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return json.dumps(given)


def test_shipped_files_are_complete():
    assert next(iter(shipped())) == "hip-screw" and {"distal-interlocking", "free-wire"} <= set(shipped())
    for key, document in shipped().items():
        assert document.key == key
        assert document.limits.position_mm.limit <= 3.0
        sources = [document.limits.position_mm, document.limits.direction_deg, document.limits.beyond_mm]
        sources += [*document.views, *document.relations, *document.checks]
        sources += [one for one in (document.corridor, document.catalogue, document.proposal) if one is not None]
        assert all(len(one.source.strip()) >= 6 for one in sources)
    for key, one in PROCEDURES.items():
        assert one.key == key and kind(key) is one
        assert [each.key for each in one.points] == ["entry", "end"]
        assert all(each.name and each.sentence for each in (*one.points, *one.landmarks, *one.aids))


def test_the_three_earlier_kinds_have_the_limits_that_they_had():
    hip, holes, free = (kind(key) for key in ("hip-screw", "distal-interlocking", "free-wire"))
    assert hip.limits == free.limits == Limits()
    assert holes.limits == Limits(0.5, atan2(1.0, 11.0), 15.0, 30.0)  # to the last bit
    assert hip.proposal == ProposalRule(wire="guide-wire") and free.proposal is None
    assert (hip.wire_mm, holes.wire_mm, free.wire_mm) == (2.5, 4.0, 2.5)
    assert hip.ends_before_joint and not free.checks
    assert kind("interlocking") is holes


def test_what_files_may_name_is_what_the_program_evaluates():
    nothing = locate([stand_in("pa", 0.0, 0.1), stand_in("lateral", 0.0, 0.1)], Aids())
    assert set(MEASURES) <= set(CHECKS)
    assert all(metric(nothing, name, "right").name == name for name in set(CHECKS) - set(MEASURES))
    assert {*LOCATED, "others"} == set(Aids.__dataclass_fields__)


CAUDAL = {"from": ["head"], "to": ["shaft"], "orbit_deg": 0, "tilt_deg": -90, "sd_deg": 2, "source": "a test"}


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("colour",), "red", "colour is not a key of a procedure's file"),
        (("limits", "beyond_mm"), None, "limits.beyond_mm is missing; add it"),
        (("limits", "position_mm", "source"), None, "limits.position_mm.source is missing"),
        (("limits", "position_mm", "limit"), "1", "limits.position_mm.limit is not a number; write it without quotes"),
        (("limits", "position_mm", "limit"), 0, "position_mm must be above zero"),
        (("limits", "beyond_mm", "limit"), float("nan"), "NaN is not a number"),
        (("limits", "beyond_mm", "limit"), 1e4, "less than or equal to 1000"),
        (("limits", "before_mm"), {"limit": 1.0, "source": "mine"}, "before_mm must be above 2"),
        (("key",), "Mine Own", "key must be lower-case letters"),
        (("wires", 0, "diameter_mm"), -1, "greater than 0"),
        (("checks", 8, "check"), "wire colour", "names the check 'wire colour', which is not known; choose from"),
        (("checks", 8, "low"), None, "'wire length', which takes low and high; give 'low'"),
        (("checks", 0, "low"), 3, "'entry and end', which takes no numbers; remove 'low'"),
        (("checks", 8, "low"), 200, "give a lower limit below the upper one"),
        (("checks", 1, "check"), "entry and end", "'entry and end' occurs twice in the checks"),
        (("landmarks", 1, "key"), "head-centre", "'head-centre' occurs twice in the landmarks and aids"),
        (("landmarks",), [], "landmarks"),
        (("aids", 0, "clicks"), 2, "is a sphere drawn by 2 clicks; give 3 to 12"),
        (("aids", 0, "key"), "skull", "is the sphere 'skull'; the aids that are located are head (sphere)"),
        (("aids", 0, "views"), ["lateral"], "the aid 'head' is drawn in lateral; name views from the first on"),
        (("aids", 0, "type"), "blob", "aids[0].type"),
        (("checks", 8, "required"), False, "is not required; say in 'optional' why a plan may do without it"),
        (("relations",), [{"relation": "parallel", "wires": ["a", "b"], "high": 1, "source": "ours"}], "the wire 'a'"),
        (("relations",), [{"relation": "parallel", "wires": ["a", "b"], "source": "ours"}], "which takes high"),
        (("catalogue", "lengths_mm"), [60, 50], "lengths_mm must ascend"),
        (("aids",), [], "needs head: add it to aids or landmarks, or say in 'optional' why a plan may do without"),
        (("directions",), [CAUDAL], "two or three, at large angles"),
        (("directions",), [CAUDAL, {**CAUDAL, "tilt_deg": -70}], "two or three, at large angles"),
        (("directions",), [CAUDAL, {**CAUDAL, "to": ["knee"]}], "a direction names 'knee'; name 'entry'"),
        (("directions",), [CAUDAL, {**CAUDAL, "along": "head"}], "runs along 'head'; name a line"),
    ],
)
def test_what_is_wrong_in_a_file_is_said(path: tuple[Any, ...], value: Any, words: str):
    with pytest.raises(UnusableInputError) as said:
        document_from_json(_changed(path, value))
    assert words in str(said.value)


def test_a_repeated_key_and_a_torn_file_are_refused():
    text = copy_text("free-wire", "mine").decode()
    with pytest.raises(UnusableInputError, match="'name' occurs twice"):
        document_from_json(text.replace('"name":', '"name": "twice", "name":', 1))
    with pytest.raises(UnusableInputError, match="not JSON"):
        document_from_json(text[: len(text) // 2])


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of the user's."""
    monkeypatch.setenv(FOLDER, str(tmp_path))
    return tmp_path


def test_a_folder_of_the_users_is_read_and_shipped_keys_take_precedence(own: Path):
    (own / "my-hip.json").write_bytes(copy_text("hip-screw", "my-hip"))
    (own / "hip-screw.json").write_text("{}")
    (own / "torn.json").write_text("{")
    (own / "other.json").write_bytes(copy_text("hip-screw", "my-hip"))
    assert kind("hip-screw") is PROCEDURES["hip-screw"]
    assert set(procedures()) - set(PROCEDURES) == {"my-hip"}
    assert kind("my-hip").limits == Limits() and kind("my-hip").key == "my-hip"
    with pytest.raises(UnusableInputError, match=r"name the file my-hip\.json"):
        kind("other")
    with pytest.raises(UnusableInputError, match=r"choose one of hip-screw, .*my-hip"):
        kind("tibial")


def test_a_missing_folder_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv(FOLDER, str(tmp_path / "gone"))
    with pytest.raises(UnusableInputError, match="not a folder"):
        procedures()


def test_a_shipped_key_with_other_content_is_refused(tmp_path: Path):
    file = tmp_path / "file.json"
    file.write_bytes(copy_text("hip-screw", "mine").replace(b'"mine"', b'"hip-screw"'))
    assert kind(str(file)).key == "hip-screw"
    file.write_bytes(file.read_bytes().replace(b'"limit": 0.6', b'"limit": 0.8'))
    with pytest.raises(UnusableInputError, match="is that of a shipped procedure; give another"):
        kind(str(file))
    with pytest.raises(UnusableInputError, match="key of a shipped procedure"):
        copy_text("hip-screw", "free-wire")


def test_a_changed_file_has_another_fingerprint_and_layout_alone_does_not(tmp_path: Path):
    file = tmp_path / "mine.json"
    file.write_bytes(copy_text("hip-screw", "mine"))
    first = kind(str(file))
    assert first.fingerprint.startswith("mine#")
    file.write_text(json.dumps(json.loads(file.read_text()), indent=4))
    assert kind(str(file)).fingerprint == first.fingerprint
    file.write_text(_changed(("limits", "direction_deg", "limit"), 0.5))
    assert kind(str(file)).fingerprint != first.fingerprint
    assert kind(str(file)).limits.direction_rad == radians(0.5)
    assert len({one.fingerprint for one in PROCEDURES.values()}) == len(shipped())


def test_a_case_keeps_the_content_of_a_file_that_is_not_shipped(tmp_path: Path):
    file = tmp_path / "mine.json"
    file.write_text(_changed(("limits", "beyond_mm", "limit"), 3.5))
    known = kind(str(file))
    content = json.loads(json.dumps(keeping(known)))
    file.unlink()
    assert kept(known.key, content).fingerprint == known.fingerprint
    assert kept(known.key, content).limits.beyond_mm == 3.5
    assert keeping(kind("hip-screw")) is None and kept("interlocking", None) is kind("distal-interlocking")
    with pytest.raises(UnusableInputError, match="cannot be read: colour is not a key"):
        kept("mine", {**content, "colour": "red"})


def _of_two(tmp_path: Path) -> Path:
    given = json.loads(copy_text("free-wire", "pair"))
    first = given["wires"][0]
    given["wires"] = [{**first, "key": key, "diameter_mm": mm} for key, mm in (("upper", 2.5), ("lower", 3.2))]
    given["relations"] = [{"relation": "parallel", "wires": ["upper", "lower"], "high": 1, "source": "a test"}]
    (tmp_path / "pair.json").write_text(json.dumps(given))
    return tmp_path / "pair.json"


def test_of_several_wires_one_is_planned_and_this_is_said(tmp_path: Path):
    file = _of_two(tmp_path)
    with pytest.raises(UnusableInputError, match=r"has 2 wires: name the wire .*pair:upper, pair:lower"):
        kind(str(file))
    with pytest.raises(UnusableInputError, match="no wire 'middle'"):
        kind(f"{file}:middle")
    lower = kind(f"{file}:lower")
    assert (lower.key, lower.wire_mm) == ("pair:lower", 3.2)
    assert kept(lower.key, keeping(lower)).wire_mm == 3.2
    (_, said) = lower.sentences()  # the first: that it has no checks
    assert "one wire of 2" in said and "parallel" in said
    assert kind("hip-screw").sentences() == []
    (said,) = kind("free-wire").sentences()
    assert "nothing tells whether its ends are exchanged" in said


def test_the_page_names_what_is_shipped_and_what_files_may_name():
    page = (Path(__file__).parents[2] / "docs" / "procedures.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", page, flags=re.DOTALL)))
    assert set(shipped()) | set(CHECKS) | set(LOCATED) | {FOLDER} <= named
    assert {one.alias or name for name, one in ProcedureDocument.model_fields.items()} <= named


def test_an_end_that_must_lie_in_bone_and_that_no_check_shows_is_said():
    assert all(open_ends(document) == [] for document in shipped().values())
    given = json.loads(copy_text("iliosacral-screw", "mine"))
    given["checks"] = [one for one in given["checks"] if one["check"] != "tip in sacral corridor"]
    assert open_ends(document_from_json(json.dumps(given))) == ["end"]
    given["corridor"]["may_leave_bone"] = ["end"]
    assert open_ends(document_from_json(json.dumps(given))) == ["entry"]
