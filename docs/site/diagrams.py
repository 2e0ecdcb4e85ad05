"""Diagrams in Mermaid, as GitHub draws them. The script is that of NiceGUI, which is installed: nothing is fetched.

Browsers load it from a server alone (`python -m http.server -d out/docs`); of a file they show the diagram's text.
"""

from html import escape
from importlib.util import find_spec
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.fileutil import copy_asset

START = """import {{ mermaid }} from "./{path}";
mermaid.initialize({{ startOnLoad: true, theme: "neutral" }});
for (const diagram of document.querySelectorAll("pre.mermaid"))  // fits the page; a click shows it in full size
  diagram.addEventListener("click", () => {{
    const svg = diagram.querySelector("svg");
    if (svg) svg.style.width = svg.style.width ? "" : svg.style.maxWidth;
  }});"""


class Mermaid(SphinxDirective):
    """A fence ```mermaid."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the diagram's text, for the script to draw."""
        text = escape("\n".join(self.content))
        return [nodes.raw("", f'<pre class="mermaid">{text}</pre>', format="html")]


def add_script(app: Sphinx, page: str, _template: str, _context: dict, tree: nodes.document | None) -> None:
    """Load the script on pages with a diagram."""
    if tree and any('class="mermaid"' in raw.astext() for raw in tree.findall(nodes.raw)):
        path = app.builder.get_relative_uri(page, "_static/mermaid/index.js").removesuffix(".html")
        app.add_js_file(None, body=START.format(path=path), type="module")


def copy_script(app: Sphinx, error: Exception | None) -> None:
    """Put the script beside the pages."""
    spec = find_spec("nicegui")
    if error is None and spec and spec.origin:
        copy_asset(Path(spec.origin).parent / "elements/mermaid/dist", app.outdir / "_static/mermaid")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("mermaid", Mermaid)
    app.connect("html-page-context", add_script)
    app.connect("build-finished", copy_script)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
