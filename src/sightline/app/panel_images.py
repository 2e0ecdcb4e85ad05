"""The first step: both images, the patient's side, the frame's serial."""

from collections.abc import Hashable

from nicegui import ui

from sightline.app.drop import DropZone
from sightline.app.section import Section, action, heading, note
from sightline.app.serve import Site
from sightline.app.tab import Tab
from sightline.app.texts import IMAGE_LABELS, ORIENTATION, STEPS
from sightline.app.uploads import Upload
from sightline.case.views import NAMES
from sightline.errors import UnusableInputError

_SERIAL_LENGTH = 64  # characters of a serial [ours]


def build_drop_zone(tab: Tab, site: Site) -> None:
    """Where images are dropped; it stays while the panel is built anew. On the last step they are the check shot's."""

    def taker(view: str):
        async def take(upload: Upload) -> None:
            image = f"check-{view}" if tab.step == STEPS[-1] else view
            where = await tab.procedure.take(upload.data, upload.suffix, image=image)
            if where != image:
                tab.say(f"This is the {IMAGE_LABELS[where]}, as its markers tell; it was put there.")

        return take

    zone = DropZone(site.uploads, {IMAGE_LABELS[name]: taker(name) for name in NAMES})

    def show() -> None:
        zone.set_visibility(tab.step in (STEPS[0], STEPS[-1]))

    tab.on_refresh.append(show)


def build(tab: Tab) -> None:
    """The panel."""
    Section(tab, _state, _images)
    Section(tab, lambda t: t.procedure.decisions.side, _side)
    Section(tab, lambda t: t.procedure.decisions.serial, _serial)
    Section(tab, lambda t: tuple(t.procedure.decisions.display.items()), _display)


def _state(tab: Tab) -> Hashable:
    procedure = tab.procedure
    return (*(procedure.seen(name) for name in NAMES), procedure.working, procedure.trouble)


def _images(tab: Tab) -> None:
    procedure = tab.procedure
    heading("Images")
    for name in NAMES:
        seen = procedure.seen(name)
        if seen is None:
            note(f"{IMAGE_LABELS[name]}: none yet", kind="quiet")
            continue
        height, width = seen.image.shape
        beads = "" if seen.beads is None else f", {len(seen.beads)} beads found"
        note(f"{IMAGE_LABELS[name]}: {width} × {height}{beads}", kind="bad" if seen.refused else "good")
        if seen.refused:
            note(seen.refused, kind="bad")
    if procedure.working:
        note(f"{procedure.working.capitalize()} …", testid="working")
    if procedure.trouble:
        note(procedure.trouble, kind="bad", testid="trouble")
    if procedure.patient is not None:
        note("This case rehearses on a simulated patient.", kind="quiet")
        retake = tab.doing(procedure.take_rehearsed)
        action("Take both images again", retake, testid="retake", enabled=not procedure.working)


def _side(tab: Tab) -> None:
    heading("Patient's side")
    side = tab.procedure.decisions.side
    note("Look at both images, at the letters on the film or at the patient, and confirm:", kind="quiet")
    with ui.element("div").classes("choice").props('role=radiogroup aria-label="Patient\'s side"'):
        for one in ("right", "left"):
            button = action(
                f"{one.capitalize()} hip",
                tab.doing(lambda one=one: tab.procedure.confirm_side(one)),
                testid=f"side-{one}",
                kind="primary" if side == one else "plain",
            )
            button.props(f"role=radio aria-checked={'true' if side == one else 'false'}")
    if side is not None:
        note(ORIENTATION[side], testid="orientation")


def _serial(tab: Tab) -> None:
    heading("Frame's serial")
    known, confirmed = tab.procedure.frame.serial, tab.procedure.decisions.serial
    if confirmed is not None:
        note(f"Confirmed: {confirmed}", kind="good", testid="serial-confirmed")
    elif known is None:
        note("The frame file states none. Type what is engraved on the frame; “none” if nothing is.", kind="quiet")
    else:
        note("Type the serial that is engraved on the frame; it must be the frame file's.", kind="quiet")
    field = ui.input("Serial on the frame", value=confirmed or "").props(
        f"dense outlined data-testid=serial maxlength={_SERIAL_LENGTH}"
    )

    def confirm() -> None:
        serial = str(field.value or "").strip()
        if not serial or len(serial) > _SERIAL_LENGTH or not serial.isprintable():
            raise UnusableInputError("type the serial as it is engraved on the frame, or “none” if there is none")
        tab.procedure.confirm_serial(serial)

    field.on("keydown.enter", tab.doing(confirm))
    action("Confirm serial", tab.doing(confirm), testid="confirm-serial", kind="plain" if confirmed else "primary")


def _display(tab: Tab) -> None:
    shown = [
        f"{IMAGE_LABELS[image]}: "
        + " and ".join(["mirrored"] * display.mirrored + [f"turned {display.rotation}°"] * bool(display.rotation))
        for image, display in tab.procedure.decisions.display.items()
        if display.mirrored or display.rotation
    ]
    if shown:
        heading("Display")
        for line in shown:
            note(line, kind="warn")
