"""Mutation testing: random one-token changes, each with the tests run against it.

`python -m campaigns.mutants [--changes N] [--seed S]`. A change that no test detects is printed with its line: it must
be shown to be equivalent, or get a test. Finished changes are kept; the same command resumes a stopped run. Every
change is made in a copy of the checkout, which is deleted at the end.

The tests of the change's own room run first, for all changes; the other tests only for undetected ones.
"""

import argparse
import ast
import json
import os
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

ROOT = Path(__file__).parents[1]
ROOMS = ("planning", "calibration", "frame", "robot", "case", "detection")  # those whose tests are the quickest first
SWAPPED = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Lt: ">", ast.LtE: ">", ast.Gt: "<", ast.GtE: "<",
    ast.Eq: "!=", ast.NotEq: "==", ast.And: "or", ast.Or: "and",
}  # fmt: skip
TOKENS = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=",
    ast.Eq: "==", ast.NotEq: "!=", ast.And: "and", ast.Or: "or",
}  # fmt: skip
LIMIT_S = 900  # a change that makes the tests run this long is detected: something waits forever


@dataclass(frozen=True)
class Change:
    """One token of a file, at byte offsets of its UTF-8 text, and its replacement."""

    file: str
    line: int
    start: int
    end: int
    token: str
    instead: str

    @property
    def key(self) -> str:
        """Its name in the record."""
        return f"{self.file}:{self.line}: {self.token} -> {self.instead} @{self.start}"

    def applied(self, text: bytes) -> bytes:
        """Return the file's text with the change."""
        assert text[self.start : self.end] == self.token.encode()
        return text[: self.start] + self.instead.encode() + text[self.end :]


def changes_of(file: Path) -> Iterator[Change]:
    """Yield all changes of a file: numbers, operators, comparisons, Booleans, indices 0 and 1.

    Not in docstrings, nor of zip's `strict`, which has no effect for equal lengths.
    """
    text = file.read_bytes()
    tree = ast.parse(text)
    starts = np.cumsum([0, *(len(line) for line in text.splitlines(keepends=True))])
    name = str(file.relative_to(ROOT))

    def at(node: ast.expr, end: bool = False) -> int:
        line, column = (node.end_lineno, node.end_col_offset) if end else (node.lineno, node.col_offset)
        return int(starts[line - 1]) + column

    def between(left: ast.expr, right: ast.expr, operator: ast.AST) -> Iterator[Change]:
        token, instead = TOKENS.get(type(operator)), SWAPPED.get(type(operator))
        place = text.find(token.encode(), at(left, end=True), at(right)) if token else -1
        if token and instead and place >= 0:
            yield Change(name, left.end_lineno, place, place + len(token), token, instead)

    guards = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "strict"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and type(node.value) in (int, float, bool) and id(node) not in guards:
            token = text[at(node) : at(node, end=True)].decode()
            yield Change(name, node.lineno, at(node), at(node, end=True), token, _other(node.value))
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


def drawn(number: int, seed: int) -> list[Change]:
    """Return the first of a random permutation of all changes, so that more can be added later."""
    files = sorted(f for room in ROOMS for f in (ROOT / "src/sightline" / room).rglob("*.py"))
    every = [change for file in files for change in changes_of(file)]
    order = np.random.default_rng(seed).permutation(len(every))
    return [every[k] for k in order[:number]]


def copy_of_checkout(folder: Path) -> Path:
    """Copy the files that git tracks and the compiled kernels, with their time stamps; return the folder."""
    tree = folder / "tree"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True).stdout  # noqa: S607
    for name in filter(None, listed.decode().split("\0")):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name)
    for cache in (ROOT / "src").rglob("__pycache__"):
        shutil.copytree(cache, tree / cache.relative_to(ROOT), dirs_exist_ok=True)
    return tree


def room_of(change: Change) -> str:
    """Return the room whose source is changed."""
    return Path(change.file).parts[2]


def own_tests(change: Change) -> list[str]:
    """Return the test files of the change's room, those that import the changed module first."""
    module = ".".join(Path(change.file).with_suffix("").parts[1:])
    files = sorted((ROOT / "tests" / room_of(change)).rglob("test_*.py"))
    return [str(file.relative_to(ROOT)) for file in sorted(files, key=lambda file: module not in file.read_text())]


def noticed(change: Change, tests: list[str], tree: Path) -> str:
    """Return the first test that fails with the change, or ""."""
    file = tree / change.file
    before, stamp = file.read_bytes(), file.stat()
    # Compiled kernels contain functions and constants of other files.
    kept = _set_aside(tree) if room_of(change) == "detection" or b"njit" in before else None
    try:
        file.write_bytes(change.applied(before))
        return _fails(tests, tree)
    finally:
        file.write_bytes(before)
        os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        if kept is not None:
            _put_back(tree, kept)


def _set_aside(tree: Path) -> Path:
    """Move all compiled kernels away, because they contain copies of functions in changed files; return the folder."""
    kept = tree.parent / "kept"
    shutil.rmtree(kept, ignore_errors=True)
    for cache in list((tree / "src").rglob("__pycache__")):
        (kept / cache.relative_to(tree)).parent.mkdir(parents=True, exist_ok=True)
        cache.rename(kept / cache.relative_to(tree))
    return kept


def _put_back(tree: Path, kept: Path) -> None:
    for cache in list((tree / "src").rglob("__pycache__")):
        shutil.rmtree(cache)
    for cache in list(kept.rglob("__pycache__")):
        cache.rename(tree / cache.relative_to(kept))


def _fails(where: list[str], tree: Path) -> str:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", *where]
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "OPENBLAS_NUM_THREADS": "1"}
    try:
        run = subprocess.run(
            command, check=False, cwd=tree, env=environment, capture_output=True, text=True, timeout=LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return "the tests do not end"
    if run.returncode == pytest.ExitCode.OK:
        return ""
    if run.returncode in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise SystemExit(run.stderr or run.stdout)
    lines = [line for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return lines[0].split(" - ")[0] if lines else f"exit code {run.returncode}"


class Record:
    """Finished changes, a line of JSON each: the change, the tests run, and the one that detected it."""

    def __init__(self, file: Path) -> None:
        self._file = file
        lines = file.read_text().splitlines() if file.exists() else []
        self._by = {(line["change"], line["tests"]): str(line["noticed"]) for line in map(json.loads, lines)}

    def holds(self, change: Change, tests: str) -> bool:
        """Return whether these tests were run against a change."""
        return (change.key, tests) in self._by

    def noticed(self, change: Change) -> str:
        """Return the test that detected a change, or ""."""
        return next((by for (key, _), by in self._by.items() if key == change.key and by), "")

    def add(self, change: Change, tests: str, by: str) -> None:
        """Record a result."""
        self._by[change.key, tests] = by
        with self._file.open("a") as out:
            out.write(json.dumps({"change": change.key, "tests": tests, "noticed": by}) + "\n")


def main() -> int:
    """Print the changes that no test detected; return 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--changes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/mutants"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    record = Record(options.out / f"{options.seed}.jsonl")
    wanted = drawn(options.changes, options.seed)
    console, trees = Console(), SimpleQueue[Path]()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(os.cpu_count()) as pool:
        for k in range(os.cpu_count() or 1):
            trees.put(copy_of_checkout(Path(scratch) / str(k)))

        def one(change: Change, tests: list[str]) -> str:
            tree = trees.get()
            try:
                return noticed(change, tests, tree)
            finally:
                trees.put(tree)

        for name in ("its room's", "the others"):
            left = [c for c in wanted if not record.noticed(c) and not record.holds(c, name)]
            left.sort(key=lambda change: ROOMS.index(room_of(change)))
            own = name == "its room's"
            put_to = [own_tests(c) if own else ["tests", f"--ignore=tests/{room_of(c)}"] for c in left]
            for k, (change, by) in enumerate(zip(left, pool.map(one, left, put_to), strict=True)):
                record.add(change, name, by)
                console.print(
                    f"{k + 1} of {len(left)} to {name} tests: {change.key}: {by or 'NOT NOTICED'}", soft_wrap=True
                )
    survivors = [change.key for change in wanted if not record.noticed(change)]
    console.print(f"{len(wanted) - len(survivors)} of {len(wanted)} changes were noticed; not noticed:")
    for key in survivors:
        console.print(f"- {key}", soft_wrap=True)
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
