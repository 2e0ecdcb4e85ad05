"""Folders and files are whole or as they were, whatever happens meanwhile; what is not a result is left alone."""

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
from tests.folder_program import AGAIN, NEW, OLD, read
from tests.systems import needs_posix

from sightline.common import atomic
from sightline.common.atomic import MANIFEST, whole_folder, write_folder, write_whole
from sightline.errors import LinkError, UnusableInputError

PROGRAM = Path(__file__).with_name("folder_program.py")
OLD_TEXT, NEW_TEXT, AGAIN_TEXT = ({name: data.decode() for name, data in one.items()} for one in (OLD, NEW, AGAIN))


@needs_posix
@pytest.mark.parametrize("kind", ["missing", "its own"])
def test_killed_at_any_step_the_old_or_the_new_folder_is_there_and_the_next_run_works(
    tmp_path: Path, kind: str
) -> None:
    command = [sys.executable, str(PROGRAM), str(tmp_path), kind]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)  # noqa: S603 - our own
    states = [json.loads(line) for line in done.stdout.splitlines()]
    before = [] if kind == "missing" else [OLD_TEXT]
    assert len(states) > 20
    assert states[0][0] == before
    assert states[-1][0] == [NEW_TEXT]
    for held, after, names in states:  # `out`, and `out.old` where it is there
        assert held in (before, [NEW_TEXT], [NEW_TEXT, OLD_TEXT])
        assert after == AGAIN_TEXT
        assert names == ["out"]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """Return a folder with an old result."""
    out = tmp_path / "place" / "out"
    write_folder(out, OLD)
    out.chmod(0o750)
    return out


def beside(out: Path) -> list[str]:
    return sorted(path.name for path in out.parent.iterdir())


def test_a_new_result_takes_the_place_of_the_old_one(out: Path) -> None:
    (out / ".DS_Store").write_bytes(b"where the windows are")
    assert write_folder(out, NEW) == [out / name for name in NEW]
    assert read(out) == NEW_TEXT
    assert not (out / "old").exists()
    assert stat.S_IMODE(out.stat().st_mode) == 0o750
    assert beside(out) == ["out"]
    assert set(json.loads((out / MANIFEST).read_bytes())["files"]) == set(NEW)


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    write_folder(tmp_path, NEW)
    assert read(tmp_path) == NEW_TEXT


@pytest.mark.parametrize("stranger", ["mine.txt", "old/mine.txt", "empty", "link"])
def test_a_folder_with_other_files_is_refused_and_nothing_is_touched(out: Path, stranger: str) -> None:
    if stranger == "empty":
        (out / stranger).mkdir()
    elif stranger == "link":
        (out / stranger).symlink_to(out.parent)
    else:
        (out / stranger).write_text("mine")
    before = read(out)
    ran = False
    with pytest.raises(UnusableInputError, match="out holds files that no earlier result wrote"), whole_folder(out):
        ran = True
    assert not ran
    assert read(out) == before
    assert beside(out) == ["out"]


@pytest.mark.parametrize("text", ["", "[]", '{"files": 3}', "{}"])
def test_a_damaged_manifest_makes_no_folder_ours(out: Path, text: str) -> None:
    (out / MANIFEST).write_text(text)
    with pytest.raises(UnusableInputError, match="no earlier result wrote"):
        write_folder(out, NEW)
    assert read(out) == OLD_TEXT


def test_a_file_that_comes_while_the_result_is_made_is_not_lost(out: Path) -> None:
    with pytest.raises(UnusableInputError, match="no earlier result wrote"), whole_folder(out):
        (out / "mine.txt").write_text("mine")
    assert read(out) == {**OLD_TEXT, "mine.txt": "mine"}


def test_the_working_directory_and_what_holds_it_are_refused(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(out / "old")
    for place in (Path(), Path(".."), out):
        with pytest.raises(UnusableInputError, match="working directory"):
            write_folder(place, NEW)
    assert read(out) == OLD_TEXT


def test_a_folder_of_the_old_results_name_is_not_removed(out: Path) -> None:
    (out.parent / "out.old").mkdir()
    (out.parent / "out.old" / "mine.txt").write_text("mine")
    with pytest.raises(UnusableInputError, match=r"out\.old is in the way"):
        write_folder(out, NEW)
    assert read(out.parent / "out.old") == {"mine.txt": "mine"}


def test_a_result_that_cannot_be_put_in_place_leaves_the_old_one(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = Path.rename

    def fails(path: Path, place: Path) -> Path:
        if path.parent.name.startswith(".out-"):
            raise OSError(5, "Input/output error")
        return rename(path, place)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(UnusableInputError, match="Input/output error"):
        write_folder(out, NEW)
    assert read(out) == OLD_TEXT
    assert beside(out) == ["out"]


@needs_posix
def test_a_disk_that_fails_to_sync_is_a_refusal_and_leaves_the_old_result(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with pytest.raises(UnusableInputError, match="folder out: Input/output error"), whole_folder(out) as new:
        (new / "a.txt").write_bytes(b"new")
        # Folders are synced in any case; a file's error must not be lost.
        monkeypatch.setattr(atomic, "sync_folder", lambda _: None)
        monkeypatch.setattr(os, "fsync", fail)
    assert read(out) == OLD_TEXT
    assert beside(out) == ["out"]


def test_a_folder_that_is_a_unit_belongs_to_the_result_with_what_came_into_it_later(tmp_path: Path) -> None:
    for seed in (1, 2):
        with whole_folder(tmp_path / "out", units=("case",)) as scratch:
            (scratch / "case").mkdir()
            write_whole(scratch / "case" / f"{seed}.dcm", b"image")
        assert list(read(tmp_path / "out")) == [f"case/{seed}.dcm"]
        (tmp_path / "out" / "case" / "later.dcm").write_bytes(b"image")


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
@needs_posix
@pytest.mark.parametrize("sign", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_second_signal_while_a_half_written_result_is_removed_leaves_nothing(tmp_path: Path, sign: str) -> None:
    script = f"""
import os, shutil, signal, sys
from sightline import cli
from sightline.common.atomic import whole_folder
end, remove = (lambda: os.kill(os.getpid(), signal.{sign})), shutil.rmtree
def interrupted(*given, **options):
    shutil.rmtree = remove
    end()
    remove(*given, **options)
def command():
    with whole_folder(sys.argv[1]) as scratch:
        (scratch / "a").touch()
        shutil.rmtree = interrupted
        end()
cli.commands = command
cli.main()
"""
    program = [sys.executable, "-c", script, str(tmp_path / "out")]
    ran = subprocess.run(program, check=False, capture_output=True, text=True)  # noqa: S603
    assert ran.returncode != 0
    assert ("Terminated" in ran.stderr) == (sign != "SIGINT")
    assert list(tmp_path.iterdir()) == []


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
