"""Step 2, Calibrate: the quality of each view's calibration."""

from collections.abc import Hashable

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.images import build_oblique
from sightline.app.panels.section import Section, checks, heading, note, table
from sightline.app.tab.tab import Tab
from sightline.app.tab.view_names import image_label
from sightline.case.views import OBLIQUE
from sightline.checks import failed


def build(tab: Tab) -> None:
    """Build the panel."""
    Section(tab, _key, _views)


def build_details(tab: Tab) -> None:
    """Build the details: what is shown, and the checks of each view."""

    def show(event) -> None:
        tab.views.show_rejected = bool(event.value)
        tab.refresh()

    ui.checkbox(texts.SHOW_REJECTED, value=tab.views.show_rejected, on_change=show).props("data-testid=show-rejected")
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
            note(texts.DROP_FIRST, kind="quiet")
        elif seen.refused:
            note(seen.refused, kind="bad", testid=f"refused-{name}")
        elif seen.view is None:
            note(texts.in_progress(seen.doing), kind="quiet")
        else:
            left = seen.view.residuals
            rows = [
                (texts.BEADS_USED, f"{int(left.used.sum())} / {len(left.left_out)}"),
                (texts.RESIDUAL, f"{left.rms_mm:.3f} mm"),
                (texts.FOCAL_POINT, ", ".join(f"{x:.0f}" for x in seen.view.focal_point_mm)),
            ]
            table(("", ""), rows, testid=f"calibration-{name}")
            wrong = failed(seen.view.checks)
            said = texts.ALL_PASSED.format(count=len(seen.view.checks)) if not wrong else texts.said(wrong[0])
            note(said, kind="bad" if wrong else "good")


def _checks(tab: Tab) -> None:
    for name in tab.planning.slots:
        seen = tab.planning.seen(name)
        if seen is not None and seen.view is not None:
            heading(image_label(name, tab.planning.decisions.kind))
            checks(seen.view.checks, testid=f"checks-{name}")
