"""The directive `commands`: every command of `sightline` with its arguments, from the program itself."""

import typer.main
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from sightline.cli import commands


def described(command, parent=None) -> nodes.section:
    """Return the section of a command: its help, its usage, its arguments, then its sub-commands."""
    context = command.context_class(command, info_name=command.name, parent=parent)
    section = nodes.section(ids=[nodes.make_id(context.command_path)], names=[context.command_path])
    section += nodes.title(text=context.command_path)
    usage = command.get_usage(context).removeprefix("Usage: ")
    section += [paragraph(text) for text in (command.help or "").split("\n\n")]
    section += nodes.literal_block(usage, usage, language="text")
    records = [record for parameter in command.params if (record := parameter.get_help_record(context))]
    section += nodes.definition_list("", *(item(*record) for record in records))
    section += [paragraph(text) for text in (command.epilog or "").split("\n\n")]
    section += [described(sub, context) for sub in getattr(command, "commands", {}).values()]
    return section


def item(name: str, text: str) -> nodes.definition_list_item:
    """Return an argument and what it says."""
    term = nodes.term("", "", nodes.literal(text=name))
    return nodes.definition_list_item("", term, nodes.definition("", nodes.paragraph(text=text)))


def paragraph(text: str) -> nodes.Element:
    """Return a paragraph as prose, or as it stands where it is indented: an example."""
    lines = text.replace("\b", "").strip("\n")
    if lines.startswith("  "):
        return nodes.literal_block(lines, lines, language="text")
    return nodes.paragraph(text=" ".join(lines.split()))


class Commands(SphinxDirective):
    """Every command."""

    def run(self) -> list[nodes.Node]:
        """Return a section for each command."""
        program = typer.main.get_command(commands)
        program.name = "sightline"
        context = program.context_class(program, info_name="sightline")
        return [described(command, context) for command in program.commands.values()]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
