"""The site of `make docs`: the pages of this folder, the API from its docstrings, and the program's own help."""

import sys
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

from sightline import __version__

sys.path.insert(0, str(Path(__file__).parent / "site"))  # our own extensions

project = "Sightline"
author = "The Sightline authors"
project_copyright = author
release = __version__
version = release

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "commands",
    "diagrams",
    "equations",
    "procedures",
    "rooms",
]
exclude_patterns = ["README.md"]  # the index includes it
smartquotes = False  # they would turn "--json" into a dash
nitpicky = True
# Types of other packages: their pages are not fetched, so nothing can be linked to.
nitpick_ignore_regex = [(r"py:.*", r"(?!sightline).*")]
# Types that only the estimation core uses, schemas of files, and private ones
nitpick_ignore_regex += [
    (r"py:class", r"sightline\..*\._\w+"),
    (r"py:class", r"sightline\.(common\.fitting|frame\.document|planning\.procedures\.document)\..*"),
    (r"py:class", r"sightline\.twin\.xray\.intensifier\.DistortionMap"),
    (r"py:class", r"sightline\.calibration\.(view\.(Posterior|Pencil)|maps\.smooth\..*|plates\.(beads|joint)\..*)"),
    (r"py:class", r"sightline\.robot\.igtl\.wire\.Reader"),
]

# Markdown: what GitHub renders too
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 5
myst_fence_as_directive = ["mermaid"]

# Notebooks: executed at every build in an empty folder; an error ends the build
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True
nb_execution_show_tb = True

# API
default_role = "code"
autodoc_default_options = {"members": True, "imported-members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
python_display_short_literal_types = True
python_trailing_comma_in_multi_line_signatures = False
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_title = f"Sightline {release}"
html_math_renderer = "mathml"
html_static_path = ["site/style.css"]
html_css_files = ["style.css"]
templates_path = ["site/templates"]
html_sidebars = {"**": ["all-pages.html"]}
html_show_sourcelink = False
html_theme_options = {
    "logo": {"text": "Sightline"},
    "navbar_center": [],
    "navbar_persistent": [],
    "navbar_end": ["search-field", "theme-switcher"],
    "navigation_with_keys": False,
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}


def setup(app: Sphinx) -> None:
    """Add what Pygments lacks, and lead links to the README to the start page, which stands for it here."""
    app.add_lexer("csv", TextLexer)
    app.connect("source-read", _without_readme)


def _without_readme(_app: Sphinx, _page: str, source: list[str]) -> None:
    source[0] = source[0].replace("](../README.md)", "](index.md)")
