"""The chooser of the current wire, where a procedure has several, with the state of each."""

from collections.abc import Callable, Hashable
from functools import partial

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import PersistentSection, Section, action, note
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.planning.procedures import kind as kind_of

_BEFORE = (ProcedureStep.IMAGES, ProcedureStep.CALIBRATE)  # steps before wires are planned


def build(tab: Tab) -> None:
    """Build the chooser, whose buttons persist while states change, and the order of drilling below it."""
    Section(tab, _listed, _listed_wires)
    Section(tab, lambda t: (t.step, t.planning.kinds, t.planning.drilling_order), _order)


def _listed(tab: Tab) -> tuple[str, ...]:
    """Return the wires to choose from; none for a single wire, and before they are planned."""
    kinds = tab.planning.kinds
    return () if len(kinds) == 1 or tab.step in _BEFORE else kinds


def _listed_wires(tab: Tab) -> None:
    if _listed(tab):
        PersistentSection(tab, _states, _chooser)


def _states(tab: Tab) -> Hashable:
    return tab.planning.decisions.kind, tuple((kind, state(tab, kind)) for kind in tab.planning.kinds)


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


def _chooser(tab: Tab) -> Callable[[], None]:
    """Build a button for each wire of the procedure, and return what updates them."""
    made: dict[str, tuple[ui.button, ui.label]] = {}
    with ui.element("div").classes("wires").props('role=group aria-label="Wires of the procedure"'):
        for kind in tab.planning.kinds:
            wire = kind_of(kind).wire
            name = texts.titled(wire.name).removesuffix(" wire")
            with action(name, partial(tab.choose_kind, kind), testid=f"wire-{wire.key}", kind="small") as button:
                made[kind] = button, ui.label().classes("wire-state unseen")

    states = " ".join(("here", *(f"wire-{one}" for one in texts.WIRE_STATES)))

    def update() -> None:
        for kind, (button, label) in made.items():
            here, now = kind == tab.planning.decisions.kind, state(tab, kind)
            button.classes(f"wire-{now} {'here' if here else ''}", remove=states)
            button.props(f"aria-pressed={'true' if here else 'false'}")
            label.set_text(texts.WIRE_STATES[now])

    return update


def _order(tab: Tab) -> None:
    """Build the sentence on the order of drilling, on the step Drill; nothing where there is none."""
    found = tab.planning.drilling_order
    if tab.step is ProcedureStep.DRILL and found is not None and len(tab.planning.kinds) > 1:
        names = {kind_of(kind).wire.key: kind_of(kind).wire.name for kind in tab.planning.kinds}
        said = ", then the ".join(names[key] for key in found.keys)
        note(
            f"Drill the {said}: so the wires in the bone hide the fewest beads.", kind="quiet", testid="drilling-order"
        )


def following(tab: Tab) -> str | None:
    """Return the wire to drill next, in the proposed order; None where all are drilled."""
    planning = tab.planning
    order = () if planning.drilling_order is None else planning.drilling_order.keys
    kinds = [kind for key in order for kind in planning.kinds if kind_of(kind).wire.key == key]
    return next((kind for kind in kinds if kind not in planning.all_drilled), None)


def build_following(tab: Tab) -> None:
    """Build the button that leads to the wire to drill next."""
    after = following(tab)
    assert after is not None  # noqa: S101 - it is asked before

    async def follow() -> None:
        await tab.choose_kind(after)
        if tab.step is not ProcedureStep.DRILL:
            tab.go_to(ProcedureStep.DRILL)

    said = f"Next: {kind_of(after).wire.name}"
    action(said, follow, testid="next-wire", kind="primary")
