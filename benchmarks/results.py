"""The measured values of all benchmarks in results.json, and their table in docs/benchmarks.md.

Running a benchmark replaces its own entries only. An entry states where its value is from: commit, machine, date and
first seed; null where that was not recorded.
"""

import ast
import json
import os
import platform
import re
import subprocess
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

from benchmarks.harness import Row

HERE = Path(__file__).parent
RESULTS, PAGE = HERE / "results.json", HERE.parent / "docs" / "benchmarks.md"
BEGIN, END = "<!-- results: begin (made by `python -m benchmarks --page`) -->", "<!-- results: end -->"
Entry = dict[str, Any]
# Values of each group on the page, besides those that are not met: the others are in the file alone.
SHOWN = 1
_PROVENANCE = ("commit", "processor", "cores", "date", "seed")


def names() -> list[str]:
    """Return the names of all benchmarks."""
    return sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py"))


def read() -> list[Entry]:
    """Return all entries."""
    return json.loads(RESULTS.read_text())


def write(entries: Sequence[Entry]) -> None:
    """Write all entries, one a line."""
    lines = (json.dumps(entry, ensure_ascii=False) for entry in entries)
    RESULTS.write_text("[\n" + ",\n".join(lines) + "\n]\n")


def entry(benchmark: str, row: Row, provenance: Entry) -> Entry:
    """Return the entry of one row."""
    return {"benchmark": benchmark, **asdict(row), **provenance}


def update(benchmark: str, rows: Sequence[Row], seed: int | None) -> None:
    """Replace the entries of a benchmark."""
    kept = [each for each in read() if each["benchmark"] != benchmark]
    made = [entry(benchmark, row, _provenance(seed)) for row in rows]
    write(sorted([*kept, *made], key=lambda each: each["benchmark"]))


def _provenance(seed: int | None) -> Entry:
    command = ["git", "describe", "--always", "--dirty"]
    git = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.*)", cpuinfo.read_text()) if cpuinfo.exists() else None
    processor, date = model.group(1) if model else platform.processor(), datetime.now(UTC).date().isoformat()
    return dict(zip(_PROVENANCE, (git.stdout.strip() or None, processor, os.cpu_count(), date, seed), strict=True))


def table(entries: Sequence[Entry]) -> str:
    """Return the tables of the page: for each benchmark what it measures, its values, and where they are from."""
    machines = dict.fromkeys(f"{each['processor']}, {each['cores']} cores" for each in entries if each["commit"])
    parts = [f"Values with a commit are from: {'; '.join(machines)}. The others are older; some have other names now."]
    for name in names():
        own = [each for each in entries if each["benchmark"] == name and each["value"] != "not installed"]
        own = [each for each in own if each["asked"] or each["peer"]] or own
        groups = [list(group) for _, group in groupby(own, key=lambda each: each["group"])]
        shown = [each for group in groups for k, each in enumerate(group) if k < SHOWN or each["met"] is False]
        if shown:
            about = ast.get_docstring(ast.parse((HERE / f"bench_{name}.py").read_text())) or ""
            head = "| value | measured | asked | peer |\n|---|---|---|---|"
            rows = [_line(each, several=len(groups) > 1) for each in shown]
            source = _source(shown)
            about = " ".join(about.split("\n\n")[0].split()) + (f" {source}" if source else "")
            parts.append("\n".join([f"### {name}", about, "", head, *rows]))
    return "\n\n".join(parts)


def _line(each: Entry, *, several: bool) -> str:
    name = f"{each['group']}: {each['name']}" if several and each["group"] not in each["name"] else each["name"]
    value = f"{each['value']}{'' if each['unit'] == '°' else ' '}{each['unit']}".strip()
    asked = each["asked"] if each["met"] is not False else f"{each['asked']}: **not met**"
    return f"| {name} | {value} | {asked} | {each['peer']} |"


def _source(shown: Sequence[Entry]) -> str:
    """Return where the values of a benchmark are from, as far as it was recorded."""
    sources = dict.fromkeys(each["commit"] for each in shown if each["commit"])
    return f"Measured at {', '.join(sources)}." if sources else ""


def page() -> str:
    """Return the page with the tables of the recorded values."""
    text = PAGE.read_text()
    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    return f"{text[:start]}\n{table(read())}\n{text[end:]}"
