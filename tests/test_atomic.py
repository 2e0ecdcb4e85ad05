"""Folders and files are whole or as they were, whatever happens meanwhile; what is not a file is left alone."""

import errno
import json
import os
import socket
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from tests.folder_program import NEW, OLD, read
from tests.systems import needs_posix

from sightline import atomic
from sightline.atomic import whole_folder, write_folder, write_whole
from sightline.errors import LinkError, UnusableInputError

PROGRAM = Path(__file__).with_name("folder_program.py")
OLD_TEXT, NEW_TEXT = ({name: data.decode() for name, data in one.items()} for one in (OLD, NEW))


def killed(place: Path, kind: str) -> list[dict[str, str]]:
    """What the folder held after a kill at the first, second, ... step."""
    command = [sys.executable, str(PROGRAM), str(place), kind]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)  # noqa: S603 - our own
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.skipif(sys.platform != "linux", reason="folders change places in one step on Linux alone")
@pytest.mark.parametrize("kind", ["missing", "its own"])
def test_killed_at_any_step_a_folder_is_whole_or_as_it_was(tmp_path: Path, kind: str) -> None:
    found = killed(tmp_path, kind)
    before = {} if kind == "missing" else OLD_TEXT
    assert all(one in (before, NEW_TEXT) for one in found)
    assert found[0] == before
    assert found[-1] == NEW_TEXT
    assert len(found) > 20


@needs_posix
def test_killed_at_any_step_other_files_stay_and_two_results_are_never_mixed(tmp_path: Path) -> None:
    found = killed(tmp_path, "shared")
    for one in found:
        assert one.pop("mine.txt") == "mine"
        assert one.items() <= OLD_TEXT.items() or one.items() <= NEW_TEXT.items()
    assert found[0] == OLD_TEXT
    assert found[-1] == NEW_TEXT


@pytest.fixture(params=["exchange", "each", "each, no exchange"])
def out(request, tmp_path: Path, monkeypatch) -> Path:
    """Return a folder with an old result, and another program's file where the parameter is "each"."""
    out = tmp_path / "place" / "out"
    write_folder(out, OLD)
    out.chmod(0o750)
    if request.param == "each":
        (out / "views" / "mine.txt").write_text("mine")
        (out / "empty").mkdir()
    elif "no exchange" in request.param:
        monkeypatch.setattr(atomic, "_exchange", lambda *_: False)
    return out


def test_a_new_result_takes_the_place_of_the_old_one(out: Path) -> None:
    others = {name: text for name, text in read(out).items() if "mine" in name}
    folders = sorted(path.name for path in out.iterdir() if path.is_dir())
    assert write_folder(out, NEW) == [out / name for name in NEW]
    assert read(out) == NEW_TEXT | others
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == folders
    assert stat.S_IMODE(out.stat().st_mode) == 0o750
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_a_result_that_cannot_be_put_in_place_leaves_the_old_one(out: Path, monkeypatch) -> None:
    """Something of another kind has the name of a file: it is neither replaced nor removed, and nothing else is."""
    (out / "zoo" / "animals").mkdir(parents=True)
    before = read(out)
    with pytest.raises(UnusableInputError, match="cannot write into out: there is a folder"):
        write_folder(out, {**NEW, "zoo": b"a file"})
    assert read(out) == before
    assert (out / "zoo" / "animals").is_dir()

    rename, moved = Path.rename, []

    def fails_once(path: Path, place: Path) -> Path:
        moved.append(place)
        if len(moved) == 5:  # with three old ones out: the second new one
            raise OSError(5, "Input/output error")
        return rename(path, place)

    monkeypatch.setattr(Path, "rename", fails_once)
    with pytest.raises(UnusableInputError, match="Input/output error"):
        write_folder(out, NEW)
    assert read(out) == before
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@needs_posix
def test_a_disk_that_fails_to_sync_is_a_refusal_and_leaves_the_old_result(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    before = read(out)
    with pytest.raises(UnusableInputError, match="cannot write into out: Input/output error"), whole_folder(out) as new:
        for name, data in NEW.items():
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            (new / name).write_bytes(data)
        # Folders are synced in any case; a file's error must not be lost.
        monkeypatch.setattr(atomic, "sync_folder", lambda _: None)
        monkeypatch.setattr(os, "fsync", fail)
    assert read(out) == before
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_old_files_that_cannot_be_put_back_are_kept_and_said_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in ("a.txt", "b.txt", "mine.txt"):
        (out / name).write_text(f"old {name}")
    rename = Path.rename

    def fails_from_the_new_ones_on(path: Path, place: Path) -> Path:
        if not failed and "before" not in place.parts:
            failed.append(path)
        if failed:
            raise OSError(5, "Input/output error")
        return rename(path, place)

    failed: list[Path] = []
    monkeypatch.setattr(Path, "rename", fails_from_the_new_ones_on)
    with pytest.raises(
        UnusableInputError,
        match=r"they are in \.out-\w+/before, next to out: move them back into out; name another place",
    ):
        write_folder(out, {"a.txt": b"new", "b.txt": b"new"})
    (scratch,) = tmp_path.glob(".out-*")
    assert {one.name: one.read_text() for one in (scratch / "before").iterdir()} == {
        "a.txt": "old a.txt",
        "b.txt": "old b.txt",
    }
    assert (out / "mine.txt").read_text() == "old mine.txt"


def test_a_folder_that_is_a_unit_is_replaced_as_a_whole(tmp_path: Path) -> None:
    for seed in (1, 2):
        with whole_folder(tmp_path / "out", units=("case",)) as scratch:
            (scratch / "case").mkdir()
            write_whole(scratch / "case" / f"{seed}.dcm", b"image")
        assert list(read(tmp_path / "out")) == [f"case/{seed}.dcm"]


def test_who_stands_in_the_folder_goes_on_standing_in_it(tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "out"
    write_folder(out, OLD)
    monkeypatch.chdir(out)
    write_folder(Path(), NEW)
    assert Path.cwd().samefile(out)
    assert read(Path()) == NEW_TEXT


def test_a_link_to_a_folder_stays_one(tmp_path: Path) -> None:
    write_folder(tmp_path / "real", OLD)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_folder(tmp_path / "link", NEW)
    assert (tmp_path / "link").is_symlink()
    assert read(tmp_path / "real") == NEW_TEXT


@pytest.mark.parametrize(
    "error", [ConnectionRefusedError(111, "Connection refused"), LinkError("no robot"), KeyError(1)]
)
def test_what_the_body_raises_is_passed_on_and_nothing_is_written(tmp_path: Path, error: Exception) -> None:
    with pytest.raises(type(error)) as raised, whole_folder(tmp_path / "out") as scratch:
        write_whole(scratch / "plan.json", b"{}")
        raise error
    assert raised.value is error
    assert list(tmp_path.iterdir()) == []


@needs_posix
def test_what_is_not_a_regular_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "socket"))
        (tmp_path / "link").symlink_to("/dev/full")
        for name in ("pipe", "folder", "socket", "link"):
            before = (tmp_path / name).lstat()
            with pytest.raises(UnusableInputError, match="a folder, a device or a pipe of this name"):
                write_whole(tmp_path / name, b"data")
            assert (tmp_path / name).lstat().st_ino == before.st_ino
    with pytest.raises(UnusableInputError, match="a device"):
        write_whole("/dev/full", b"data")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "link", "pipe", "socket"]


@needs_posix
@pytest.mark.parametrize("write", ["before", "after"])
def test_a_disk_that_becomes_read_only_is_a_refusal(write: str) -> None:
    """While the folder is written, its scratch folder cannot be removed either, which must not matter."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        child = os.fork()
        if child == 0:
            said = 1
            try:
                if os.geteuid() == 0:  # root may write anywhere
                    os.chown(place, 65534, 65534)
                    os.seteuid(65534)
                with whole_folder(place / "out") as scratch:
                    if write == "before":
                        write_whole(scratch / "a.txt", b"a")
                    for folder in (scratch, scratch.parent, place):
                        folder.chmod(0o555)
                    if write == "after":
                        write_whole(scratch / "a.txt", b"a")
            except UnusableInputError as error:
                said = 0 if "Permission denied" in str(error) else 2
            finally:
                os._exit(said)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        for folder in (place, *place.rglob("*")):
            folder.chmod(0o755)
        assert code == 0
        assert not (place / "out").exists()


def test_a_sub_folder_that_cannot_be_made_is_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Path.mkdir

    def mkdir(path: Path, *options: object, **named: object) -> None:
        if path.name == "views":
            raise OSError(28, "No space left on device")
        made(path, *options, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, "mkdir", mkdir)
    with pytest.raises(UnusableInputError, match="No space left on device; free some space"):
        write_folder(tmp_path / "out", {"views/pa.csv": b"1"})
    assert list(tmp_path.iterdir()) == []
