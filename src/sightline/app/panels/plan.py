"""Step 3, Plan: placing points, metrics of plan and implant, proposal."""

from collections.abc import Hashable, Mapping
from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from nicegui import ui

from sightline.app import texts
from sightline.app.panels.images import build_kind, build_oblique
from sightline.app.panels.section import (
    HtmlSection,
    Section,
    action,
    decided,
    heading,
    heading_html,
    joined,
    note,
    note_html,
    shown_or_not,
    table_html,
)
from sightline.app.panels.steps import aid_labels
from sightline.app.plan.decisions import HEAD, NECK, SHAFT
from sightline.app.plan.marks import MarkSpec, label_of
from sightline.app.plan.planner import (
    Planned,
    has_borders,
    has_borders_of,
    has_head,
    landmarks_of,
    lowest_wire,
    proposed,
)
from sightline.app.session.planning import kept_as_drawn
from sightline.app.tab.tab import Tab
from sightline.app.texts import image_short, in_image
from sightline.case.views import NAMES, OBLIQUE
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.errors import UnusableInputError
from sightline.planning.nail.files import known_nails
from sightline.planning.nail.result import perfect_circles
from sightline.planning.procedures import kind as kind_of


def build(tab: Tab) -> None:
    """Build the panel: kind, and the checklist of points and aids."""
    build_kind(tab)
    Section(tab, lambda t: (t.planning.decisions.kind, t.planning.decisions.nail, t.planning.implanted), _nail)
    Section(tab, _points_key, _points, classes="checklist")
    HtmlSection(tab, lambda t: t.known, _turns_html)
    HtmlSection(tab, lambda t: t.known, _kept_html)


def build_details(tab: Tab) -> None:
    """Build the details: what the procedure is, what is shown, and the metrics."""
    Section(tab, lambda t: t.planning.decisions.kind, _purpose)
    build_oblique(tab)
    Section(
        tab,
        lambda t: t.planning.decisions.snapping,
        lambda t: decided(t, "Snap points of the wire to their curves", "snapping"),
    )
    Section(tab, lambda t: (t.planning.decisions.borders, has_borders(t.planning.decisions)), _borders)
    shown_or_not(tab, "Show the beads", "show_beads")
    if kind_of(tab.planning.decisions.kind).proposal is not None:
        Section(tab, _missing, _lacking)
    HtmlSection(tab, lambda t: t.known, _fitted_html)
    HtmlSection(tab, lambda t: t.known, metrics_html)


def _purpose(tab: Tab) -> None:
    known = kind_of(tab.planning.decisions.kind)
    heading(texts.titled(known.name))
    note(known.purpose, kind="quiet")


def _turns_html(tab: Tab) -> Markup:
    """Return how to turn the C-arm until the current hole is a circle, as HTML; empty without a measured hole."""
    plan = None if tab.known is None else tab.known.plan
    if plan is None or plan.hole is None:
        return Markup()
    turns = [
        (
            f"{image_short(turn.view, tab.planning.decisions.kind)} orbit "
            f"{round(np.rad2deg(turn.orbit_rad)) + 0.0:+.0f}°, tilt "
            f"{round(np.rad2deg(turn.tilt_rad)) + 0.0:+.0f}°"
        )
        for turn in perfect_circles(plan.hole, plan.views)
    ]
    return note_html("Perfect circle, turn the C-arm: " + "; ".join(turns) + ".", kind="quiet", testid="turns")


class _Fit(NamedTuple):
    """An aid that was fitted to edges; `error`: as in its row; `kept`: why an image's drawing was kept, by view."""

    key: str
    error: str
    sentence: str
    kept: Mapping[str, str]


def _fits(known: Planned | None) -> list[_Fit]:
    """Return the aids that are fitted, with their 95 % errors."""
    if known is None:
        return []
    fits: list[_Fit] = []
    fitted = known.decisions.fitted_head if has_head(known.decisions) else None
    head = None if fitted is None else known.anatomy.head
    if fitted is not None and head is not None and head.covariance_mm2 is not None:
        centre, radius = _worst(head.covariance_mm2[:3, :3]), _worst(head.covariance_mm2[3:, 3:])
        sentence = f"Head fitted: radius {head.radius_mm:.1f} ± {radius:.1f} mm, centre ± {centre:.1f} mm (95 %)."
        fits.append(_Fit(HEAD, f"± {centre:.1f} mm", sentence, fitted.kept))
    for key, text in ((SHAFT, "Shaft"), (NECK, "Neck")):
        lines = known.fitted_axis(key)
        axis = None if lines is None else known.anatomy.shaft if key == SHAFT else known.anatomy.neck
        if lines is None or axis is None:
            continue
        turned, offset = axis.direction_covariance_rad2, axis.offset_covariance_mm2
        if turned is None or offset is None:
            continue
        error = f"± {np.rad2deg(_worst(turned)):.1f}°"
        sentence = f"{text} fitted: {error}, ± {_worst(offset):.1f} mm (95 %)."
        fits.append(_Fit(key, error, sentence, lines.kept))
    return fits


def _worst(covariance: np.ndarray) -> float:
    """Return the 95 % error in the direction in which it is largest."""
    return TWO_SIDED_95 * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def _fitted_html(tab: Tab) -> Markup:
    """Return the fitted aids with their 95 % errors as HTML; empty without a fit."""
    return joined(*(note_html(fit.sentence, kind="quiet", testid=f"{fit.key}-fitted") for fit in _fits(tab.known)))


def _kept_html(tab: Tab) -> Markup:
    """Return which image's drawing of a fitted aid was kept, and why, as HTML; empty where all were fitted."""
    kept = (sentence for fit in _fits(tab.known) for sentence in kept_as_drawn(fit.kept))
    return joined(*(note_html(sentence, kind="quiet", testid="kept") for sentence in kept))


def _nail(tab: Tab) -> None:
    """Build the choice of the nail, for a procedure through its holes."""
    decisions = tab.planning.decisions
    if not kind_of(decisions.kind).document.through_holes:
        return
    files, chosen = known_nails(), decisions.nail
    known = {key: file.nail for key, file in files.items()}
    names = {"": "No nail: points by hand", **{key: f"Nail: {file.name}" for key, file in files.items()}}
    shown = "" if chosen is None else next((key for key, nail in known.items() if nail == chosen), "other")
    if chosen is not None and shown == "other":  # its file is elsewhere
        known[shown], names[shown] = chosen, f"Nail: {chosen.diameter_mm:g} mm, {chosen.material}, of this case"

    ui.select(
        names,
        value=shown,
        on_change=lambda event: tab.choose(replace(tab.planning.decisions, nail=known.get(event.value))),
    ).classes("kind").props('dense options-dense data-testid=nail aria-label="Nail"')
    if chosen is not None and (named := _implanted(tab)) and chosen != tab.planning.implanted:
        note(f"The simulated patient has this nail: {named}.", kind="quiet", testid="nail-implanted")


def _implanted(tab: Tab) -> str:
    """Return the name of the simulated patient's nail; empty without one."""
    own = tab.planning.implanted
    if own is None:
        return ""
    return next(
        (file.name for file in known_nails().values() if file.nail == own), f"{own.diameter_mm:g} mm, {own.material}"
    )


def _borders(tab: Tab) -> None:
    if has_borders(tab.planning.decisions):
        decided(tab, "Draw axes by both borders of the bone", "borders")


def _points_key(tab: Tab) -> Hashable:
    decisions = tab.planning.decisions
    return decisions.kind, decisions.of_nail, decisions.borders


def _points(tab: Tab) -> None:
    decisions = tab.planning.decisions
    for group, listed in groupby(tab.planning.specs, key=lambda spec: spec.group):
        with ui.element("div").classes(f"group {group}"):
            if group in texts.POINT_GROUPS:  # a nail is named by its choice above, the robot's wire by its row
                heading(texts.POINT_GROUPS[group])
            if group == "aid" and lowest_wire(kind_of(decisions.kind).document) is not None:
                others = tab.doing(tab.planning.propose_others)
                action(texts.PROPOSE_OTHERS, others, testid="propose-others", kind="small")
            if group == "aid" and kind_of(decisions.kind).proposal is not None:
                action("Propose wire", tab.doing(lambda: _propose(tab)), testid="propose", kind="small").props(
                    'title="Propose a wire from the drawn aids"'
                )
            if group == "aid" and has_head(decisions):
                fit = action("Fit head", tab.doing(lambda: tab.planning.fit(HEAD)), testid="fit-head", kind="small")
                fit.props('title="Fit the drawn circles of the femoral head to its edges in both images"')
        for _, same in groupby(listed, key=lambda spec: spec.of):
            _row(tab, tuple(same))


def _row(tab: Tab, same: tuple[MarkSpec, ...]) -> None:
    """Build the row of one point, or of one aid's clicks. Its buttons persist, so that a refresh does not lose
    clicks."""
    first, names = same[0], tuple(spec.name for spec in same)
    label = label_of(same)

    def images_of(t: Tab) -> tuple[str, ...]:
        return tuple(image for image in t.planning.names if first.shown_in(image))

    def placed(t: Tab) -> tuple[int, ...]:
        """Return the number of clicks in each image."""
        marks = [t.planning.decisions.mark(name) for name in names]
        return tuple(sum(mark.at(image) is not None for mark in marks) for image in images_of(t))

    def current(t: Tab) -> bool:
        return t.goal is not None and t.goal.spec.name in names

    def fitted(t: Tab) -> str:
        return next((fit.error for fit in _fits(t.known) if fit.key == first.of), "")

    def show(t: Tab) -> None:
        row.classes(add="current" if current(t) else "", remove="" if current(t) else "current")
        remove.set_visibility(any(placed(t)))
        if error := fitted(t):
            ui.label(error).classes("placed")
        for image, count in zip(images_of(t), placed(t), strict=True):
            whole = count == len(same)
            part = f" {count}/{len(same)}" if 0 < count < len(same) else ""
            ui.label(f"{'●' if whole else '○'} {image_short(image, t.planning.decisions.kind)}{part}").classes(
                "placed" if whole else "missing"
            )

    with ui.element("div").classes("pick").props(f"data-testid=row-{first.of}") as row:
        with action("", lambda: tab.place(same), testid=f"place-{first.of}", kind="pick-place"):
            ui.label(texts.PLACE_WHAT.format(what="")).classes("unseen")
            ui.label(label).classes("pick-name")
            status = ui.element("div")
            ui.tooltip(first.sentence).props('anchor="center left" self="center right"')
        fits = {
            SHAFT: "Fit the drawn borders of the shaft to its edges in both images",
            NECK: "Fit the neck's axis, from the head's centre, to the neck's edges in both images",
        }
        if first.of in fits and has_borders_of(tab.planning.decisions, first.of):
            fit = tab.doing(lambda: tab.planning.fit(first.of))
            what = fits[first.of]
            action("Fit", fit, testid=f"fit-{first.of}", kind="small to-edges").props(
                f'title="{what}" aria-label="{what}"'
            )
        remove = action("✕", tab.doing(lambda: tab.planning.remove(names)), testid=f"remove-{first.of}", kind="small")
        remove.props(f'aria-label="{f"Remove {label}"}"')
    with status:
        Section(tab, lambda t: (placed(t), current(t), fitted(t)), show, classes="pick-status")


def _propose(tab: Tab) -> None:
    known = tab.planning.planned
    if known is None:
        raise UnusableInputError("calibrate both views before a wire can be proposed")
    decisions = tab.planning.decisions
    ends = proposed(decisions.ends(decisions.kind), known.proposal())
    tab.planning.edit(decisions.with_ends(decisions.kind, ends))
    tab.go_to(tab.step)


def _lacking(tab: Tab) -> None:
    """Build what a proposal still needs; nothing where it can be made."""
    if missing := _missing(tab):
        note("To propose a wire, draw these aids too:", kind="quiet")
        note(f"{texts.titled(missing)}.", kind="quiet", testid="propose-needs")


def _missing(tab: Tab) -> str:
    """Return what a proposal still needs, as text."""
    known = tab.planning.planned
    rule = None if known is None else known.kind.proposal
    if known is None or rule is None:
        return ""
    lacking = rule.lacking(known.anatomy)
    refused = [known.anatomy.why_absent(name) for name in lacking if not known.anatomy.undrawn(name)]
    return "; ".join((*aid_labels(known.kind, [name for name in lacking if known.anatomy.undrawn(name)]), *refused))


def metrics_html(tab: Tab) -> Markup:
    """Return the errors of the plan and the metrics of the implant as HTML; empty where there are neither."""
    known = tab.known
    if known is None or (known.plan is None and not known.metrics):
        return Markup()
    rows = []
    if known.plan is not None:
        path = known.plan.trajectory
        if path.error_stated:
            rows += [
                ("entry, 95 % error", f"{path.entry_error_95_mm:.2f} mm", ""),
                ("tip, 95 % error", f"{path.end_error_95_mm:.2f} mm", ""),
                ("direction, 95 % error", f"{np.rad2deg(path.direction_error_95_rad):.2f}°", ""),
            ]
        rows += _gaps(tab)
    notes = [note_html(why, kind="bad", testid="metrics-refused") for why in _refused(known)]
    if known.plan is not None:
        notes += [note_html(sentence, kind="quiet", testid="along") for sentence in known.plan.sentences()]
    if tab.planning.decisions.side is None:
        notes.insert(
            0,
            note_html("Confirm the patient's side on the step Images to see measurements of the implant.", kind="warn"),
        )
    for metric in known.metrics:
        if metric.value is not None:
            space = "" if metric.unit == "°" else " "
            sd = "" if metric.sd is None else f" ± {TWO_SIDED_95 * metric.sd:.1f}"
            mark = {True: "✓", False: "!", None: ""}[metric.within]
            rows.append((metric.name, texts.unsigned(f"{metric.value:.1f}") + f"{sd}{space}{metric.unit}", mark))
    table = table_html(("", "± 95 %", ""), rows, testid="metrics")
    return joined(heading_html("Measurements"), *notes, table)


def _refused(known: Planned) -> list[str]:
    """Return the reasons for missing metrics whose parts of the bone are all located, each reason once."""
    return list(dict.fromkeys(one.sentence for one in known.metrics if one.value is None and one.located))


def _gaps(tab: Tab) -> list[tuple[str, str, str]]:
    known = tab.known
    assert known is not None and known.plan is not None  # noqa: S101
    seen, decisions = known.plan.seen, known.decisions
    landmarks = landmarks_of(decisions, len(known.views))
    names = ["entry", "tip", *(a.label[:1].lower() + a.label[1:] for a in landmarks)]
    rows = []
    for name, gap, tested in zip(names, seen.gap_mm, seen.gap_tested, strict=True):
        rows.append((f"gap of {name}", f"{gap:.2f} mm" if tested else "not tested (snapped)", ""))
    return rows


def instruction(tab: Tab) -> tuple[str, str, str] | None:
    """Return the instruction for the next point: its number of all, its image, and what to do there; None without
    one."""
    goal = tab.goal
    if goal is None:
        return None
    number, count = tab.progress
    decisions, spec = tab.planning.decisions, goal.spec
    slides = (
        spec.group == "wire" and goal.image == NAMES[1] and decisions.snapping and decisions.mark(spec.name).at("pa")
    )
    if goal.image == OBLIQUE:
        todo = "click where this image shows it; the cross is where the other two expect it"
    else:
        todo = "slide along its curve and click" if slides else spec.sentence
    instruction = f"{spec.label}: {todo}"
    if number == 1 and spec.group == "wire" and kind_of(decisions.kind).document.through_holes:
        named = _implanted(tab)
        instruction = (
            f"Choose the nail on the right; the simulated patient has {named}. Or by hand: {instruction}"
            if named
            else f"Choose the nail on the right. Or by hand: {instruction}"
        )
    return f"{number} of {count}", in_image(goal.image, decisions.kind), instruction
