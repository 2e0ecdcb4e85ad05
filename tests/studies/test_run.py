"""The runner: the same figures whoever does the trials and whatever interrupts them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tests.studies.small_study import SmallStudy
from tests.systems import needs_posix

from sightline.errors import RefusedError, UnusableInputError
from sightline.studies.runs import run as record_module
from sightline.studies.runs.page import render_study
from sightline.studies.runs.run import TRIALS, Result, StudyRun
from sightline.studies.runs.study import Study

SEED, N = 5, 12
EXPECTED = [float(np.random.default_rng([SEED, k]).standard_normal()) for k in range(N)]


def done(study: Study, folder: Path, trials: int = N, **options) -> Result:
    run = StudyRun.open(study, trials, SEED, folder)
    run.do(**options)
    return run.result()


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / TRIALS).read_text().splitlines()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The folder of a run that nothing stopped, by one worker."""
    folder = tmp_path_factory.mktemp("whole")
    done(SmallStudy(), folder, workers=1)
    return folder


def started(whole: Path, folder: Path, trials: int, torn: bytes = b"") -> Path:
    """The folder of a run that was stopped after `trials` trials."""
    kept = (whole / TRIALS).read_bytes().splitlines(keepends=True)[: trials + 1]
    (folder / TRIALS).write_bytes(b"".join(kept) + torn)
    return folder


def test_every_trial_has_its_own_generator(whole):
    head, *trials = lines(whole)
    assert head["seed"] == SEED
    assert head["configuration"]["spread"] == 1.0
    assert {t["trial"]: t["values"]["value"] for t in trials} == dict(enumerate(EXPECTED))
    assert done(SmallStudy(), whole).document()["figures"][0]["value"] == pytest.approx(np.median(EXPECTED))


@pytest.mark.slow
def test_a_stopped_run_goes_on_with_other_workers_to_the_same_result(whole, tmp_path):
    started(whole, tmp_path, 5, torn=b'{"trial": 7, "val')
    counted = []
    result = done(SmallStudy(), tmp_path, workers=2, advance=lambda: counted.append(1))
    assert result.document() == done(SmallStudy(), whole).document()
    assert len(counted) == N - 5
    assert sorted(line["trial"] for line in lines(tmp_path)[1:]) == list(range(N))


def test_of_more_trials_than_asked_the_first_are_summed_up(whole):
    assert done(SmallStudy(), whole, trials=5).document()["figures"][0]["value"] == pytest.approx(
        np.median(EXPECTED[:5])
    )


def test_trials_of_something_else_are_never_mixed_in(whole, tmp_path, monkeypatch):
    started(whole, tmp_path, 2)
    before = (tmp_path / TRIALS).read_bytes()
    with pytest.raises(UnusableInputError, match=r"another configuration: spread.*--out"):
        StudyRun.open(SmallStudy(spread=2.0), N, SEED, tmp_path)
    with pytest.raises(UnusableInputError, match="seed 5 there, 6 now"):
        StudyRun.open(SmallStudy(), N, 6, tmp_path)
    monkeypatch.setattr(record_module, "code_digest", lambda: "other")
    with pytest.raises(UnusableInputError, match=r"code .* there, 'other' now"):
        StudyRun.open(SmallStudy(), N, SEED, tmp_path)
    assert (tmp_path / TRIALS).read_bytes() == before


@pytest.mark.parametrize("text", ["no record\n", '{"study": "small"}\n{"no": "trial"}\n', "[]\n"])
def test_a_file_that_is_no_record_is_refused(tmp_path, text):
    (tmp_path / TRIALS).write_text(text)
    with pytest.raises(UnusableInputError):
        StudyRun.open(SmallStudy(), N, SEED, tmp_path)
    assert (tmp_path / TRIALS).read_text() == text


@pytest.mark.slow
def test_a_killed_worker_costs_no_trial(whole, tmp_path):
    deadly = SmallStudy(deadly=str(tmp_path), limit=1.0)
    assert 1 <= sum(value > deadly.limit for value in EXPECTED) < N
    counted = []
    result = done(deadly, tmp_path / "out", workers=2, advance=lambda: counted.append(1))
    assert result.summary == done(SmallStudy(), whole).summary
    assert len(counted) == N


@pytest.mark.slow
def test_a_trial_that_always_kills_its_worker_is_named(tmp_path):
    worst = float(np.sort(EXPECTED)[-2])
    deadly = SmallStudy(deadly=str(tmp_path), limit=worst, always=True)
    with pytest.raises(RefusedError, match=f"3 workers died of trial {np.argmax(EXPECTED)}:"):
        done(deadly, tmp_path / "out", workers=1)
    assert len(lines(tmp_path / "out")) == N  # the header and all but one


@pytest.mark.slow
def test_a_full_disk_keeps_what_was_finished(whole, tmp_path):
    resource = pytest.importorskip("resource", reason="no limits on the size of files here")
    started(whole, tmp_path, 4)
    kept = {line["trial"] for line in lines(tmp_path)[1:]}
    size = (tmp_path / TRIALS).stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 30, hard))  # in the middle of the next trial's line
    try:
        with pytest.raises(UnusableInputError, match="finished trials are kept: make room"):
            done(SmallStudy(), tmp_path, workers=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    run = StudyRun.open(SmallStudy(), N, SEED, tmp_path)
    assert run.missing == [k for k in range(N) if k not in kept]
    assert len(kept) == 4


def test_no_trials_are_refused(tmp_path):
    with pytest.raises(UnusableInputError, match="at least one"):
        StudyRun.open(SmallStudy(), 0, SEED, tmp_path)


def test_the_page_needs_no_other_file_and_escapes_words(whole):
    page = render_study("Numbers <from> nowhere", done(SmallStudy(), whole))
    assert "Numbers &lt;from&gt; nowhere" in page
    assert "&lt;mm&gt;" in page
    assert "--trials 12 --seed 5" in page
    for outside in ("http://", "https://", "src=", "@import"):
        assert outside not in page.replace("http://www.w3.org", "")


COMMAND = """
if __name__ == "__main__":  # workers import this file too
    from sightline.cli import main
    from sightline.studies import catalogue
    from sightline.studies.runs import run as record
    from tests.studies.small_study import SmallStudy

    catalogue.STUDIES["small"] = SmallStudy(seconds=0.05)
    record.code_digest = lambda: "the same"  # somebody may be at work on the source while this runs
    main()
"""


def finished_in(folder: Path) -> int:
    file = folder / TRIALS
    return len(file.read_bytes().splitlines()) - 1 if file.exists() else 0


@pytest.mark.slow
@needs_posix
def test_the_keyboard_stops_it_and_the_same_command_goes_on(tmp_path):
    script = tmp_path / "command.py"
    script.write_text(COMMAND)
    out = tmp_path / "out"
    command = [sys.executable, str(script), "study", "small", "--trials", "60", "--seed", str(SEED), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(  # noqa: S603 - our own command
        command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as running:
        while running.poll() is None and finished_in(out) < 3:
            time.sleep(0.02)
        assert running.poll() is None, running.communicate()
        os.killpg(running.pid, signal.SIGINT)
        said = running.communicate(timeout=60)[1]
    assert running.returncode == 130, said
    assert "run the same command to continue" in said
    assert "Traceback" not in said
    kept = len(lines(out)) - 1
    assert 3 <= kept < 60
    again = subprocess.run(  # noqa: S603 - our own command
        command, env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    assert f"{kept} trials were finished earlier; {60 - kept} remain" in again.stderr
    document = json.loads((out / "report" / "result.json").read_text())
    expected = np.median([np.random.default_rng([SEED, k]).standard_normal() for k in range(60)])
    assert document["figures"][0]["value"] == pytest.approx(expected)
    assert (out / "report" / "report.html").stat().st_size > 1000
