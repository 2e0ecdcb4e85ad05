"""`sightline study`, from the command to its files."""

import json
from pathlib import Path

import pytest
from tests.studies.small_study import SmallStudy

from sightline.studies import catalogue


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(catalogue.STUDIES, "small", SmallStudy())


@pytest.mark.slow
def test_a_study_leaves_figures_a_page_and_its_trials(run, small, tmp_path: Path) -> None:
    ran = run("study", "small", "--trials", "12", "--seed", "3", "--out", tmp_path)
    assert ran.code == 0, ran.err
    assert "The median is" in ran.out
    assert "Values" in ran.out
    assert {file.name for file in tmp_path.iterdir()} == {"trials.jsonl", "report"}
    document = json.loads((tmp_path / "report" / "result.json").read_text())
    assert (document["study"], document["seed"], document["trials"]) == ("small", 3, 12)
    assert document["configuration"]["spread"] == 1.0
    figure = document["figures"][0]
    assert figure["low"] <= figure["value"] <= figure["high"]
    again = run("study", "small", "--trials", "12", "--seed", "3", "--out", tmp_path, "--json")
    assert again.code == 0
    assert again.err == ""
    assert again.document["figures"] == document["figures"]
    quiet = run("study", "small", "--trials", "12", "--seed", "3", "--out", tmp_path, "--quiet")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")
