"""The drawer: everything that is not needed at each moment of a step, over the right part of the images."""

from collections.abc import Callable

from nicegui import ui

from sightline.app import texts
from sightline.app.panels import calibrate, drill, images, plan, verdict, verify
from sightline.app.panels.menu import Menu
from sightline.app.panels.section import Section
from sightline.app.tab.step import ProcedureStep
from sightline.app.tab.tab import Tab

_DETAILS: dict[ProcedureStep, Callable[[Tab], None]] = dict(
    zip(
        ProcedureStep,
        (images.build_details, calibrate.build_details, plan.build_details, drill.build_details, verify.build_details),
        strict=True,
    )
)


class Drawer:
    """The drawer of one page; its content is built only while it is open."""

    def __init__(self, tab: Tab, menu: Menu) -> None:
        self._tab, self._menu, self.open = tab, menu, False
        self._box = ui.element("section").classes("drawer").props(f'data-testid=drawer aria-label="{texts.DETAILS}"')
        self._box.set_visibility(False)
        with self._box:
            Section(tab, lambda t: (t.step, self.open), self._build)

    def toggle(self) -> None:
        """Open or close it."""
        self.open = not self.open
        self._box.set_visibility(self.open)
        self._tab.refresh()

    def _build(self, tab: Tab) -> None:
        if self.open:
            self._menu.build()
            _DETAILS[tab.step](tab)
            if tab.step in (ProcedureStep.PLAN, ProcedureStep.DRILL):
                verdict.build_details(tab)
            ui.label(f"Research software, not a medical device. Case {tab.planning.case.number}").classes("foot")
