"""A case computed again and held against what was recorded: one outcome for each entry."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

from sightline.case.canonical import canonical, digest, plain
from sightline.case.journal import Case, Entry
from sightline.case.journal.entry import versions
from sightline.case.replay.compare_json import Difference, differences, largest
from sightline.case.replay.recompute import Recomputed
from sightline.case.replay.stated_error import beyond_stated
from sightline.checks import Check
from sightline.errors import SightlineError
from sightline.estimator import ESTIMATOR, FIRST


class Outcome(StrEnum):
    """How an entry compares with what is computed now."""

    SAME = "same to the bit"
    CLOSE = "within tolerance, by other versions"
    ESTIMATES = "estimates changed"
    BEYOND = "estimates changed by more than their stated error"
    DIFFERENT = "differs"
    FAILED = "cannot be computed again"
    RECORDED = "recorded, not computed"


@dataclass(frozen=True)
class Replayed:
    """One entry, computed again. `changed`: versions that are not those of the entry, as "name then -> now";
    `differences`: where the result is another, the largest first; `reason`: why it FAILED, or what is BEYOND."""

    entry: Entry
    outcome: Outcome
    changed: tuple[str, ...] = ()
    differences: tuple[Difference, ...] = ()
    reason: str = ""

    @property
    def passed(self) -> bool:
        """True unless something speaks against the entry."""
        return self.outcome not in (Outcome.BEYOND, Outcome.DIFFERENT, Outcome.FAILED)

    @property
    def said(self) -> str:
        """The outcome in words; where estimates changed, with the estimator's versions that changed them."""
        changed = self.outcome in (Outcome.ESTIMATES, Outcome.BEYOND)
        return f"{self.outcome} in {_since(self.entry)}" if changed else str(self.outcome)


def replay(case: Case) -> Iterator[Replayed]:
    """Every entry of a case in order, computed again from the originals."""
    again = Recomputed(case)
    for entry in case.entries():
        yield _replayed(entry, again)


def judge(replayed: Sequence[Replayed]) -> Check:
    """The check of docs/refusals.md, "case replay"."""
    bad = [one for one in replayed if not one.passed]
    computed = [one for one in replayed if one.outcome is not Outcome.RECORDED]
    same = sum(one.outcome is Outcome.SAME for one in computed)
    sentence = f"Of {len(computed)} computed entries {same} are the same to the bit"
    if close := sum(one.outcome is Outcome.CLOSE for one in computed):
        sentence += f", {close} within the tolerances, by other versions"
    if moved := [one for one in computed if one.outcome is Outcome.ESTIMATES]:
        sentence += f"; of {len(moved)} the {moved[0].said}, {_by_at_most(moved)}"
    if bad:
        sentence += f"; entry {bad[0].entry.number} ({bad[0].entry.kind}) {bad[0].said}"
        sentence += f": {bad[0].reason}" if bad[0].reason else ""
    return Check("case replay", not bad, float(len(bad)), 0.0, "entries", sentence + ".")


def _replayed(entry: Entry, again: Recomputed) -> Replayed:
    try:
        now = again.content(entry)
    except (SightlineError, KeyError, ValueError) as error:  # the last two: an entry that no stage of ours recorded
        reason = str(error) if isinstance(error, SightlineError) else "its content is not what this stage records"
        return Replayed(entry, Outcome.FAILED, _changed(entry), reason=reason)
    if now is None:
        return Replayed(entry, Outcome.RECORDED)
    text = canonical(now)
    changed = _changed(entry)
    if digest(text) == entry.content_sha256:
        return Replayed(entry, Outcome.SAME, changed)
    found = differences(entry.content, text)
    reason = ""
    if changed and all(one.close for one in found):
        outcome = Outcome.CLOSE
    elif _estimator(entry) != ESTIMATOR and all(one.where != "pixels_sha256" for one in found):  # no estimate
        reason = beyond_stated(entry.content, plain(now))
        outcome = Outcome.BEYOND if reason else Outcome.ESTIMATES
    else:
        outcome = Outcome.DIFFERENT
    return Replayed(entry, outcome, changed, found, reason)


def _estimator(entry: Entry) -> int:
    stated = entry.versions.get("estimator", "")
    return int(stated) if stated.isdecimal() else FIRST


def _since(entry: Entry) -> str:
    """The versions in which the estimates became others than the entry's."""
    low, high = sorted((_estimator(entry), ESTIMATOR))
    return f"version {high}" if high == low + 1 else f"versions {low + 1} to {high}"


def _by_at_most(replayed: Sequence[Replayed]) -> str:
    """The largest changes of pixels and lengths, each with its place, and verdicts that changed."""
    said = []
    for unit in ("px", "mm"):
        tops = [(top, one) for one in replayed if (top := largest(one.differences, unit)) is not None]
        if tops:
            top, one = max(tops, key=lambda pair: pair[0].by or 0.0)
            said.append(f"{top.by:.2g} {unit} (entry {one.entry.number}, {top.where})")
    words = f"by at most {' and '.join(said)}" if said else "without a change of pixels or lengths"
    other = [one.entry.number for one in replayed if any(d.where in ("go", "verdict") for d in one.differences)]
    return f"{words}; another verdict in entry {', '.join(map(str, other))}" if other else words


def _changed(entry: Entry) -> tuple[str, ...]:
    then, now = entry.versions, versions()
    names = sorted(then.keys() | now.keys())
    return tuple(
        f"{name} {then.get(name, 'none')} -> {now.get(name, 'none')}"
        for name in names
        if then.get(name) != now.get(name)
    )
