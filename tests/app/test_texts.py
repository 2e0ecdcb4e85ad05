"""The page's texts are in texts: no panel contains a sentence."""

import ast
import re
from importlib.resources import files
from pathlib import Path

import pytest

APP = Path(str(files("sightline.app")))
PANELS = [*sorted(f"panels/{path.name}" for path in APP.glob("panels/*.py")), "page.py"]
NOT_READ = ("props", "classes", "style")  # methods that take names of attributes and looks


def sentences(source: str) -> list[str]:
    """Literals of three words or more, but docstrings, attributes and tags."""
    tree = ast.parse(source)
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in NOT_READ:
            skipped |= {id(part) for part in ast.walk(node) if part is not node.func and isinstance(part, ast.Constant)}
            skipped -= {id(part) for part in ast.walk(node.func)}
        if isinstance(node, ast.Expr):
            skipped.add(id(node.value))
    texts = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and id(n) not in skipped]
    return [text for text in texts if isinstance(text, str) and _words(text) > 2]


def _words(text: str) -> int:
    return sum(bool(re.search(r"[^\W\d]{2}", word)) for word in re.sub("<[^>]*>?", "", text).split())


@pytest.mark.parametrize("panel", PANELS)
def test_panels_hold_no_sentences(panel: str) -> None:
    assert not sentences((APP / panel).read_text("utf-8"))


def test_the_measure_finds_sentences() -> None:
    assert sentences('note("Drill the wire first.")')
    assert sentences('ui.label(f"Drill the wire {name}").classes("note quiet small")')
    assert sentences('ui.label("Drill the wire").props("data-testid=x role=status")')
    assert not sentences(
        '"""A docstring of a panel."""\nui.label(HINT).classes("note quiet small").props(f"a b c {d}")'
    )
