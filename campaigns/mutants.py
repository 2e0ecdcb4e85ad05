"""Mutation testing: random one-token changes, each with the tests run against it.

`python -m campaigns.mutants [--changes N] [--seed S] [--rooms ROOM ...]`. A change that no test detects is printed with
its line: it must be shown to be equivalent, or get a test. Finished changes are kept; the same command resumes a
stopped run. Every change is made in a copy of the checkout, which is deleted at the end.

Tests are those of the change's own room, and all files that name the changed module; files that name it run first, and
slow tests after all others.
"""

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest
from rich.console import Console

from campaigns.campaign import Finished

ROOT = Path(__file__).parents[1]
ROOMS = ("planning", "calibration", "frame", "robot", "case", "detection")  # those whose tests are the quickest first
# Operators: their token, and the one instead.
SWAPPED = {
    ast.Add: "+-", ast.Sub: "-+", ast.Mult: "*/", ast.Div: "/*", ast.Lt: "<>", ast.LtE: ("<=", ">="), ast.Gt: "><",
    ast.GtE: (">=", "<="), ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip
LIMIT_S = 1800  # a change that makes the tests run this long is detected: something waits forever
PROCESSES = 2


@dataclass(frozen=True)
class Change:
    """One token of a file, at byte offsets of its UTF-8 text, and its replacement."""

    file: str
    line: int
    start: int
    token: str
    instead: str

    @property
    def key(self) -> str:
        """Its name in the record."""
        return f"{self.file}:{self.line}: {self.token} -> {self.instead} @{self.start}"

    @property
    def room(self) -> str:
        """The room whose source is changed."""
        return Path(self.file).parts[2]

    def applied(self, text: bytes) -> bytes:
        """Return the file's text with the change."""
        end = self.start + len(self.token.encode())
        assert text[self.start : end] == self.token.encode()
        return text[: self.start] + self.instead.encode() + text[end:]


def changes_of(file: Path) -> Iterator[Change]:
    """Yield all changes of a file: numbers, operators, comparisons, Booleans, indices 0 and 1.

    Not in docstrings, nor of zip's `strict`, which has no effect for equal lengths.
    """
    text = file.read_bytes()
    tree = ast.parse(text)
    starts = np.cumsum([0, *(len(line) for line in text.splitlines(keepends=True))])
    name = str(file.relative_to(ROOT))

    def span(node: ast.expr) -> tuple[int, int]:
        begin, end = (node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0)
        return int(starts[begin[0] - 1]) + begin[1], int(starts[end[0] - 1]) + end[1]

    def between(left: ast.expr, right: ast.expr, operator: ast.AST) -> Iterator[Change]:
        token, instead = SWAPPED.get(type(operator), ("", ""))
        place = text.find(token.encode(), span(left)[1], span(right)[0])
        if token and place >= 0:
            yield Change(name, left.end_lineno or 0, place, token, instead)

    guards = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "strict"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and type(node.value) in (int, float, bool) and id(node) not in guards:
            begin, end = span(node)
            yield Change(name, node.lineno, begin, text[begin:end].decode(), _other(node.value))
        elif isinstance(node, ast.BinOp):
            yield from between(node.left, node.right, node.op)
        elif isinstance(node, ast.BoolOp):
            yield from between(node.values[0], node.values[1], node.op)
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from between(node.left, node.comparators[0], node.ops[0])


def _other(value: float | bool) -> str:
    if isinstance(value, bool):
        return str(not value)
    if value in (0, 1) and isinstance(value, int):
        return str(1 - value)
    return repr(value + 1 if isinstance(value, int) else 1.5 * value if value else 0.5)


def drawn(number: int, seed: int, rooms: list[str]) -> list[Change]:
    """Return the first of a random permutation of all changes, so that more can be added later."""
    files = sorted(file for room in rooms for file in (ROOT / "src/sightline" / room).rglob("*.py"))
    every = [change for file in files for change in changes_of(file)]
    return [every[k] for k in np.random.default_rng(seed).permutation(len(every))[:number]]


def copy_of_checkout(tree: Path) -> Path:
    """Copy the files that git tracks to a folder; return it."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True).stdout  # noqa: S607
    for name in filter(None, listed.decode().split("\0")):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name)
    return tree


def tests_of(change: Change) -> list[str]:
    """Return the test files that name the changed module, then the others of its room."""
    *package, name = Path(change.file).with_suffix("").parts[1:]
    dotted, room = ".".join(package), ROOT / "tests" / change.room
    names = f"{dotted}.{name}", f"from {dotted} import {name}"
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    named = [file for file in files if any(each in file.read_text() for each in names)]
    return [str(f.relative_to(ROOT)) for f in [*named, *(f for f in files if room in f.parents and f not in named)]]


def noticed(change: Change, tree: Path) -> str:
    """Return the first test that fails with the change, or ""."""
    file, kernels = tree / change.file, tree.with_name(f"{tree.name}-kernels")
    before = file.read_bytes()
    with tempfile.TemporaryDirectory() as own:
        if change.room == "detection" or b"njit" in before:
            kernels = Path(own)  # compiled kernels contain functions and constants of other files
        try:
            file.write_bytes(change.applied(before))
            tests, flaky = tests_of(change), []
            for speed in ("not slow", "slow"):
                chosen = ["-m", speed, *tests]
                while "::" in (test := _failed([*chosen, *flaky], tree, kernels)):
                    if _failed(["-m", speed, test], tree, kernels):
                        break
                    flaky.append(f"--deselect={test}")  # it fails on a busy machine, not by the change
                if test:
                    return test
            return ""
        finally:
            file.write_bytes(before)


def _failed(tests: list[str], tree: Path, kernels: Path) -> str:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", *tests]
    changed = {"PYTHONPATH": str(tree / "src"), "NUMBA_CACHE_DIR": str(kernels), "OPENBLAS_NUM_THREADS": "1"}
    try:
        run = subprocess.run(
            command, check=False, cwd=tree, env=os.environ | changed, capture_output=True, text=True, timeout=LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return "the tests do not end"
    if run.returncode == pytest.ExitCode.OK:
        return ""
    if run.returncode == pytest.ExitCode.NO_TESTS_COLLECTED and "deselected" in run.stdout:
        return ""
    if run.returncode in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise SystemExit(run.stderr or run.stdout)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+::.+?)(?: - |$)", run.stdout, re.MULTILINE)
    return failed[1] if failed else f"exit code {run.returncode}"


def main() -> int:
    """Print the share of changes that a test detected, and the others; return 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--changes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rooms", nargs="+", default=list(ROOMS), metavar="ROOM", help=f"default: {' '.join(ROOMS)}")
    parser.add_argument("--out", type=Path, default=Path("out/mutants"))
    options = parser.parse_args()
    record = Finished(options.out / f"{options.seed}.jsonl", "change")
    wanted = drawn(options.changes, options.seed, options.rooms)
    console, trees = Console(), SimpleQueue[Path]()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(PROCESSES) as pool:
        for k in range(PROCESSES):
            trees.put(copy_of_checkout(Path(scratch) / str(k)))

        def put_to_test(change: Change) -> None:
            tree = trees.get()
            try:
                record.add(change.key, noticed=noticed(change, tree))
            finally:
                trees.put(tree)
            console.print(f"{change.key}: {record[change.key]['noticed'] or 'NOT NOTICED'}", soft_wrap=True)

        list(pool.map(put_to_test, [change for change in wanted if change.key not in record]))
    survivors = [change for change in wanted if not record[change.key]["noticed"]]
    for room in options.rooms:
        of_room, missed = (sum(change.room == room for change in some) for some in (wanted, survivors))
        console.print(f"{room}: {of_room - missed} of {of_room} noticed")
    share = 1 - len(survivors) / max(len(wanted), 1)
    console.print(f"{len(wanted) - len(survivors)} of {len(wanted)} changes were noticed, {share:.0%}; not noticed:")
    for change in survivors:
        console.print(f"- {change.key}", soft_wrap=True)
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
