"""The sheet of shortcuts, the cases beside this one, and the case's report to print or to keep."""

import asyncio

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import action, heading, note, table
from sightline.app.session.reporting import cases_beside, report_files
from sightline.app.tab.tab import Tab


class Menu:
    """The dialogs of one page."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        with ui.dialog() as self._shortcuts, ui.card().classes("question").props("data-testid=shortcuts-sheet"):
            heading(texts.SHORTCUTS)
            table(texts.SHORTCUT_COLUMNS, texts.SHORTCUT_ROWS, testid="shortcuts-table")
            action(texts.CLOSE, self._shortcuts.close, testid="shortcuts-close", kind="primary")
        with ui.dialog() as self._cases, ui.card().classes("question wide").props("data-testid=cases-sheet"):
            self._listed = ui.element("div")
            action(texts.CLOSE, self._cases.close, testid="cases-close", kind="primary")

    def build(self) -> None:
        """Build the buttons that open the dialogs and save the report."""
        save = self._tab.doing(lambda: save_report(self._tab))
        with ui.element("div").classes("choice"):
            action(texts.REPORT, save, testid="report", kind="small")
            action(texts.CASES, self._tab.doing(self._show_cases), testid="cases", kind="small")
            action(texts.SHORTCUTS_BUTTON, self.show_shortcuts, testid="shortcuts", kind="small")

    def show_shortcuts(self) -> None:
        """Open the sheet of shortcuts."""
        self._shortcuts.open()

    async def _show_cases(self) -> None:
        folder = self._tab.planning.case.folder
        found = await asyncio.to_thread(cases_beside, folder)
        self._listed.clear()
        with self._listed:
            heading(texts.CASES)
            rows = [
                (
                    texts.CASE_HERE.format(number=one.number) if one.folder == folder.resolve() else one.number,
                    f"{one.at:%Y-%m-%d %H:%M}",
                    texts.CASE_REACHED[one.reached],
                    one.folder.name,
                )
                for one in found
            ]
            table(texts.CASE_COLUMNS, rows, testid="cases-table")
            note(texts.CASE_OPEN, kind="quiet")
        self._cases.open()


async def save_report(tab: Tab) -> None:
    """Send the report of the last plan to the browser, as a PDF to print and as a page. Raises SightlineError."""
    planning = tab.planning
    files = await planning.jobs.during(
        texts.WRITING_REPORT, lambda: planning.worker.do(report_files, planning.case.folder)
    )
    for name, data in files.items():
        ui.download.content(data, name)
