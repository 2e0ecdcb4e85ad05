"""The pages keep up with the code: every check and error has its heading, links resolve, citations hold."""

import ast
import inspect
import re
import tomllib
from collections import defaultdict
from importlib import import_module
from pathlib import Path

import pytest

from sightline import errors
from sightline.common.checks import CheckCode, code_key
from sightline.planning.procedures.procedure import shipped

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]


def headings(page: Path) -> list[str]:
    return re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)


def test_every_code_of_a_check_has_its_heading() -> None:
    third = re.findall(r"^### (.+)$", (ROOT / "docs" / "refusals.md").read_text(), flags=re.MULTILINE)
    assert len(third) == len(set(third))
    assert {code_key(name) for name in third if not name.endswith("Error")} == set(CheckCode)


def test_every_error_has_its_heading() -> None:
    raised = {name for name, thing in inspect.getmembers(errors, inspect.isclass) if issubclass(thing, Exception)}
    assert raised - set(headings(ROOT / "docs" / "refusals.md")) == set()


def anchor(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("https://", "mailto:")):
            continue
        path, _, part = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} links to {target}"
        if part and not part.startswith("sightline."):  # the site makes an anchor of each public name
            assert part in {anchor(h) for h in headings(file)}, f"{page.name} links to {target}"


def test_every_shipped_procedure_has_a_page_with_its_file_and_a_small_picture() -> None:
    for key in shipped():
        text = (ROOT / "docs" / "procedures" / f"{key}.md").read_text()
        assert f"```{{procedure}} {key}\n```" in text  # the tables of the page are made of the file
        assert "\n## Figures\n" in text and "\n## Limits of this procedure\n" in text
        pictures = re.findall(r"]\(\.\./(pictures/[^)]+)\)", text)
        assert pictures
        assert all((ROOT / "docs" / name).stat().st_size < 300_000 for name in pictures)


def toctrees(page: Path) -> set[Path]:
    """Pages in the toctrees of a page."""
    blocks = re.findall(r"^```{toctree}\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    names = [line for block in blocks for line in block.splitlines() if line and not line.startswith(":")]
    return {path.resolve() for name in names for path in page.parent.glob(f"{name}.md") if path != page}


def test_every_page_is_in_a_toctree_of_the_site() -> None:
    pages = set((ROOT / "docs").rglob("*.md")) - {ROOT / "docs" / "index.md", ROOT / "docs" / "README.md"}
    assert set().union(*map(toctrees, (ROOT / "docs").rglob("*.md"))) == pages


def exported(room: Path) -> set[str]:
    """The names of `__all__`."""
    for statement in ast.parse(room.read_text()).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "__all__":
            return set(ast.literal_eval(statement.value))
    return set()


def test_every_exported_name_is_on_a_page_of_the_api() -> None:
    described = set()
    for page in (ROOT / "docs" / "api").glob("*.md"):
        described |= set(re.findall(r"^```{room} ([\w.]+)$", page.read_text(), flags=re.MULTILINE))
    for room in (ROOT / "src" / "sightline").rglob("__init__.py"):
        name = ".".join(room.parent.relative_to(ROOT / "src").parts)
        if name not in described:  # then its parent exports the same names
            assert exported(room) <= exported(room.parents[1] / "__init__.py"), name


def test_every_class_that_a_page_of_the_api_adds_exists() -> None:
    for page in (ROOT / "docs" / "api").glob("*.md"):
        for path in re.findall(r"^sightline\.[\w.]+$", page.read_text(), flags=re.MULTILINE):
            module, name = path.rsplit(".", 1)
            assert inspect.isclass(getattr(import_module(module), name, None)), f"{page.name}: {path}"


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "notebooks").glob("*.md")), ids=lambda p: p.name)
def test_the_code_of_a_notebook_parses(page: Path) -> None:
    """`make docs` executes it."""
    cells = re.findall(r"^```{code-cell}\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert cells
    assert page.read_text().count("{code-cell}") == len(cells)
    ast.parse("\n".join(cells))


def test_every_page_that_a_reader_starts_from_is_listed() -> None:
    listed = set(re.findall(r"\]\(([\w/-]+\.md)\)", (ROOT / "docs" / "README.md").read_text()))
    assert {ROOT / "docs" / name for name in listed} == toctrees(ROOT / "docs" / "index.md")


def test_pictures_of_the_readme_are_small() -> None:
    pictures = list((ROOT / "docs" / "pictures").iterdir())
    assert pictures
    assert all(picture.stat().st_size < 300_000 for picture in pictures)


def test_the_tests_that_the_page_on_safety_names_exist() -> None:
    named = re.findall(r"(tests/[\w/]+\.py)::(\w+)", (ROOT / "docs" / "safety.md").read_text())
    assert len(named) > 20
    assert [f"{file}::{name}" for file, name in named if f"def {name}(" not in (ROOT / file).read_text()] == []


def test_every_page_and_section_that_the_sources_cite_exists() -> None:
    """Of the page on physics its sections too."""
    sections = headings(ROOT / "docs" / "physics.md")
    for file in (ROOT / "src").rglob("*.py"):
        text = re.sub(r"\n\s*#? *", " ", file.read_text())
        for page in re.findall(r"(?<![\w/])docs/([\w-]+\.md)", text):
            assert (ROOT / "docs" / page).exists(), f"{file.name} cites {page}"
        for section in re.findall(r"physics\.md, \"?(?:section )?([A-Z][\w-]+)", text):
            assert any(known.startswith(section) for known in sections), f"{file.name} cites {section} of physics.md"


def test_no_source_cites_what_is_not_in_the_repository() -> None:
    for folder in ("src", "tests", "benchmarks", "campaigns"):
        for file in (ROOT / folder).rglob("*.py"):
            assert "[is" + "sue]" not in file.read_text(), file


def test_the_paper_cites_what_its_references_hold() -> None:
    cited = set(re.findall(r"@(\w+\d{4})", (ROOT / "paper.md").read_text()))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", (ROOT / "paper.bib").read_text(), flags=re.MULTILINE))


def test_one_licence_holds_for_every_file() -> None:
    stated = tomllib.loads((ROOT / "REUSE.toml").read_text())["annotations"]
    assert [one["path"] for one in stated] == ["**"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {stated[0]["SPDX-License-Identifier"], project["license"]} == {"Apache-2.0"}


def test_each_public_class_name_stands_once() -> None:
    package = ROOT / "src" / "sightline"
    homes = defaultdict(list)
    for file in package.rglob("*.py"):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(str(file.relative_to(package)))
    assert len(homes) > 400
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}
