"""The choice of the procedure."""

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import Section
from sightline.app.tab.tab import Tab
from sightline.planning.procedures import Procedure, procedures
from sightline.planning.procedures import kind as kind_of


def build_kind(tab: Tab) -> None:
    """Build the choice."""
    Section(tab, lambda t: t.planning.decisions.kind, _kind)


def _kind(tab: Tab) -> None:
    known = kind_of(tab.planning.decisions.kind)
    kinds: dict[str, str] = {}  # each procedure once, by its first wire
    for key, one in procedures().items():
        if one.wire == one.document.wires[0]:
            kinds[key] = texts.titled(one.document.name)

    async def choose(event) -> None:
        await tab.choose_kind(event.value)

    shown = Procedure.of(known.document, known.document.wires[0].key).key
    ui.select(kinds, value=shown, on_change=choose).classes("kind").props(
        f'dense options-dense data-testid=kind aria-label="{"Procedure"}"'
    )
