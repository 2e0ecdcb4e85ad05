"""Equations as MathML, which browsers draw by themselves, and a font for them: no script, nothing fetched."""

from importlib.util import find_spec
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.fileutil import copy_asset
from sphinx.util.math import get_node_equation_number
from sphinx.writers.html5 import HTML5Translator


def mathml(node: nodes.Element, display: str) -> str:
    """Return an equation; warn of a command that the converter does not know, which it leaves as it stands."""
    out = convert(node.astext(), display=display)
    if "\\" in out:
        logging.getLogger(__name__).warning("not converted: %s", node.astext(), location=node)
    return out


def inline(writer: HTML5Translator, node: nodes.math) -> None:
    """Write an equation of a line of text."""
    writer.body.append(mathml(node, "inline"))
    raise nodes.SkipNode


def block(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write an equation of its own line, with its number where it has one."""
    writer.body.append(writer.starttag(node, "div", CLASS="math"))
    if node["number"]:
        writer.body.append(f'<span class="eqno">({get_node_equation_number(writer, node)})')
        writer.add_permalink_ref(node, "Link to this equation")
        writer.body.append("</span>")
    writer.body.append(mathml(node, "block") + "</div>")
    raise nodes.SkipNode


def copy_font(app: Sphinx, error: Exception | None) -> None:
    """Put the font beside the pages."""
    spec = find_spec("ziamath")
    if error is None and spec and spec.origin:
        copy_asset(Path(spec.origin).parent / "fonts/STIXTwoMath-Regular.ttf", app.outdir / "_static")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer: `html_math_renderer = "mathml"`."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("build-finished", copy_font)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
