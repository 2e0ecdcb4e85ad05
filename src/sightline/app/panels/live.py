"""The live image on the step Drill: the plan is drawn over it only while the image is fresh; a stale one is marked."""

from typing import TYPE_CHECKING

from nicegui import ui

from sightline.app import texts
from sightline.app.panels.section import Section, action, heading, note
from sightline.app.tab.tab import Tab
from sightline.case.watch.alarm import BLIND_TO

if TYPE_CHECKING:
    from sightline.case.watch.analyser import Watched

_UPDATE_S = 0.1  # half of STALE_S; each update extends how long the browser shows the image as current


def build(tab: Tab) -> None:
    """Build this part of the panel."""
    heading("Live image")
    Section(tab, lambda t: t.session.live.watch is not None, _switch)
    said = ui.label().classes("note").props("data-testid=live-state role=status")
    note(BLIND_TO, kind="quiet")

    def update() -> None:
        watched = tab.session.live.latest()
        if watched is None:
            if tab.views.watched is not None:
                tab.show_live(None)
            watch = tab.session.live.watch
            said.set_text("" if watch is None else watch.fault or "Waiting for the first image …")
            return
        said.set_text(_sentence(watched))
        said.classes(add="bad" if watched.moved else "", remove="" if watched.moved else "bad")
        tab.show_live(watched)

    ui.timer(_UPDATE_S, update)


def _switch(tab: Tab) -> None:
    live = tab.session.live
    if live.watch is None:
        start = tab.doing(lambda: live.start(tab.live_source))
        action("Show the live image", start, testid="live-start", kind="plain")
        return

    async def stop() -> None:
        tab.show_live(None)
        await live.close()

    with ui.element("div").classes("choice"):
        action("End the live image", tab.doing(stop), testid="live-stop", kind="plain")
        action("I checked: nothing moved", tab.doing(live.watch.rest), testid="live-rest", kind="plain")


def _sentence(watched: "Watched") -> str:
    if watched.stale:
        return texts.STALE.format(age=watched.age_s)
    movement = watched.movement.text if watched.movement is not None else watched.note
    state = f"No view ({watched.reason})" if watched.view is None else "Calibrated"
    return f"{state}, {1000 * watched.latency_s:.0f} ms old. {movement}"
