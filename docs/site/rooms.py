"""The directive `room`: what a package exports, from its docstrings. Its content names further classes that users meet.

What is public in `sightline` itself is described on that page alone, and linked.
"""

from importlib import import_module

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import sightline

PAGE = """```{{eval-rst}}
.. automodule:: {name}
   :exclude-members: {elsewhere}
{classes}
```
"""


class Room(SphinxDirective):
    """A package."""

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the descriptions."""
        name = self.arguments[0]
        room = import_module(name)
        public = [n for n in sightline.__all__ if n in room.__all__ and getattr(sightline, n) is getattr(room, n)]
        if room is sightline:
            public = ["__version__"]
        classes = "".join(f"\n.. autoclass:: {path}\n" for path in self.content if path)
        text = PAGE.format(name=name, elsewhere=", ".join(public), classes=classes)
        if public and room is not sightline:
            links = ", ".join(f"{{py:obj}}`~sightline.{n}`" for n in public)
            text = f"Also exported here, and described with the [public face](sightline.md): {links}.\n\n{text}"
        return self.parse_text_to_nodes(text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("room", Room)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
