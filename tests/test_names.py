"""One name for one thing: a public class of the package has a name that no other one has."""

import ast
from collections import defaultdict
from pathlib import Path

import sightline


def test_each_public_class_name_stands_once() -> None:
    package = Path(sightline.__file__).parent
    homes = defaultdict(list)
    for file in package.rglob("*.py"):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(str(file.relative_to(package)))
    assert len(homes) > 400
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}
