"""A page with the scene alone, of a hip of known form, for tests. python -m tests.app.space_page PORT"""

import sys
from typing import Any

import numpy as np
from nicegui import ui
from tests.planning.bone import CENTRE_MM, END_MM, ENTRY_MM, views

from sightline.app import texts
from sightline.app.drawing.space import (
    bone_objects,
    drilled_objects,
    frame_objects,
    point_objects,
    robot_objects,
    side_objects,
    sight_objects,
    view_objects,
    wire_objects,
)
from sightline.app.panels.space import SpaceView
from sightline.app.web.serve import ServedApp, serve
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.imaging.volumes.volume import Volume
from sightline.planning import kind, plan
from sightline.robot.kinematics.designs import YAW, imaging_yaw, nominal_manipulator

HOSTILE = "<img src=x onerror='window.hacked=1'>"
GROUPS = {"frame": "Frame", "views": "Views", "bone": "Bone", "rays": "Lines of sight", "wire": "Wire"}
GROUPS |= {"robot": "Robot", "sides": "Sides"}


def scene() -> tuple[dict, list]:
    """Groups of objects of a planned hip, and the lines of sight after a pick has moved."""
    frame, shown = Frame.load("gamma"), views()
    wire_mm = np.stack([ENTRY_MM, END_MM])
    away = np.linalg.norm(np.indices((40, 40, 40)) - np.reshape([19.3, 19.7, 19.1], (3, 1, 1, 1)), axis=0)
    head = Volume((away < 17.5).astype(np.float32), CENTRE_MM - 39.0, np.full(3, 2.0))
    groups = {"frame": frame_objects(frame), "views": [], "rays": [], "bone": bone_objects(head)}
    picks, moved = [], []
    for view in shown:
        uv_px = view.project(wire_mm)
        v, u = np.mgrid[0:1024, 0:1024]
        rings = 800 + 600 * np.cos(np.hypot(u - uv_px[0, 0], v - uv_px[0, 1]) / 15)
        image = Radiograph(rings.astype(np.uint16), 4095.0)
        groups["views"] += view_objects(view, frame.view(view.name).xrii, image)
        groups["rays"] += sight_objects(view, uv_px)
        moved += sight_objects(view, uv_px[:1])
        picks.append(uv_px)
    planned = plan(shown, np.stack(picks)[:, 0], np.stack(picks)[:, 1], snapped=True, procedure=kind("free-wire"))
    robot, q = nominal_manipulator(), np.zeros(5)
    q[YAW] = imaging_yaw("right")
    entry, tip = wire_mm + np.array([3.0, 0.0, 2.0])
    groups["wire"] = wire_objects(planned.trajectory, 2.5) + drilled_objects(entry, tip, 2.5)
    groups["wire"] += point_objects(CENTRE_MM[None], [HOSTILE])
    groups["robot"] = robot_objects(robot, q, robot.T_mcs_cfcs(q))
    groups["sides"] = side_objects("right", CENTRE_MM)
    return groups, moved


def show(space: SpaceView, groups: dict[str, Any]) -> None:
    for name, objects in groups.items():
        space.draw(name, objects)


def page(site: ServedApp) -> None:
    with ui.element("div").style("position: absolute; inset: 0 0 60px 0"):
        space = SpaceView(label="The set-up in space", groups=GROUPS, texts=texts.SPACE_TEXTS)
    space.orient("right")
    show(space, FIRST)
    with ui.element("div").style("position: absolute; bottom: 0"):
        ui.button("one pick", on_click=lambda: space.draw("rays", MOVED)).props("data-testid=one-pick")
        fewer = {name: objects if name == "frame" else [] for name, objects in FIRST.items()}
        ui.button("fewer", on_click=lambda: show(space, fewer)).props("data-testid=fewer")


if __name__ == "__main__":
    FIRST, MOVED = scene()
    serve(page, port=int(sys.argv[1]))
