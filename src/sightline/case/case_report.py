"""From a case to the report of its last plan."""

from sightline.case.entry import Kind
from sightline.case.journal import Case
from sightline.case.recompute import Recomputed
from sightline.case.report import Report
from sightline.case.stages import frame_of
from sightline.errors import CaseError


def report_of(case: Case) -> Report:
    """The report of the last plan, made from the originals: its images are called by their originals' names.

    Raises CaseError where there is no plan, and what the stages raise.
    """
    entry = case.latest(Kind.PLANNED)
    if entry is None:
        raise CaseError("the case holds no plan yet; plan first, then report")
    again = Recomputed(case)
    views = [case.entry(number) for number in entry.rests_on]
    first, second = (again.calibrated(view) for view in views)
    return Report(
        title=f"Case {case.number}",
        frame=frame_of(case, views[0].settings["frame"]),
        images=(first, second),
        plan=again.plan(entry),
        provenance={
            "case": f"{case.number}, entry {entry.number} of {case.last}",
            "planned": f"{entry.at:%Y-%m-%d %H:%M} UTC, by {entry.by}",
            "journal": f"the chain of entries is {entry.chain[:16]} at entry {entry.number}",
        },
    )
