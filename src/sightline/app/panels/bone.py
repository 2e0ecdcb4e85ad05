"""The optional part of step 2, Calibrate: a CT or mesh of the bone, its landmarks, its pose with error and checks."""

from collections.abc import Hashable
from pathlib import Path
from time import monotonic

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import Section, action, checks, heading, note
from sightline.app.plan.found_bone import FoundBone
from sightline.app.plan.marks import MarkSpec
from sightline.app.session.bone import CT_TYPES, MESH_TYPES, POINT_TYPES
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.app.web.serve import ServedApp
from sightline.app.web.transfers import DropZone, FileTypes, Upload
from sightline.case.views import NAMES
from sightline.common.checks import failed

_FILES = "CT or mesh, and its landmarks"
_TYPES = FileTypes((*CT_TYPES, *MESH_TYPES, *POINT_TYPES), 2, "crop the CT to the bone, or reduce the mesh")


def build(tab: Tab, site: ServedApp) -> None:
    """Build the part, whose drop zone persists while the rest is rebuilt; empty on other steps, and before both views
    are calibrated."""

    async def take(upload: Upload) -> None:
        tab.say("")
        await tab.session.bone.take(upload.data, upload.suffix)

    Section(tab, _is_here, _title)
    zone = DropZone(site.uploads, {_FILES: take}, types=_TYPES)
    taking: bool | None = None

    def show() -> None:
        nonlocal taking
        takes = _is_here(tab) and tab.session.bone.shown is None and not tab.session.jobs.working
        if takes != taking:
            taking = takes
            zone.tell({_FILES: "here"} if takes else {}, {}, {})

    tab.on_refresh.append(show)
    show()
    Section(tab, _key, _status, classes="step-panel")


def _is_here(tab: Tab) -> bool:
    return tab.step is ProcedureStep.CALIBRATE and tab.planning.views() is not None


def _title(tab: Tab) -> None:
    if _is_here(tab):
        heading("Bone (optional)")


def _key(tab: Tab) -> Hashable:
    bone = tab.session.bone
    marks = tuple(tab.planning.decisions.mark(spec.name) for spec in bone.specs)
    return (
        _is_here(tab),
        bone.volume,
        bone.specs,
        bone.found,
        bone.accepted,
        bone.refused,
        tab.session.jobs.working,
        tab.goal,
        marks,
    )


def _status(tab: Tab) -> None:
    bone, jobs = tab.session.bone, tab.session.jobs
    if not _is_here(tab):
        return
    if jobs.working:
        _running(jobs.working, jobs.began)
    elif bone.shown is not None:
        _result(tab, bone.shown)
    elif bone.volume is None:
        note("A CT or mesh of this bone shows most of its movements between the images.", kind="quiet")
    else:
        _begin(tab, bone.volume)


def _running(work: str, began: float) -> None:
    """Build the progress: a registration's end is not known, so it states the time since its start."""
    progress = ui.label().classes("note").props("data-testid=bone-working")
    ui.linear_progress(show_value=False).props("indeterminate")

    def tell() -> None:
        progress.set_text(f"{texts.in_progress(work)} {monotonic() - began:.0f} s")

    tell()
    ui.timer(1.0, tell)


def _begin(tab: Tab, volume: Path) -> None:
    bone = tab.session.bone
    note(f"{'Mesh' if volume.name.endswith(MESH_TYPES) else 'CT'} is here.", kind="good", testid="bone-here")
    if not bone.points:
        note("Without its landmarks (Slicer's .mrk.json, or CSV) all rotations are tried: slower.", kind="quiet")
    for spec in bone.specs:
        _row(tab, spec)
    if bone.refused:
        note(bone.refused, kind="bad", testid="bone-refused")
    kind = "primary" if bone.ready else ""
    action("Register the bone", tab.doing(bone.register), testid="bone-register", kind=kind, enabled=bone.ready)


def _row(tab: Tab, spec: MarkSpec) -> None:
    """Build the row of a landmark."""
    mark, current = tab.planning.decisions.mark(spec.name), tab.goal is not None and tab.goal.spec == spec
    row = ui.element("div").classes(f"pick {'current' if current else ''}")
    with row, action("", lambda: tab.place([spec], NAMES), testid=f"place-{spec.name}", kind="pick-place"):
        ui.label(texts.PLACE_WHAT.format(what="")).classes("unseen")
        ui.label(spec.label).classes("pick-name")
        with ui.element("div").classes("pick-status"):
            for image in NAMES:
                placed = mark.at(image) is not None
                short = texts.image_short(image, tab.planning.decisions.kind)
                ui.label(f"{'●' if placed else '○'} {short}").classes("placed" if placed else "missing")


def _result(tab: Tab, shown: FoundBone) -> None:
    bone, wrong = tab.session.bone, failed(shown.judged)
    note(f"Bone found: {shown.error}.", kind="bad" if wrong else "good", testid="bone-found")
    sentence = texts.sentence(wrong[0]) if wrong else f"All {len(shown.judged)} checks passed"
    note(sentence, kind="bad" if wrong else "good", testid="bone-judged")
    if bone.found is None:
        note("Accepted: its checks are part of the verdict.", kind="quiet", testid="bone-accepted")
        action("Remove", tab.doing(bone.discard), testid="bone-remove")
    else:
        note("Do its green edges lie on the bone in both images?")
        action("Accept", tab.doing(bone.accept), testid="bone-accept", kind="primary")
        action("Discard", tab.doing(bone.discard), testid="bone-discard")


def build_details(tab: Tab) -> None:
    """Build the details: the checks of the pose that is shown."""
    Section(tab, lambda t: t.session.bone.shown, _checks)


def _checks(tab: Tab) -> None:
    if (shown := tab.session.bone.shown) is not None:
        heading("Bone")
        checks(shown.judged, testid="bone-checks")
