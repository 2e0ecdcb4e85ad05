"""Print how much there is to maintain, each value beside its limit; exit with 1 beyond one.

The limits are in pyproject.toml, `[tool.weight]`. Statements exclude imports and docstrings; parameters exclude those
of compiled kernels; a place is a file or folder directly inside a folder.
"""

import ast
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from sightline.cli import commands

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "sightline"


def is_docstring(node: ast.stmt) -> bool:
    """Return whether a statement is a text alone."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def statements(tree: ast.Module) -> int:
    """Return the number of statements, without imports and docstrings."""
    counted = (node for node in ast.walk(tree) if isinstance(node, ast.stmt))
    return sum(not isinstance(node, ast.Import | ast.ImportFrom) and not is_docstring(node) for node in counted)


def functions(trees: dict[Path, ast.Module]) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Yield every function with the place where it stands."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{path.relative_to(SOURCE)}:{node.name}", node


def is_kernel(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Return whether numba compiles a function."""
    return any("jit" in ast.unparse(each) or "kernel" in ast.unparse(each) for each in function.decorator_list)


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of named parameters."""
    return len(function.args.posonlyargs) + len(function.args.args) + len(function.args.kwonlyargs)


def places(folder: Path) -> int:
    """Return the number of files and sub-folders of a folder, without `__init__.py`."""
    return sum(
        each.name not in ("__init__.py", "__pycache__") and (each.suffix in (".py", ".js") or _holds_files(each))
        for each in folder.iterdir()
    )


def _holds_files(folder: Path) -> bool:  # a room that was moved leaves its __pycache__ behind
    return any(file.is_file() and "__pycache__" not in file.parts for file in folder.rglob("*"))


def lines(*folders: str) -> int:
    """Return the number of lines of Python in folders of the checkout."""
    return sum(len(path.read_text().splitlines()) for name in folders for path in (ROOT / name).rglob("*.py"))


def options(command: Any) -> int:
    """Return the number of options of a command and those below it, without help and completion of the shell."""
    below = sum(options(each) for each in getattr(command, "commands", {}).values())
    own = (each for each in command.params if each.param_type_name == "option")
    return below + sum(each.name not in ("help", "install_completion", "show_completion") for each in own)


def measured() -> dict[str, tuple[int, str]]:
    """Return each value and where it stands, by its name in `[tool.weight]`."""
    trees = {path: ast.parse(path.read_text()) for path in sorted(SOURCE.rglob("*.py"))}
    lengths = [((f.end_lineno or 0) - f.lineno + 1, where) for where, f in functions(trees)]
    counts = [(parameters(f), where) for where, f in functions(trees) if not is_kernel(f)]
    crowds = [(places(folder), str(folder.relative_to(ROOT))) for folder in {path.parent for path in trees}]
    return {
        "statements": (sum(map(statements, trees.values())), ""),
        "files": (len(trees), ""),
        "test-lines": (lines("tests"), ""),
        "benchmark-lines": (lines("benchmarks", "campaigns"), ""),
        "words": (sum(len(path.read_text().split()) for path in (ROOT / "docs").rglob("*.md")), ""),
        "options": (options(typer.main.get_command(commands)), ""),
        "longest-function": max(lengths),
        "parameters": max(counts),
        "places": max(crowds),
    }


def main() -> int:
    """Print the table; return 1 if a value is beyond its limit."""
    limits = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["weight"]
    values = measured()
    for name, (value, where) in values.items():
        over = "  BEYOND ITS LIMIT" if value > limits[name] else ""
        print(f"{name:18} {value:7,}  limit {limits[name]:7,}  {where}{over}")
    return int(any(value > limits[name] for name, (value, _) in values.items()))


if __name__ == "__main__":
    sys.exit(main())
