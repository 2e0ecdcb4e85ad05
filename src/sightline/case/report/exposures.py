"""The exposures of a procedure whose images were kept."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from sightline.case.journal import Case, Entry, Kind
from sightline.case.journal.originals import short
from sightline.case.stages import acquired_of
from sightline.case.views import CalibratedImage, spoken
from sightline.planning.check.shot import ALIGNED, PAUSED
from sightline.planning.procedures import Procedure

NOTE = (
    "Exposures whose images were kept. Other exposures, such as live images and those to position patient and C-arm, "
    "are not known here, and neither is the dose."
)
PLANNING, CHECK, UNUSED = "planning", "check shot", "not used for this plan"
WHILE_DRILLING = {ALIGNED: "confirmation shot", PAUSED: "second shot"}


@dataclass(frozen=True)
class KeptExposure:
    """An exposure whose image was kept. `image`: the first digits of its hash. `at`: UTC, when it was kept; None
    outside a case. `frames`: the number of frames exposed for it, in a run or an average."""

    image: str
    used: str
    at: str | None = None
    frames: int = 1


def of_images(images: Iterable[CalibratedImage], used: str, kind: Procedure) -> tuple[KeptExposure, ...]:
    """Return the exposures of images outside a case."""
    return tuple(KeptExposure(image.seen.source, f"{used}, {spoken(image.name, kind)} view") for image in images)


def of_case(case: Case, plan: Entry, kind: Procedure | None = None) -> tuple[KeptExposure, ...]:
    """Return all exposures of a case in order, and the use of each in a plan and its check shot. `kind`: of the plan,
    whose names the views get.

    Images with the same pixels, from the same file or under another header, count as one exposure.
    """
    uses = dict(_uses(case, plan, kind))
    found: dict[str, KeptExposure] = {}
    by_file: dict[str, str] = {}
    for entry in case.entries(Kind.ACQUIRED):
        acquisition = entry.settings.get("acquisition") or {}
        frames = int(acquisition.get("frames") or acquisition.get("averaged") or 1)
        pixels = str(entry.content.get("pixels_sha256", f"{entry.number}"))
        known = by_file.setdefault(entry.content["original"], pixels)
        used = uses.get(entry.number)
        before = found.get(known)
        if before is None or (used is not None and before.used == UNUSED):
            at = before.at if before else f"{entry.at:%Y-%m-%d %H:%M:%S}"
            found[known] = KeptExposure(short(entry.content["original"]), used or UNUSED, at, frames)
    return tuple(found.values())


def _uses(case: Case, plan: Entry, kind: Procedure | None) -> Iterator[tuple[int, str]]:
    """Yield numbers of acquired entries, and what their images were used for."""
    uses = [(PLANNING, plan.rests_on)]
    uses += [(CHECK, one.rests_on[1:]) for one in _of_plan(case, Kind.VERIFIED, plan)]
    for one in _of_plan(case, Kind.SHOT, plan):
        state = ALIGNED if one.content["asked"]["straight"] else PAUSED
        uses.append((WHILE_DRILLING[state], one.rests_on[1:]))
    for what, views in reversed(uses):
        for number in views:
            view = case.entry(number)
            yield acquired_of(case, view).number, f"{what}, {spoken(view.content['view'], kind)} view"


def _of_plan(case: Case, kind: Kind, plan: Entry) -> list[Entry]:
    return [one for one in case.entries(kind) if one.rests_on[:1] == (plan.number,)]
