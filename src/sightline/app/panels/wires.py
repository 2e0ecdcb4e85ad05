"""The chooser of the current wire, where a procedure has several, with the state of each."""

from collections.abc import Hashable
from functools import partial

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import action, note
from sightline.app.tab.step import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.planning.procedures import kind as kind_of


def key(tab: Tab) -> Hashable:
    """Return the key of the chooser: the current wire, and the state of each."""
    planning = tab.planning
    return planning.decisions.kind, tuple((kind, state(tab, kind)) for kind in planning.kinds), planning.drilling_order


def state(tab: Tab, kind: str) -> str:
    """Return the state of a wire, as a key of `texts.WIRE_STATES`."""
    planning, shot = tab.planning, tab.session.verifying.shots.get(kind)
    if shot is not None:
        return "verified" if shot.passed else "refuted"
    if kind in tab.session.verifying.refusals:
        return "refuted"
    if kind in planning.all_drilled:
        return "drilled"
    plan = None if tab.known is None else tab.known.plans.get(kind)
    held = tab.session.drilling.held
    if plan is not None and held is not None and held is planning.all_sent.get(kind):
        return "sent"
    return "missing" if plan is None else plan.verdict.state


def build(tab: Tab) -> None:
    """Build a button for each wire of the procedure; nothing for a single wire, and before they are planned."""
    if len(tab.planning.kinds) == 1 or tab.step in (ProcedureStep.IMAGES, ProcedureStep.CALIBRATE):
        return
    with ui.element("div").classes("wires").props(f'role=group aria-label="{texts.WIRES_LABEL}"'):
        for kind in tab.planning.kinds:
            wire, here, now = kind_of(kind).wire, kind == tab.planning.decisions.kind, state(tab, kind)
            name = texts.titled(texts.word(wire.name)).removesuffix(texts.WIRE_SUFFIX)
            button = action(name, partial(tab.choose_kind, kind), testid=f"wire-{wire.key}", kind="small")
            button.classes(f"wire-{now} {'here' if here else ''}").props(f"aria-pressed={'true' if here else 'false'}")
            with button:
                ui.label(texts.WIRE_STATES[now]).classes("wire-state unseen")
    order = tab.planning.drilling_order
    if tab.step is ProcedureStep.DRILL and order is not None:
        names = {kind_of(kind).wire.key: texts.word(kind_of(kind).wire.name) for kind in tab.planning.kinds}
        said = texts.DRILLING_ORDER.format(wires=texts.WIRES_THEN.join(names[key] for key in order.keys))
        note(said, kind="quiet", testid="drilling-order")


def following(tab: Tab) -> str | None:
    """Return the wire to drill next, in the proposed order; None where all are drilled."""
    planning = tab.planning
    order = () if planning.drilling_order is None else planning.drilling_order.keys
    kinds = [kind for key in order for kind in planning.kinds if kind_of(kind).wire.key == key]
    return next((kind for kind in kinds if kind not in planning.all_drilled), None)
