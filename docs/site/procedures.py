"""The directive `procedure`: what a shipped procedure's file holds, with its sources, from the file itself."""

from collections.abc import Iterable, Sequence

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.procedures.procedure import shipped


def tables(document: ProcedureDocument) -> Iterable[tuple[str, Sequence[str], list[Sequence[str]]]]:
    """Yield the title, columns and rows of each table of a procedure."""
    views = [(v.name, f"{v.orbit_deg:g}°", f"{v.tilt_deg:g}°", f"{v.within_deg:g}°", v.source) for v in document.views]
    yield "Views, in the order of the images", ("view", "orbit", "tilt", "within", "source"), views
    wires = [(f"{one.name} ({one.diameter_mm:g} mm)", p.name, p.sentence) for one in document.wires for p in ends(one)]
    asked = [("landmark", one.name, one.sentence) for one in document.landmarks]
    drawn = [(one.type, one.name, one.sentence) for one in document.aids]
    yield "What a person picks and draws", ("of", "name", "where"), [*wires, *asked, *drawn]
    given = document.limits
    limits = [("95 % error of position", f"{given.position_mm.limit:g} mm", given.position_mm.source)]
    limits += [("95 % error of direction", f"{given.direction_deg.limit:.3g}°", given.direction_deg.source)]
    limits += [("drilled past the end point", f"{given.beyond_mm.limit:g} mm", given.beyond_mm.source)]
    if given.before_mm is not None:
        limits.append(
            ("bone begins before the entry point", f"by up to {given.before_mm.limit:g} mm", given.before_mm.source)
        )
    if document.corridor is not None:
        space = document.corridor
        limits.append(("implant and bone around it", f"{space.implant_mm:g} + {space.margin_mm:g} mm", space.source))
    relations = [(f"relation: {one.relation}", within(one), one.source) for one in document.relations]
    if document.proposal is not None:
        rule = document.proposal
        numbers = {"°": rule.angle_deg, " mm": rule.under_surface_mm}
        said = ", ".join(f"{value:g}{unit}" for unit, value in numbers.items() if value is not None)
        limits.append((f"proposal: {rule.rule}", said, rule.source))
    relations += [
        (
            f"direction: {one.label}",
            f"orbit {one.orbit_deg:g}°, tilt {one.tilt_deg:g}°, s.d. {one.sd_deg:g}°",
            one.source,
        )
        for one in document.directions
    ]
    checks = [
        (one.check, within(one), one.source + (f"; optional: {one.optional}" if one.optional else ""))
        for one in document.checks
    ]
    yield (
        "Limits, relations and checks, with their sources",
        ("what", "accepted", "source"),
        limits + relations + checks,
    )


def ends(wire) -> tuple:
    """Return what is asked of a wire's entry and end."""
    return wire.entry, wire.end


def within(rule) -> str:
    """Return the limits of a rule as text."""
    low, high = ("" if one is None else f"{one:g}" for one in (rule.low, rule.high))
    return f"{low} to {high}" if low and high else f"from {low}" if low else f"up to {high}" if high else ""


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> nodes.table:
    """Return a table of texts."""

    def row(texts: Sequence[str]) -> nodes.row:
        return nodes.row("", *(nodes.entry("", nodes.paragraph(text=text)) for text in texts))

    group = nodes.tgroup("", *(nodes.colspec(colwidth=1) for _ in columns), cols=len(columns))
    group += [nodes.thead("", row(columns)), nodes.tbody("", *map(row, rows))]
    return nodes.table("", group)


class ShippedProcedure(SphinxDirective):
    """What a procedure's file holds; its key is the argument."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return a title and a table for each part."""
        self.env.note_reread()  # the file may have changed where this page has not
        out: list[nodes.Node] = []
        for title, columns, rows in tables(shipped()[self.arguments[0]]):
            out += [nodes.rubric(text=title), table(columns, rows)]
        return out


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("procedure", ShippedProcedure)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
