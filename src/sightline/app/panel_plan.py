"""The third step: points placed, figures of the implant, and the verdict."""

from collections.abc import Hashable
from itertools import groupby

import numpy as np
from nicegui import ui

from sightline.app.marks import END, ENTRY, Asked, asked_of
from sightline.app.section import Section, action, heading, note, table
from sightline.app.tab import Tab
from sightline.app.texts import IMAGE_LABELS
from sightline.case.views import NAMES
from sightline.planning.kinds import KINDS

_TITLES = {"wire": "Wire", "landmark": "Landmarks: did the bone move?", "aid": "Aids"}
_SHORT = {"pa": "PA", "lateral": "lat"}


def _points_key(tab: Tab) -> Hashable:
    known = tab.procedure.planned
    return (
        tab.procedure.history.revision,
        tab.placing,
        known is None,
        known is not None and "head" in known.anatomy.absent,
    )


def figures_key(tab: Tab) -> Hashable:
    """What the figures show."""
    return tab.known


def build(tab: Tab) -> None:
    """Kind, points, aids."""
    Section(tab, lambda t: t.procedure.decisions.kind, _kind)
    Section(tab, _points_key, _points)


def _kind(tab: Tab) -> None:
    procedure = tab.procedure
    decisions = procedure.decisions
    kinds = {name: kind.name for name, kind in KINDS.items()}

    def choose(event) -> None:
        procedure.choose_kind(event.value)
        tab.go_to(tab.step)

    ui.select(kinds, value=decisions.kind, label="Kind of trajectory", on_change=choose).props(
        "outlined options-dense data-testid=kind"
    )
    note(KINDS[decisions.kind].purpose, kind="quiet")

    def snap(event) -> None:
        procedure.snapping = bool(event.value)
        tab.refresh()

    ui.checkbox("Take lateral points of the wire to their curves", value=procedure.snapping, on_change=snap).props(
        "data-testid=snapping"
    )

    def show(event) -> None:
        tab.show_beads = bool(event.value)
        tab.refresh()

    ui.checkbox("Show the beads", value=tab.show_beads, on_change=show).props("data-testid=show-beads")


def _points(tab: Tab) -> None:
    decisions = tab.procedure.decisions
    for group, listed in groupby(asked_of(decisions.kind), key=lambda one: one.group):
        heading(_TITLES[group])
        for _, same in groupby(listed, key=lambda one: one.of):
            _row(tab, tuple(same))
    if KINDS[decisions.kind].proposal is not None:
        _proposal(tab)


def _row(tab: Tab, same: tuple[Asked, ...]) -> None:
    """One point, or the clicks of one aid."""
    decisions, first = tab.procedure.decisions, same[0]
    label = first.label if len(same) == 1 else first.label.rsplit(" ", 1)[0]
    current = tab.placing is not None and tab.placing[0] in {one.name for one in same}
    with ui.element("div").classes("pick current" if current else "pick").props(f"data-testid=row-{first.of}"):
        ui.label(label).classes("pick-name").tooltip(first.sentence)
        for image in first.images:
            placed = sum(decisions.mark(one.name).at(image) is not None for one in same)
            done = "●" if placed == len(same) else "○"
            count = f" {placed}/{len(same)}" if 0 < placed < len(same) else ""
            ui.label(f"{done} {_SHORT[image]}{count}").classes("placed" if placed == len(same) else "missing")

        def place() -> None:
            tab.place_next(same)
            if tab.placing is None:  # all there: the first is placed anew, the others stay until they are clicked
                tab.place_again(same[0], same[0].images[0])
            tab.refresh()

        action("Place", place, testid=f"place-{first.of}", kind="small")
        if any(one.name in decisions.marks for one in same):
            remove = tab.doing(lambda: tab.procedure.remove(tuple(one.name for one in same)))
            action("✕", remove, testid=f"remove-{first.of}", kind="small").props(f'aria-label="Remove {label}"')


def _proposal(tab: Tab) -> None:
    known = tab.procedure.planned

    def take() -> None:
        assert known is not None  # noqa: S101 - the button is there only then
        proposal = known.proposal()
        decisions = tab.procedure.decisions
        for name, uv in ((ENTRY, proposal.entry_uv_px), (END, proposal.end_uv_px)):
            mark = decisions.mark(name)
            for image, at in zip(NAMES, uv, strict=True):
                mark = mark.placed(image, (float(at[0]), float(at[1])), free=False)
            decisions = decisions.with_mark(name, mark)
        tab.procedure.edit(decisions)
        tab.go_to(tab.step)

    action("Propose a wire from head and shaft", tab.doing(take), testid="propose", enabled=known is not None)
    if known is not None and known.anatomy.absent:
        why = "; ".join(text for name, text in known.anatomy.absent.items() if name in ("head", "shaft", "cortex"))
        if why:
            note(why, kind="quiet")


def build_figures(tab: Tab) -> None:
    """Figures of plan and implant; they follow a point that is dragged."""
    known = tab.known
    if known is None or (known.plan is None and not known.figures):
        return
    heading("Figures")
    rows = []
    if known.plan is not None:
        path = known.plan.trajectory
        if path.points.joint_covariance_mm2 is not None:
            rows += [
                ("entry, 95 % error", f"{path.entry_error_95_mm:.2f} mm", ""),
                ("tip, 95 % error", f"{path.end_error_95_mm:.2f} mm", ""),
                ("direction, 95 % error", f"{np.rad2deg(path.direction_error_95_rad):.2f}°", ""),
            ]
        rows += _gaps(tab)
    if tab.procedure.decisions.side is None:
        note("Confirm the patient's side on the step Images to see figures of the implant.", kind="warn")
    for figure in known.figures:
        if figure.value is not None:
            space = "" if figure.unit == "°" else " "
            sd = "" if figure.sd is None else f" ± {1.96 * figure.sd:.1f}"
            mark = {True: "✓", False: "!", None: ""}[figure.within]
            rows.append((figure.name, f"{figure.value:.1f}{sd}{space}{figure.unit}", mark))
    table(("", "± 95 %", ""), rows, testid="figures")


def _gaps(tab: Tab) -> list[tuple[str, str, str]]:
    known = tab.known
    assert known is not None and known.plan is not None  # noqa: S101
    seen, decisions = known.plan.seen, known.decisions
    landmarks = [a for a in asked_of(decisions.kind) if a.group == "landmark" and decisions.mark(a.name).complete()]
    names = ["entry", "tip", *(a.label for a in landmarks)]
    out = []
    for name, gap, tested in zip(names, seen.gap_mm, seen.gap_tested, strict=True):
        out.append((f"gap of {name}", f"{gap:.2f} mm" if tested else "not tested (snapped)", ""))
    return out


def instruction(tab: Tab) -> str:
    """What to do next, in a sentence."""
    asked = tab.asked
    if asked is None or tab.placing is None:
        return ""
    return f"Click in the {IMAGE_LABELS.get(tab.placing[1], tab.placing[1])}: {asked.label}. {asked.sentence}"
