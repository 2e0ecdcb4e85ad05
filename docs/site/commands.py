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
    section += paragraphs(command.help)
    section += nodes.literal_block(usage, usage, language="text")
    records = [record for parameter in command.params if (record := parameter.get_help_record(context))]
    section += nodes.definition_list("", *(item(*record) for record in records))
    section += paragraphs(command.epilog)
    section += [described(sub, context) for sub in getattr(command, "commands", {}).values()]
    return section


def item(name: str, text: str) -> nodes.definition_list_item:
    """Return an argument and its help."""
    term = nodes.term("", "", nodes.literal(text=name))
    return nodes.definition_list_item("", term, nodes.definition("", nodes.paragraph(text=text)))


def paragraphs(text: str | None) -> list[nodes.Element]:
    """Return a help text: paragraphs, and where one begins with the sign for "as it stands" a title and an example."""
    out: list[nodes.Element] = []
    for part in (text or "").split("\n\n"):
        if part.startswith("\b\n"):
            title, _, example = part.removeprefix("\b\n").partition("\n")
            out += [nodes.paragraph(text=title), nodes.literal_block(example, example, language="sh")]
        elif part:
            out.append(nodes.paragraph(text=" ".join(part.split())))
    return out


class Commands(SphinxDirective):
    """Every command."""

    def run(self) -> list[nodes.Node]:
        """Return a section for each command."""
        self.env.note_reread()  # the program may have changed where this page has not
        program = typer.main.get_command(commands)
        program.name = "sightline"
        context = program.context_class(program, info_name="sightline")
        return [described(command, context) for command in program.commands.values()]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
