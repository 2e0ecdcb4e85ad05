"""Cases of other versions: older ones are migrated with a copy laid beside them, newer ones refused."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from sightline.case.journal import Actor, Case, Kind, database
from sightline.errors import CaseError

GOLDEN = Path(__file__).with_name("journal-schema-0.sql")
ORIGINAL = b"\t"
COPY = "journal-schema-0.sqlite"


@pytest.fixture
def old(tmp_path: Path) -> Iterator[Path]:
    """The folder of a case of schema 0."""
    db = sqlite3.connect(tmp_path / "journal.sqlite")
    db.executescript(GOLDEN.read_text("utf-8"))
    db.close()
    (tmp_path / "originals").mkdir()
    (tmp_path / "originals" / "2b4c342f5433ebe591a1da77e013d1b72475562d48578dca8b84bac6651c3cb9.png").write_bytes(
        ORIGINAL
    )
    yield tmp_path


def tables(file: Path) -> list[tuple[object, ...]]:
    db = sqlite3.connect(file)
    rows = db.execute("SELECT * FROM entries ORDER BY number").fetchall()
    db.close()
    return rows


def migrated(case: Case) -> None:
    """Everything that was in it is in it."""
    assert case.problems == ()
    assert case.number == "C-7F3K-9QTM-2XWD"
    first, second, third = case.entries()
    assert (first.kind, first.by, first.rests_on) == (Kind.ACQUIRED, Actor.RECEIVER, ())
    assert first.settings == {"frame_index": None}
    assert case.original(first.content["original"]).read_bytes() == ORIGINAL
    assert second.rests_on == (1,)
    assert second.content["focal_point_mm"] == [15.1, -10.25, -620.0000000000001]
    assert second.at < first.at
    assert second.versions == {"sightline": "0.0.9"}
    assert third.content == {"what": "Seite über Γ geändert"}


def test_an_old_case_is_migrated_on_opening_and_a_copy_stays(old: Path) -> None:
    before = tables(old / "journal.sqlite")
    with Case.open(old) as case:
        migrated(case)
        assert case.record(Kind.CHANGED, {}, by=Actor.SURGEON).number == 4
    assert tables(old / COPY) == before
    with Case.open(old) as case:
        assert case.problems == ()
        assert case.last == 4


def test_an_old_case_is_read_without_being_touched(old: Path) -> None:
    before = {file.name: file.read_bytes() for file in old.iterdir() if file.is_file()}
    with Case.open(old, read_only=True) as case:
        migrated(case)
        with pytest.raises(CaseError, match="cannot be written"):
            case.record(Kind.CHANGED, {}, by=Actor.SURGEON)
    assert {file.name: file.read_bytes() for file in old.iterdir() if file.is_file()} == before


def test_a_migration_that_is_cut_off_leaves_the_old_case(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = tables(old / "journal.sqlite")

    def cut_off(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(database, "insert", cut_off)
        with pytest.raises(CaseError, match="No space left"):
            Case.open(old)
    assert tables(old / "journal.sqlite") == before
    with Case.open(old) as case:
        migrated(case)


def test_a_case_of_a_newer_version_is_refused_and_not_touched(tmp_path: Path) -> None:
    Case.create(tmp_path).close()
    file = tmp_path / "journal.sqlite"
    db = sqlite3.connect(file)
    db.execute(f"PRAGMA user_version = {database.VERSION + 1}")
    db.close()
    before = file.read_bytes()
    for read_only in (True, False):
        with pytest.raises(
            CaseError, match=r"newer Sightline \(schema 2, this one reads up to 1\); open it with the newer one"
        ):
            Case.open(tmp_path, read_only)
    assert file.read_bytes() == before


def test_another_programs_database_is_no_case(tmp_path: Path) -> None:
    db = sqlite3.connect(tmp_path / "journal.sqlite")
    db.execute("CREATE TABLE notes (text TEXT)")
    db.close()
    before = (tmp_path / "journal.sqlite").read_bytes()
    for read_only in (True, False):
        with pytest.raises(CaseError, match="not the journal of a case"):
            Case.open(tmp_path, read_only)
    with pytest.raises(CaseError, match="already"):
        Case.create(tmp_path)
    assert (tmp_path / "journal.sqlite").read_bytes() == before
