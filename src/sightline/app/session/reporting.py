"""The report of a case, and the cases beside it; both read journals without changing them."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sightline.case.journal import Case, Kind
from sightline.case.journal.case import JOURNAL
from sightline.errors import SightlineError

MAX_LISTED = 50  # cases, the newest ones [ours]


@dataclass(frozen=True)
class CaseInFolder:
    """A case: its folder, number, time of the newest entry, and whether a wire is planned, drilled and verified."""

    folder: Path
    number: str
    at: datetime
    reached: Kind


def report_files(folder: Path) -> dict[str, bytes]:
    """Return the report of a case's last plan as a page, by file name. Runs in the worker.

    Raises CaseError if the case holds no plan; also raises the errors of the recomputed stages.
    """
    from sightline.case.report.from_case import report_of
    from sightline.case.report.page import render

    with Case.open(folder, read_only=True) as case:
        made, name = report_of(case), f"report-{case.number}"
    return {f"{name}.html": render(made).encode()}


def cases_beside(folder: Path) -> list[CaseInFolder]:
    """Return the cases in the folder around a case's own, the newest first; those that cannot be read are left out."""
    found = []
    for journal in folder.resolve().parent.glob(f"*/{JOURNAL}"):
        try:
            with Case.open(journal.parent, read_only=True) as case:
                last = case.entries()[-1:]
                reached = [kind for kind in (Kind.VERIFIED, Kind.DRILLED, Kind.PLANNED) if case.latest(kind)]
                if last:
                    here = reached[0] if reached else Kind.ACQUIRED
                    found.append(CaseInFolder(journal.parent, case.number, last[0].at, here))
        except SightlineError:
            continue
    return sorted(found, key=lambda one: one.at, reverse=True)[:MAX_LISTED]
