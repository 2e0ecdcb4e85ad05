"""Recompute a case and compare it with its entries: one outcome per entry."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

from sightline.case.canonical import canonical, digest, plain
from sightline.case.journal import Case, Entry
from sightline.case.journal.entry import versions
from sightline.case.replay.compare import Difference, beyond_stated, differences, largest
from sightline.case.replay.recompute import Recomputed
from sightline.common.checks import Check
from sightline.common.estimator import ESTIMATOR, FIRST
from sightline.errors import SightlineError


class ReplayOutcome(StrEnum):
    """How an entry compares with the result computed now."""

    SAME = "same to the bit"
    CLOSE = "within tolerance, by other versions"
    ESTIMATES = "estimates changed"
    BEYOND = "estimates changed by more than their stated error"
    DIFFERENT = "differs"
    FAILED = "cannot be computed again"
    RECORDED = "recorded, not computed"


@dataclass(frozen=True)
class Replayed:
    """One recomputed entry. `changed`: versions that differ from the entry's, as "name then -> now"; `differences`: of
    the result, the largest first; `reason`: why it FAILED, or which value is BEYOND."""

    entry: Entry
    outcome: ReplayOutcome
    changed: tuple[str, ...] = ()
    differences: tuple[Difference, ...] = ()
    reason: str = ""

    @property
    def passed(self) -> bool:
        """Whether the entry agrees with its recomputation as far as can be expected."""
        return self.outcome not in (ReplayOutcome.BEYOND, ReplayOutcome.DIFFERENT, ReplayOutcome.FAILED)

    @property
    def said(self) -> str:
        """The outcome in words; if estimates changed, with the estimator versions that changed them."""
        changed = self.outcome in (ReplayOutcome.ESTIMATES, ReplayOutcome.BEYOND)
        return f"{self.outcome} in {_since(self.entry)}" if changed else str(self.outcome)


def replay(case: Case) -> Iterator[Replayed]:
    """Recompute every entry of a case from the originals, in order."""
    again = Recomputed(case)
    for entry in case.entries():
        yield _replayed(entry, again)


def judge(replayed: Sequence[Replayed]) -> Check:
    """Return the check "case replay" of docs/refusals.md."""
    bad = [entry for entry in replayed if not entry.passed]
    computed = [entry for entry in replayed if entry.outcome is not ReplayOutcome.RECORDED]
    same = sum(entry.outcome is ReplayOutcome.SAME for entry in computed)
    sentence = f"Of {len(computed)} computed entries {same} are the same to the bit"
    if close := sum(entry.outcome is ReplayOutcome.CLOSE for entry in computed):
        sentence += f", {close} within the tolerances, by other versions"
    if moved := [entry for entry in computed if entry.outcome is ReplayOutcome.ESTIMATES]:
        sentence += f"; of {len(moved)} the {moved[0].said}, {_by_at_most(moved)}"
    if bad:
        sentence += f"; entry {bad[0].entry.number} ({bad[0].entry.kind}) {bad[0].said}"
        sentence += f": {bad[0].reason}" if bad[0].reason else ""
    return Check("case replay", not bad, float(len(bad)), 0.0, "entries", sentence + ".")


def _replayed(entry: Entry, again: Recomputed) -> Replayed:
    try:
        now = again.content(entry)
    except (SightlineError, KeyError, ValueError) as error:  # the last two: another program recorded the entry
        reason = str(error) if isinstance(error, SightlineError) else "its content is not what this stage records"
        return Replayed(entry, ReplayOutcome.FAILED, _changed(entry), reason=reason)
    if now is None:
        return Replayed(entry, ReplayOutcome.RECORDED)
    text = canonical(now)
    changed = _changed(entry)
    if digest(text) == entry.content_sha256:
        return Replayed(entry, ReplayOutcome.SAME, changed)
    changes = differences(entry.content, text)
    reason = ""
    if not changes or (changed and all(change.close for change in changes)):
        outcome = ReplayOutcome.CLOSE
    # A new estimator may change every result but the pixels, which are read and not estimated.
    elif _estimator(entry) != ESTIMATOR and all(change.where != "pixels_sha256" for change in changes):
        reason = beyond_stated(entry.content, plain(now))
        outcome = ReplayOutcome.BEYOND if reason else ReplayOutcome.ESTIMATES
    else:
        outcome = ReplayOutcome.DIFFERENT
    return Replayed(entry, outcome, changed, changes, reason)


def _estimator(entry: Entry) -> int:
    stated = entry.versions.get("estimator", "")
    return int(stated) if stated.isdecimal() else FIRST


def _since(entry: Entry) -> str:
    """Return the estimator versions between the entry's and the present one, in words."""
    low, high = sorted((_estimator(entry), ESTIMATOR))
    return f"version {high}" if high == low + 1 else f"versions {low + 1} to {high}"


def _by_at_most(replayed: Sequence[Replayed]) -> str:
    """Return the largest changes of pixels and lengths with their places, and the changed verdicts, in words."""
    largest_changes = []
    for unit in ("px", "mm"):
        tops = [(top, entry) for entry in replayed if (top := largest(entry.differences, unit)) is not None]
        if tops:
            top, entry = max(tops, key=lambda pair: pair[0].by or 0.0)
            largest_changes.append(f"{top.by:.2g} {unit} (entry {entry.entry.number}, {top.where})")
    words = (
        f"by at most {' and '.join(largest_changes)}" if largest_changes else "without a change of pixels or lengths"
    )
    other = [entry.entry.number for entry in replayed if any(d.where in ("go", "verdict") for d in entry.differences)]
    return f"{words}; another verdict in entry {', '.join(map(str, other))}" if other else words


def _changed(entry: Entry) -> tuple[str, ...]:
    then, now = entry.versions, versions()
    names = sorted(then.keys() | now.keys())
    return tuple(
        f"{name} {then.get(name, 'none')} -> {now.get(name, 'none')}"
        for name in names
        if then.get(name) != now.get(name)
    )
