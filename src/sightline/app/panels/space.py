"""The 3-D scene below the images: each group of objects is redrawn only when it changes."""

import asyncio
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import nicegui.elements.scene  # noqa: F401 # pyright: ignore[reportUnusedImport] - makes its three.js known to the page; ours is no copy of it
import numpy as np
from nicegui import ui

from sightline.app import texts
from sightline.app.drawing import space
from sightline.app.drawing.calls import Calling
from sightline.app.panels.section import LIVE_S
from sightline.app.plan.planner import landmarks_of
from sightline.app.tab.tab import Tab
from sightline.errors import SightlineError
from sightline.planning.procedures import kind as kind_of

_DRAWING = Path(__file__).parents[1] / "drawing"


class SpaceView(
    Calling,
    component=_DRAWING / "space" / "space_view.js",
    dependencies=[_DRAWING / "space" / "space*.js", _DRAWING / "colours.js"],
):
    """The 3-D scene. Its objects are those of `drawing.space`, in named groups that a person can hide."""

    def __init__(self, *, label: str, groups: Mapping[str, str], texts: Mapping[str, str]) -> None:
        """`label`: accessible description of the scene; `groups`: names of the groups, in the legend's order; `texts`:
        of its buttons and notes, by name."""
        super().__init__()
        self._props["label"] = label
        self._props["groups"] = dict(groups)
        self._props["texts"] = dict(texts)
        self._props["data-testid"] = "space"

    def draw(self, group: str, objects: Sequence[Mapping[str, Any]]) -> None:
        """Replace one group; an empty one is removed."""
        self.run_method("draw", group, list(objects))

    def orient(self, side: str | None) -> None:
        """Set the side of the hip, "right" or "left", which orients the view: feet towards the viewer; from above, head
        up."""
        self.run_method("orient", side)


class Space:
    """The 3-D scene of one page. `open`: whether it is shown; nothing is drawn while it is not."""

    def __init__(self, tab: Tab) -> None:
        self._tab, self.open = tab, False
        self._drawn: dict[str, Hashable] = {}
        self._bone: list[dict[str, Any]] | None = None
        self._box = ui.element("div").classes("space-box")
        self._box.set_visibility(False)
        with self._box:
            self._view = SpaceView(
                label="3-D scene: frame, views, wire, robot", groups=texts.SPACE_GROUPS, texts=self._texts
            )
        tab.on_refresh.append(self.refresh)
        ui.timer(LIVE_S, self._robot)

    def toggle(self) -> None:
        """Show or hide it."""
        self.open = not self.open
        self._box.set_visibility(self.open)
        self.refresh()

    def refresh(self) -> None:
        """Draw the groups that changed."""
        if not self.open:
            return
        planning, known = self._tab.planning, self._tab.known
        decisions, views = planning.decisions, planning.views()
        seen = [planning.seen(name) for name in planning.slots]
        if self._of_patient and self._drawn.get("sides", "never") != decisions.side:
            self._view.orient(decisions.side)
        self._group("frame", planning.frame, lambda: space.frame_objects(planning.frame))
        self._group("sides", decisions.side, lambda: self._sides(decisions.side))
        self._group("views", tuple(seen), self._views)
        self._group("sights", (views, decisions.marks), self._sights)
        plan = None if known is None else known.plan
        self._group("points", plan, self._points)
        self._group("wire", known, self._wires)
        self._group("drilled", tuple(self._tab.session.verifying.shots.values()), self._drilled)
        if planning.patient is not None and self._bone is None:
            self._bone = []
            asyncio.get_running_loop().create_task(self._fetch_bone())
        self._group("bone", None if self._bone is None else len(self._bone), lambda: self._bone or [])

    @property
    def _of_patient(self) -> bool:
        """Whether the frame's axes are the patient's: those of plates, not those of a block."""
        return self._tab.planning.frame.solid is None

    @property
    def _texts(self) -> dict[str, str]:
        return texts.SPACE_TEXTS if self._of_patient else {**texts.SPACE_TEXTS, **texts.SPACE_AXES}

    def _sides(self, side: str | None) -> list[dict[str, Any]]:
        return space.side_objects(side, np.zeros(3)) if self._of_patient else space.axis_objects()

    async def _fetch_bone(self) -> None:
        patient = self._tab.planning.patient
        assert patient is not None  # noqa: S101
        self._bone = await self._tab.planning.worker.do(space.rehearsed_bone, patient)
        self._tab.later()

    def _group(self, name: str, key: Hashable, objects: Callable[[], list[dict[str, Any]]]) -> None:
        if self._drawn.get(name, "never") != key:
            self._drawn[name] = key
            self._view.draw(name, objects())

    def _views(self) -> list[dict[str, Any]]:
        planning = self._tab.planning
        seen = {name: image for name in planning.slots if (image := planning.seen(name)) is not None}
        shown = [(name, each.view, each.image) for name, each in seen.items() if each.view is not None]
        plates = {name: view.xrii for name, view in planning.frame.views.items()}
        return [made for name, view, image in shown for made in space.view_objects(view, plates.get(name), image)]

    def _sights(self) -> list[dict[str, Any]]:
        planning, made = self._tab.planning, []
        marks = [planning.decisions.mark(spec.name) for spec in planning.decisions.specs]
        for view, name in zip(planning.views() or (), planning.names, strict=False):
            for at in (mark.at(name) for mark in marks):
                with suppress(SightlineError):  # outside the calibrated region; the plan says so
                    made += space.sight_objects(view, np.reshape(at or (), (-1, 2)))
        return made

    def _points(self) -> list[dict[str, Any]]:
        known = self._tab.known
        if known is None or known.plan is None:
            return []
        words = [spec.label for spec in landmarks_of(known.decisions, len(known.views))]
        return space.point_objects(known.plan.seen.xyz_mm[2:], words)

    def _wires(self) -> list[dict[str, Any]]:
        known, made = self._tab.known, []
        for plan in () if known is None else known.plans.values():
            name = "" if known is not None and plan is known.plan else plan.kind.wire.name
            made += space.wire_objects(plan.trajectory, plan.kind.wire_mm, name)
        return made

    def _drilled(self) -> list[dict[str, Any]]:
        shots = self._tab.session.verifying.shots.items()
        drilled = [(shot.entry_mm, shot.tip_mm, kind_of(kind).wire_mm) for kind, shot in shots]
        return [made for wire in drilled for made in space.drilled_objects(*wire)]

    def _robot(self) -> None:
        session = self._tab.session.drilling.session
        now = None if session is None else session.now
        if not self.open or session is None or now is None or now.joints is None:
            return
        joints, robot = np.round(now.joints, 3), session.robot.manipulator
        where = robot.T_mcs_cfcs(session.imaged_q)
        self._group("robot", joints.tobytes(), lambda: space.robot_objects(robot, joints, where))
