"""Steps 1 and 2, Images and Calibrate: both images, the patient's side, the frame's serial; the quality of each view's
calibration."""

from collections.abc import Hashable, Sequence

from nicegui import ui

from sightline.app import texts
from sightline.app.panels import bone
from sightline.app.panels.section import Section, action, checks, heading, note, radio, shown_or_not, table
from sightline.app.tab.placing import ProcedureStep
from sightline.app.tab.tab import Tab
from sightline.app.texts import image_label, image_name
from sightline.app.web.serve import ServedApp
from sightline.app.web.transfers import DropZone, Upload
from sightline.case.views import NAMES, OBLIQUE, ImageSlot
from sightline.common.checks import failed
from sightline.errors import UnusableInputError
from sightline.planning.procedures import Procedure, procedures
from sightline.planning.procedures import kind as kind_of

_SERIAL_LENGTH = 64  # characters: a DICOM Device Serial Number (LO) has no more


def build_drop_zone(tab: Tab, site: ServedApp, boxes: Sequence[ui.element]) -> None:
    """Build the drop zone, which persists while panels are rebuilt. On the last step it takes the check images.

    `boxes`: of the two views, which take the files of their images."""

    def taker(view: str):
        async def take(upload: Upload) -> None:
            taken_for = _taken_for(tab)
            if taken_for and view == OBLIQUE:
                raise UnusableInputError(
                    "load the check image as one of the first two: a check shot takes no third image"
                )
            image = ImageSlot(view, taken_for)
            tab.say("")  # what was said of the image before
            where = await tab.planning.take(upload.data, upload.suffix, image=image)
            if where != image:
                tab.say(
                    (
                        f"By its markers this is the {image_name(where, tab.planning.decisions.kind)}; it was "
                        "loaded there."
                    ),
                    good=True,
                )

        return take

    slots = {name: texts.DROP_LABELS[name] for name in tab.planning.slots}
    taken_in = {label: boxes[name != NAMES[0]] for name, label in slots.items()}
    zone = DropZone(site.uploads, {label: taker(name) for name, label in slots.items()}, taken_in)
    shown_states: tuple[dict[str, str], ...] | None = None

    def show() -> None:
        nonlocal shown_states
        kind, taken_for = tab.planning.decisions.kind, _taken_for(tab)
        states = {slots[name]: state for name, state in _wanted(tab).items()}
        names = {slots[name]: image_name(ImageSlot(name, taken_for), kind) for name in NAMES}
        labels = {slots[name]: image_label(ImageSlot(name, taken_for), kind) for name in NAMES}
        if (states, names, labels) != shown_states:
            shown_states = states, names, labels
            zone.tell(states, names, labels)

    tab.on_refresh.append(show)
    show()


def _taken_for(tab: Tab) -> str:
    """Return the purpose of the images that the step takes."""
    return {ProcedureStep.DRILL: "shot", ProcedureStep.VERIFY: "check"}.get(tab.step, "")


def _wanted(tab: Tab) -> dict[str, str]:
    """Return the state of each image that the step takes, by view: empty, here or failed."""
    check, shot = tab.step is ProcedureStep.VERIFY, tab.step is ProcedureStep.DRILL and bool(tab.session.shots.state)
    if tab.session.jobs.working or not (check or shot or tab.step is ProcedureStep.IMAGES):
        return {}
    slots = [name for name in tab.planning.slots if not (check or shot) or name != OBLIQUE]
    if shot or (check and tab.planning.patient is not None):  # which replaces what the views show, or is simulated
        return dict.fromkeys(slots, "here")
    seen = {name: tab.planning.seen(ImageSlot(name, _taken_for(tab))) for name in slots}
    return {name: "empty" if image is None else "failed" if image.refused else "here" for name, image in seen.items()}


def build_side(tab: Tab) -> None:
    """Build the question for the patient's side, over the images that answer it."""
    Section(tab, lambda t: (_asks_side(t), t.planning.decisions.side), _side)


def _asks_side(tab: Tab) -> bool:
    return tab.step is ProcedureStep.IMAGES and all(
        seen is not None and not seen.refused for seen in map(tab.planning.seen, NAMES)
    )


def build(tab: Tab) -> None:
    """Build the panel. Images of one's own are taken in the views of their procedure, so it is chosen first."""
    if tab.planning.patient is None:
        build_kind(tab)
    Section(tab, _state, _images)
    Section(tab, lambda t: t.planning.decisions.serial, _serial)
    Section(tab, lambda t: (_untimed(t), t.planning.decisions.kind), _taken)
    Section(tab, _mirrored_key, _mirrored)


def build_details(tab: Tab) -> None:
    """Build the details: how the images are shown."""
    build_oblique(tab)
    Section(tab, lambda t: t.planning.decisions.side, _orientation)
    Section(tab, lambda t: (t.planning.decisions.kind, *t.planning.decisions.display.items()), _display)


def _orientation(tab: Tab) -> None:
    side = tab.planning.decisions.side
    if side is not None and tab.planning.frame.solid is None:  # a block says nothing of the patient
        note(texts.ORIENTATION[side], testid="orientation")


def build_oblique(tab: Tab) -> None:
    """Build the choice to show the third image in the second view; nothing while there is none."""

    def choice(tab: Tab) -> None:
        if OBLIQUE in tab.planning.decisions.images:
            shown_or_not(tab, "Show the oblique image on the right", "show_oblique")

    Section(tab, lambda t: OBLIQUE in t.planning.decisions.images, choice)


def _state(tab: Tab) -> Hashable:
    jobs, kind = tab.session.jobs, tab.planning.decisions.kind
    return (*map(tab.planning.seen, tab.planning.slots), jobs.working, jobs.trouble, kind)


def _images(tab: Tab) -> None:
    planning, jobs, kind = tab.planning, tab.session.jobs, tab.planning.decisions.kind
    heading("Images")
    if planning.frame.solid is not None:
        note(("A block looks alike in every view: each image is the view under whose name you load it."), kind="quiet")
    for name in planning.slots:
        seen = planning.seen(name)
        if seen is None:
            missing = (
                ", optional, taken last: none yet. It shows movements of the patient that two images do not show."
                if name == OBLIQUE
                else ": none yet"
            )
            note(image_label(name, kind) + missing, kind="quiet", testid=f"no-{name}")
            continue
        height, width = seen.image.shape
        beads = None if seen.beads is None else len(seen.beads)
        if seen.view is not None:  # with those that were found by their predicted positions
            beads = int(seen.view.residuals.used.sum()) + len(seen.view.residuals.left_out)
        counted = "" if beads is None else f", {beads} beads found"
        note(f"{image_label(name, kind)}: {width} × {height}{counted}", kind="bad" if seen.refused else "good")
        if seen.refused:
            note(seen.refused, kind="bad")
    if jobs.working:
        note(texts.in_progress(jobs.working), testid="working")
    if jobs.trouble:
        note(jobs.trouble, kind="bad", testid="trouble")
    if planning.patient is not None:
        note("This case rehearses on a simulated patient.", kind="quiet")
        retake = tab.doing(planning.take_rehearsed)
        action("Take both images again", retake, testid="retake", enabled=not jobs.working)
        if OBLIQUE in planning.slots:
            third = tab.doing(lambda: planning.take_rehearsed((OBLIQUE,)))
            action("Take the oblique image", third, testid="take-oblique", enabled=not jobs.working)


def _side(tab: Tab) -> None:
    if not _asks_side(tab):
        return
    side = tab.planning.decisions.side
    with ui.element("div").classes("on-images").props(f'role=radiogroup aria-label="{texts.SIDE_HEADING}"'):
        ui.label("Which side? Check the marker in the image, or the patient:" if side is None else texts.SIDE_HEADING)
        for name in ("right", "left"):
            button = action(
                f"{name.title()} side",
                tab.doing(lambda name=name: tab.planning.decide(side=name)),
                testid=f"side-{name}",
                kind="primary" if side == name else "plain",
            )
            radio(button, chosen=side == name, first=side is None and name == "right")


def _serial(tab: Tab) -> None:
    heading("Frame's serial")
    known, confirmed = tab.planning.frame.serial, tab.planning.decisions.serial
    if confirmed is not None:
        note(f"Confirmed: {confirmed}", kind="good", testid="serial-confirmed")
    elif known is None:
        note(
            ("Type the serial engraved on the frame, or “none” if there is none. The frame file states none."),
            kind="quiet",
        )
    else:
        note("Type the serial engraved on the frame. It must match the frame file.", kind="quiet")
    field = ui.input("Serial on the frame", value=confirmed or "").props(
        f"dense outlined data-testid=serial maxlength={_SERIAL_LENGTH}"
    )

    def confirm() -> None:
        serial = str(field.value or "").strip()
        if not serial or len(serial) > _SERIAL_LENGTH or not serial.isprintable():
            raise UnusableInputError("type the serial as engraved on the frame, or “none” if there is none")
        tab.planning.confirm_serial(serial)

    field.on("keydown.enter", tab.doing(confirm))
    action("Confirm serial", tab.doing(confirm), testid="confirm-serial", kind="plain" if confirmed else "primary")


def _untimed(tab: Tab) -> tuple[str, ...]:
    """Return the names of the images whose time is unknown."""
    seen = {name: tab.planning.seen(name) for name in tab.planning.slots}
    return tuple(name for name, image in seen.items() if image is not None and tab.session.age.taken_at(image) is None)


def _taken(tab: Tab) -> None:
    untimed, kind = _untimed(tab), tab.planning.decisions.kind
    if untimed:
        heading("When the images were taken")
    for name in untimed:
        note(
            (
                f"{image_label(name, kind)}: time unknown. The file states none, or one after its "
                "arrival; then compare the clocks."
            ),
            kind="warn",
            testid=f"taken-unknown-{name}",
        )
        minutes = ui.number(f"{image_label(name, kind)}: taken, minutes ago", format="%.0f", min=0)
        minutes.props(f"outlined dense data-testid=taken-{name}")

        def confirm(name: str = name, minutes: ui.number = minutes) -> None:
            tab.session.age.state_taken(name, float("nan") if minutes.value is None else float(minutes.value))

        action("Confirm the time", tab.doing(confirm), testid=f"confirm-taken-{name}", kind="primary")


def _mirrored_key(tab: Tab) -> Hashable:
    """Key of the question about mirrored displays: its images, the answers, and how the page shows the images."""
    asked, decisions = tab.planning.asks_mirrored, tab.planning.decisions
    answers = (decisions.mirrored.get(decisions.images[name]) for name in asked)
    return asked, decisions.kind, *answers, *(_is_turned(tab, name) for name in asked)


def _is_turned(tab: Tab, image: str) -> bool:
    shown = tab.planning.decisions.display.get(image)
    return shown is not None and shown.mirrored


def _mirrored(tab: Tab) -> None:
    planning, asked, kind = tab.planning, tab.planning.asks_mirrored, tab.planning.decisions.kind
    if not asked:
        return
    heading("Mirrored displays")
    note(
        (
            "Both images show the frame mirrored. Either the displays are mirrored, or the frame "
            "file is wrong and so is every point. Look at writing in an image, as this page "
            "shows it, and answer for at least one image:"
        ),
        kind="warn",
        testid="mirrored-question",
    )
    for name in asked:
        answered = planning.decisions.mirrored.get(planning.decisions.images[name])
        label = f"{image_label(name, kind)}: writing reads"
        note(
            label
            if answered is None
            else f"{image_label(name, kind)}: the file shows it {'mirrored' if answered else 'unmirrored'}"
        )
        with ui.element("div").classes("choice").props(f'role=radiogroup aria-label="{label}"'):
            for answer in (True, False):
                chosen = answered is not None and answer == (answered != _is_turned(tab, name))
                button = action(
                    ("forwards", "backwards")[answer],
                    tab.doing(lambda name=name, answer=answer: planning.state_mirrored(name, answer)),
                    testid=f"mirrored-{name}-{'backwards' if answer else 'forwards'}",
                    kind="primary" if chosen else "plain",
                )
                radio(button, chosen=chosen, first=answered is None and answer)


def _display(tab: Tab) -> None:
    shown, kind = [], tab.planning.decisions.kind
    for image, display in tab.planning.decisions.display.items():
        mirrored = [texts.XRAY["mirrored"]] * display.mirrored
        turned = [texts.XRAY["rotated"].format(degrees=display.rotation)] * bool(display.rotation)
        if how := texts.DISPLAY_AND.join(mirrored + turned):
            shown.append(f"{image_label(image, kind)}: {how}")
    if shown:
        heading("Display")
        for line in shown:
            note(line, kind="warn")


def build_kind(tab: Tab) -> None:
    """Build the choice."""
    Section(tab, lambda t: t.planning.decisions.kind, _kind)


def _kind(tab: Tab) -> None:
    known = kind_of(tab.planning.decisions.kind)
    kinds: dict[str, str] = {}  # each procedure once, by its first wire
    for key, procedure in procedures().items():
        if procedure.wire == procedure.document.wires[0]:
            kinds[key] = texts.titled(procedure.document.name)

    shown = Procedure.of(known.document, known.document.wires[0].key).key
    ui.select(
        kinds, value=shown, on_change=lambda event: tab.choose(tab.planning.decisions.with_kind(event.value))
    ).classes("kind").props('dense options-dense data-testid=kind aria-label="Procedure"')


def build_calibration(tab: Tab) -> None:
    """Build the panel."""
    Section(tab, _seen_key, _calibrated_views)


def build_calibration_details(tab: Tab) -> None:
    """Build the details: what is shown, and the checks of each view."""

    shown_or_not(tab, "Show rejected candidates, with the reason", "show_rejected")
    build_oblique(tab)
    Section(tab, _seen_key, _calibration_checks)
    bone.build_details(tab)


def _seen_key(tab: Tab) -> Hashable:
    return (tab.planning.decisions.kind, *map(tab.planning.seen, tab.planning.slots))


def _calibrated_views(tab: Tab) -> None:
    for name in tab.planning.slots:
        seen = tab.planning.seen(name)
        if name == OBLIQUE and seen is None:
            continue
        heading(image_label(name, tab.planning.decisions.kind))
        if seen is None:
            note("Drop an image onto the page.", kind="quiet")
        elif seen.refused:
            note(seen.refused, kind="bad", testid=f"refused-{name}")
        elif seen.view is None:
            note(texts.in_progress(seen.doing), kind="quiet")
        else:
            left = seen.view.residuals
            rows = [
                ("beads used / left out", f"{int(left.used.sum())} / {len(left.left_out)}"),
                ("residual, rms", f"{left.rms_mm:.3f} mm"),
                ("focal point, mm", ", ".join(f"{x:.0f}" for x in seen.view.focal_point_mm)),
            ]
            table(("", ""), rows, testid=f"calibration-{name}")
            wrong = failed(seen.view.checks)
            sentence = f"All {len(seen.view.checks)} checks passed" if not wrong else texts.sentence(wrong[0])
            note(sentence, kind="bad" if wrong else "good")


def _calibration_checks(tab: Tab) -> None:
    for name in tab.planning.slots:
        seen = tab.planning.seen(name)
        if seen is not None and seen.view is not None:
            heading(image_label(name, tab.planning.decisions.kind))
            checks(seen.view.checks, testid=f"checks-{name}")
