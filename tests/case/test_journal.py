"""The journal: what is recorded is there, in order, whole; what may not be recorded is refused and leaves no trace."""

import json
import sqlite3
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from sightline.case.canonical import canonical, digest
from sightline.case.journal import Actor, Case, Entry, Kind
from sightline.case.journal import case as journal
from sightline.errors import CaseError

IMAGE = b"\x00\x01 pixels and a name that stays here"


@pytest.fixture
def case(tmp_path: Path):
    with Case.create(tmp_path / "case") as one:
        yield one


def note(case: Case, value: object = 1, **more) -> Entry:
    return case.record(Kind.CHANGED, {"value": value}, by=Actor.SURGEON, **more)


def reopened(case: Case) -> Case:
    case.close()
    return Case.open(case.folder)


def test_what_is_recorded_comes_back_after_reopening(case: Case) -> None:
    name = case.keep(IMAGE, ".dcm")
    first = case.record(Kind.ACQUIRED, {"original": name}, by=Actor.RECEIVER)
    sd = np.array([0.1, 1 / 3, 5e-324, -0.0])
    second = case.record(
        Kind.DETECTED, {"sd_px": sd, "kind": ("ball",)}, by=Actor.APP, rests_on=[1], settings={"degree": 3}
    )
    number = case.number
    with reopened(case) as again:
        assert again.number == number
        assert again.problems == ()
        assert len(again.checks) == 3
        one, two = again.entries()
        assert (one.number, one.kind, one.by) == (1, Kind.ACQUIRED, Actor.RECEIVER)
        assert (two.rests_on, two.settings) == ((1,), {"degree": 3})
        assert np.array(two.content["sd_px"]).tobytes() == sd.tobytes()
        assert (one.chain, two.chain) == (first.chain, second.chain)
        assert {"sightline", "python", "numpy", "machine"} <= two.versions.keys()
        assert abs((datetime.now(UTC) - two.at).total_seconds()) < 3600
        assert again.original(name).read_bytes() == IMAGE
        assert again.entry(2).content == two.content


def test_entries_are_found_by_kind_number_and_content(case: Case) -> None:
    for view in ("pa", "lateral", "pa"):
        case.record(Kind.CALIBRATED, {"view": view}, by=Actor.APP)
        note(case)
    assert [one.number for one in case.entries(Kind.CALIBRATED)] == [1, 3, 5]
    assert [one.number for one in case.entries(after=4)] == [5, 6]
    found = case.latest(Kind.CALIBRATED, where={"view": "lateral"})
    assert found is not None
    assert found.number == 3
    assert case.latest(Kind.CALIBRATED, where={"view": "oblique"}) is None
    assert case.last == 6
    with pytest.raises(CaseError, match="no entry 7; it has 1 to 6"):
        case.entry(7)


def test_a_clock_that_is_set_back_changes_no_order(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock(datetime):
        year_now = 2031

        @classmethod
        def now(cls, tz=None):
            return datetime(cls.year_now, 1, 1, tzinfo=tz)

    monkeypatch.setattr(journal, "datetime", Clock)
    note(case)
    Clock.year_now = 2029
    note(case)
    with reopened(case) as again:
        assert [(one.number, one.at.year) for one in again.entries()] == [(1, 2031), (2, 2029)]
        assert again.problems == ()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"gap": float("nan")}, "None for unknown values"),
        ({"gap": np.array([1.0, np.inf])}, "None for unknown values"),
        ({"names": {"a", "b"}}, "holds JSON"),
        ({"file": Path("pa")}, "holds JSON"),
        ({"source": "MILLER_ANNA.DCM"}, "name of a file"),
        ({"deep": [{"source": "scan 3.png"}]}, "name of a file"),
        ({"original": "0" * 64 + ".dcm"}, "no such original"),
    ],
)
def test_what_no_case_may_hold_is_refused_and_leaves_no_trace(case: Case, content, words: str) -> None:
    with pytest.raises(CaseError, match=words):
        case.record(Kind.CHANGED, content, by=Actor.APP)
    assert case.last == 0


def test_a_person_cannot_be_named_as_the_one_who_did_it(case: Case) -> None:
    with pytest.raises(CaseError, match=r"not one of surgeon, .* no person's name"):
        case.record(Kind.CHANGED, {}, by="dr miller")  # type: ignore[arg-type]
    with pytest.raises(CaseError, match="not one of acquired"):
        case.record("guessed", {}, by=Actor.APP)  # type: ignore[arg-type]
    assert case.last == 0


@pytest.mark.parametrize("rests_on", [[0], [2], [-1], ["1"], [1.0]])
def test_an_entry_rests_on_earlier_entries_alone(case: Case, rests_on) -> None:
    note(case)
    with pytest.raises(CaseError, match="must rest on earlier entries, 1 to 1"):
        note(case, rests_on=rests_on)
    assert case.last == 1


def test_two_programs_append_in_turn_and_one_is_told_of_the_other(case: Case) -> None:
    with Case.open(case.folder) as other:
        note(case, expect=0)
        with pytest.raises(CaseError, match="entry 1 was recorded meanwhile, but the last one expected is 0"):
            note(other, expect=0)
        note(other, expect=1)
        assert [one.number for one in case.entries()] == [1, 2]
        assert case.check() == other.check()
        assert all(check.passed for check in case.check())


def test_threads_lose_nothing(case: Case) -> None:
    def write(name: int) -> None:
        for k in range(25):
            note(case, [name, k])

    threads = [threading.Thread(target=write, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    written = [tuple(one.content["value"]) for one in case.entries()]
    assert sorted(written) == [(name, k) for name in range(4) for k in range(25)]
    assert all(check.passed for check in case.check())


def test_an_original_is_read_only_kept_once_and_named_after_its_bytes(case: Case) -> None:
    names = {case.keep(IMAGE, ".dcm") for _ in range(2)}
    assert names == {digest(IMAGE) + ".dcm"}
    file = case.original(names.pop())
    assert [one.name for one in file.parent.iterdir()] == [file.name]
    assert file.stat().st_mode & 0o222 == 0
    for suffix in (".exe", "dcm", "", ".miller"):
        with pytest.raises(CaseError, match="cannot keep a file"):
            case.keep(IMAGE, suffix)
    for name in ("0" * 64 + ".dcm", "../journal.sqlite", ""):
        with pytest.raises(CaseError, match="no such original"):
            case.original(name)


def test_a_second_case_in_the_folder_is_refused(case: Case) -> None:
    note(case)
    with pytest.raises(CaseError, match="a case in this folder already"):
        Case.create(case.folder)
    assert case.last == 1


def test_a_folder_without_a_case_is_said(tmp_path: Path) -> None:
    for read_only in (True, False):
        with pytest.raises(CaseError, match="no case in"):
            Case.open(tmp_path, read_only)
        assert list(tmp_path.iterdir()) == []
    (tmp_path / "journal.sqlite").touch()  # what is left where creating a case was cut off
    assert not Case.exists(tmp_path)
    with pytest.raises(CaseError, match="no case in this folder"):
        Case.open(tmp_path)
    with Case.create(tmp_path, exist_ok=True) as case:
        note(case)
    with Case.create(tmp_path, exist_ok=True) as case:
        assert case.last == 1


def test_programs_that_create_a_case_at_once_share_one(tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as pool:
        cases = list(pool.map(lambda _: Case.create(tmp_path, exist_ok=True), range(3)))
    for case in cases:
        note(case)
        case.close()
    assert len({case.number for case in cases}) == 1
    with Case.open(tmp_path) as case:
        assert case.last == 3


def test_reading_changes_nothing(case: Case) -> None:
    note(case)
    case.close()
    file = case.folder / "journal.sqlite"
    before = file.read_bytes()
    with Case.open(case.folder, read_only=True) as reader:
        assert reader.last == 1
        with pytest.raises(CaseError, match="cannot be written"):
            note(reader)
    assert file.read_bytes() == before


def edited(case: Case, statement: str) -> Case:
    """The case after somebody wrote into its file by hand."""
    case.close()
    with sqlite3.connect(case.folder / "journal.sqlite") as db:
        for trigger in ("never_changed", "never_removed"):
            db.execute(f"DROP TRIGGER {trigger}")
        db.execute(statement)
    db.close()
    return Case.open(case.folder)


@pytest.mark.parametrize(
    ("statement", "first", "count"),
    [
        ("""UPDATE entries SET content = '{"value":2}' WHERE number = 2""", 2, 1),
        ("UPDATE entries SET at = '2020-01-01T00:00:00.000000+00:00' WHERE number = 1", 1, 1),
        ("UPDATE entries SET by = 'robot' WHERE number = 3", 3, 1),
        ("UPDATE entries SET rests_on = '[1]' WHERE number = 4", 4, 1),
        ("UPDATE entries SET settings = '{}', versions = '{}' WHERE number = 4", 4, 1),
        ("DELETE FROM entries WHERE number = 2", 3, 1),
        ("UPDATE about SET number = 'C-0000-0000-0000'", 1, 1),
        ("UPDATE entries SET kind = 'guessed' WHERE number = 3", 3, 1),
    ],
)
def test_an_edited_entry_is_noticed(case: Case, statement: str, first: int, count: int) -> None:
    for k in range(4):
        note(case, k)
    with edited(case, statement) as again:
        (problem,) = again.problems
        assert problem.name == "case chain"
        assert problem.figure == count
        assert problem.sentence.startswith(f"Entry {first} ")


def test_the_file_refuses_edits_by_accident(case: Case) -> None:
    note(case)
    case.close()
    db = sqlite3.connect(case.folder / "journal.sqlite")
    for statement in ("UPDATE entries SET by = 'robot'", "DELETE FROM entries"):
        with pytest.raises(sqlite3.IntegrityError, match="entries are never"):
            db.execute(statement)
    db.close()


@pytest.mark.parametrize("spoil", [Path.unlink, lambda file: (file.chmod(0o600), file.write_bytes(IMAGE[:-1]))])
def test_a_missing_or_spoilt_original_is_noticed_and_can_be_put_back(case: Case, spoil) -> None:
    name = case.keep(IMAGE, ".png")
    case.record(Kind.ACQUIRED, {"original": name}, by=Actor.APP)
    spoil(case.original(name))
    with reopened(case) as again:
        (problem,) = again.problems
        assert (problem.name, problem.figure) == ("case originals", 1)
        assert name in problem.sentence
        again.keep(IMAGE, ".png")
        assert all(check.passed for check in again.check())


def test_a_damaged_page_is_noticed(case: Case) -> None:
    for k in range(50):
        note(case, "x" * 500 + str(k))
    case.close()
    file = case.folder / "journal.sqlite"
    data = bytearray(file.read_bytes())
    at = data.rindex(b"x" * 400)
    data[at : at + 100] = b"y" * 100
    file.write_bytes(data)
    with Case.open(case.folder) as again:
        assert [problem.name for problem in again.problems] == ["case chain"]


@pytest.mark.parametrize("keep_bytes", [0, 100, 3000])
def test_a_truncated_file_is_refused_in_words(case: Case, keep_bytes: int) -> None:
    for k in range(50):
        note(case, k)
    case.close()
    file = case.folder / "journal.sqlite"
    file.write_bytes(file.read_bytes()[:keep_bytes])
    with pytest.raises(CaseError, match=r"damaged|no case"):
        Case.open(case.folder)


def test_equal_values_have_equal_text() -> None:
    value = {"b": np.float64(0.1), "a": (1, None, True), "ü": np.arange(2)}
    assert canonical(value) == '{"a":[1,null,true],"b":0.1,"ü":[0,1]}'
    assert json.loads(canonical(value)) == {"a": [1, None, True], "b": 0.1, "ü": [0, 1]}
