"""The drawer with all that is not needed at each moment of a step, the sheet of shortcuts, and the other cases."""

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

from nicegui import ui

from sightline.app import texts
from sightline.app.panels import drill, images, plan, verdict, verify
from sightline.app.panels.section import Section, action, heading, table
from sightline.app.session.session import CaseInFolder, cases_beside
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.case.journal import Kind

_SHORTCUTS = (
    ("stop the robot", "space bar"),
    ("undo, redo", "Ctrl+Z, Ctrl+Y"),
    ("place a point", "click, or Enter at the cross-hair"),
    ("move a point", "drag, or arrow keys: 1 pixel, with Shift 0.1"),
    ("remove a point", "Delete"),
    ("cancel", "Escape"),
    ("zoom, pan", "wheel or pinch; drag the background"),
    ("brightness and contrast", "drag with the right button"),
    ("next, previous control", "Tab, Shift+Tab"),
    ("this sheet", "?"),
)
OpenCase = Callable[[Path], Awaitable[None]]


class Menu:
    """The dialogs of one page."""

    def __init__(self, tab: Tab, open_case: OpenCase) -> None:
        self._tab, self._open_case = tab, open_case
        sheet = ui.dialog().props('aria-label="Keyboard and mouse"')
        with sheet as self._shortcuts, ui.card().classes("question").props("data-testid=shortcuts-sheet"):
            heading("Keyboard and mouse")
            table(("to", "do"), _SHORTCUTS, testid="shortcuts-table")
            action(texts.CLOSE, self._shortcuts.close, testid="shortcuts-close", kind="primary")
        sheet = ui.dialog().props(f'aria-label="{texts.CASES}"')
        with sheet as self._cases, ui.card().classes("question wide").props("data-testid=cases-sheet"):
            self._listed = ui.element("div")
            action(texts.CLOSE, self._cases.close, testid="cases-close", kind="primary")

    def build(self) -> None:
        """Build the buttons that save the report, export the plan and open the dialogs."""
        save = self._tab.doing(self._tab.save_report)
        with ui.element("div").classes("choice"):
            action(texts.REPORT, save, testid="report", kind="small")
            action(texts.EXPORT, self._tab.doing(self._tab.export), testid="export", kind="small")
            action(texts.CASES, self._tab.doing(self._show_cases), testid="cases", kind="small")
            action("Shortcuts (?)", self.show_shortcuts, testid="shortcuts", kind="small")

    def show_shortcuts(self) -> None:
        """Open the sheet of shortcuts."""
        self._shortcuts.open()

    async def _show_cases(self) -> None:
        folder = self._tab.planning.case.folder
        cases = await asyncio.to_thread(cases_beside, folder)
        self._listed.clear()
        with self._listed:
            heading(texts.CASES)
            with ui.element("table").props("data-testid=cases-table"):
                with ui.element("tr"):
                    for name in ("case", "newest entry, UTC", "reached", "folder", ""):
                        _cell("th", name).props("scope=col")
                for case in cases:
                    self._row(case, here=case.folder == folder.resolve())
        self._cases.open()

    def _row(self, case: CaseInFolder, *, here: bool) -> None:
        with ui.element("tr"):
            _cell("th", f"{case.number} (this one)" if here else case.number).props("scope=row")
            for text in (
                f"{case.at:%Y-%m-%d %H:%M}",
                "images" if case.reached is Kind.ACQUIRED else case.reached.value,
                case.folder.name,
            ):
                _cell("td", text)
            with ui.element("td"):
                if not here:
                    button = action(
                        texts.CASE_OPEN, partial(self._ask, case), testid=f"open-{case.number}", kind="small"
                    )
                    button.props(f'aria-label="{texts.CASE_OPEN} {case.number}"')

    def _ask(self, case: CaseInFolder) -> None:
        """Ask whether to leave this case for another one."""
        now = self._tab.session.drilling.now
        robot = () if now is None or now.lost else ("The link to the robot is closed: it stops and forgets its plan.",)

        async def agreed() -> None:
            self._cases.close()
            await self._tab.act(lambda: self._open_case(case.folder))

        self._listed.clear()
        with self._listed:
            for text in (
                f"Open case {case.number}? All that was done in this case is saved; it can be opened again.",
                *robot,
            ):
                ui.label(text).classes("question-text")
            action(texts.CASE_OPEN, agreed, testid="open-yes", kind="primary")


def _cell(tag: str, text: str) -> ui.element:
    with ui.element(tag) as cell:
        ui.label(text)
    return cell


_DETAILS: dict[ProcedureStep, Callable[[Tab], None]] = dict(
    zip(
        ProcedureStep,
        (
            images.build_details,
            images.build_calibration_details,
            plan.build_details,
            drill.build_details,
            verify.build_details,
        ),
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
