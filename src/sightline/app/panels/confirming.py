"""A button that asks for confirmation before it acts."""

from collections.abc import Awaitable, Callable

from nicegui import ui

from sightline.app.panels.section import action
from sightline.app.tab.tab import Tab


def confirmed_action(
    tab: Tab,
    text: str,
    question: str,
    command: Callable[[], Awaitable[object] | None],
    testid: str,
    *,
    what: str = "",
    enabled: bool,
    kind: str = "primary",
) -> None:
    """Build a button that asks for confirmation before it acts."""

    def ask() -> None:
        # On the page, not in this section: the question stays when the robot's state rebuilds the section. A command
        # that no longer fits is refused by what it calls.
        with ui.context.client, ui.dialog() as dialog, ui.card().classes("question"):
            ui.label(question).classes("question-text")
            if what:
                ui.label(what)

            async def agreed() -> None:
                dialog.close()
                await tab.act(command)

            with ui.element("div").classes("choice"):
                action("Cancel", dialog.close, testid=f"{testid}-cancel", kind="plain")
                action(text, agreed, testid=f"{testid}-yes", kind="primary")
        dialog.on("hide", dialog.delete)
        dialog.open()

    action(text, ask, testid=testid, kind=kind, enabled=enabled)
