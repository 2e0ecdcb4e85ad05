"""The page of benchmarks shows the recorded values, and a run replaces its own entries only."""

import re
from pathlib import Path

import pytest
from benchmarks import results
from benchmarks.harness import Row

from sightline.planning.procedures.procedure import shipped

DOCS = Path(__file__).parents[1] / "docs"


def test_the_page_is_what_the_command_writes() -> None:
    assert results.PAGE.read_text() == results.page()


def test_a_run_replaces_its_own_entries_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "results.json"
    monkeypatch.setattr(results, "RESULTS", file)
    old = {"commit": None, "processor": None, "cores": None, "date": None, "seed": None}
    results.write([results.entry(name, Row("g", "n", "1.5", "mm"), old) for name in ("accuracy", "plates")])
    results.update("plates", [Row("g", "new", "0.2 / 0.3", "mm", "<= 1 mm", "peer 2 mm", met=True)], 7)
    kept, made = results.read()
    assert (kept["benchmark"], kept["value"], kept["unit"]) == ("accuracy", "1.5", "mm")
    assert (made["name"], made["value"], made["unit"], made["met"]) == ("new", "0.2 / 0.3", "mm", True)
    assert made["commit"] and made["processor"] and made["cores"] and made["date"] and made["seed"] == 7


def test_a_procedure_s_page_states_its_recorded_values() -> None:
    """Fails where the benchmark was run again and the page keeps an older value."""
    recorded = [each for each in results.read() if each["benchmark"] == "procedures"]
    for key in shipped():
        own = [each for each in recorded if re.match(rf"{key}[,:]", each["name"])]
        errors, within, go, *_ = (each["value"] for each in own)
        page = (DOCS / "procedures" / f"{key}.md").read_text()
        cells = [re.sub(r" ?(mm|°)$", "", value) for value in errors.split("; ")] + [within, go]
        for cell in cells:
            assert f"| {cell}" in page, (key, cell)
