"""Step 2, Calibrate: the quality of each view's calibration."""

from collections.abc import Hashable

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.images import build_oblique
from sightline.app.panels.section import Section, checks, heading, note, table
from sightline.app.tab.tab import Tab
from sightline.app.texts import image_label
from sightline.case.views import OBLIQUE
from sightline.common.checks import failed


def build(tab: Tab) -> None:
    """Build the panel."""
    Section(tab, _key, _views)


def build_details(tab: Tab) -> None:
    """Build the details: what is shown, and the checks of each view."""

    def show(event) -> None:
        tab.views.show_rejected = bool(event.value)
        tab.refresh()

    ui.checkbox("Show rejected candidates, with the reason", value=tab.views.show_rejected, on_change=show).props(
        "data-testid=show-rejected"
    )
    build_oblique(tab)
    Section(tab, _key, _checks)


def _key(tab: Tab) -> Hashable:
    return (tab.planning.decisions.kind, *map(tab.planning.seen, tab.planning.slots))


def _views(tab: Tab) -> None:
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
            said = f"All {len(seen.view.checks)} checks passed" if not wrong else texts.sentence(wrong[0])
            note(said, kind="bad" if wrong else "good")


def _checks(tab: Tab) -> None:
    for name in tab.planning.slots:
        seen = tab.planning.seen(name)
        if seen is not None and seen.view is not None:
            heading(image_label(name, tab.planning.decisions.kind))
            checks(seen.view.checks, testid=f"checks-{name}")
