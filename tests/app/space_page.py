"""A page with the scene alone, drawn from the twin, for tests. python -m tests.app.space_page PORT"""

import sys
from typing import Any

import numpy as np
from nicegui import ui

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
from sightline.calibration import calibrate
from sightline.detection import Observations
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning import kind, plan
from sightline.robot.kinematics.manipulator import YAW, imaging_yaw, nominal_manipulator
from sightline.twin import bead_images
from sightline.twin.scenes.hip_scene import shown_hip_scene

HOSTILE = "<img src=x onerror='window.hacked=1'>"
GROUPS = {"frame": "Frame", "views": "Views", "bone": "Bone", "rays": "Lines of sight", "wire": "Wire"}
GROUPS |= {"robot": "Robot", "sides": "Sides"}


def scene() -> tuple[dict, list]:
    """Groups of objects of a planned hip, and the lines of sight after a pick has moved."""
    rng, frame = np.random.default_rng(5), Frame.load("gamma")
    setup, hip = shown_hip_scene(rng, frame)
    groups = {"frame": frame_objects(frame), "views": [], "rays": [], "bone": bone_objects(hip.bone.volumes[0])}
    views, picks, moved = [], [], []
    for name in ("pa", "lateral"):
        ids, uv = bead_images(setup, name, rng, 0.1)
        noise = np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0)
        view = calibrate(Observations(name, ids, uv, noise, image_shape=(1024, 1024)), frame, view=name)
        uv_px = setup.views[name].project(hip.wire_mm)
        v, u = np.mgrid[0:1024, 0:1024]
        rings = 800 + 600 * np.cos(np.hypot(u - uv_px[0, 0], v - uv_px[0, 1]) / 15)
        image = Radiograph(rings.astype(np.uint16), 4095.0)
        groups["views"] += view_objects(view, frame.view(name).xrii, image)
        groups["rays"] += sight_objects(view, uv_px)
        moved += sight_objects(view, uv_px[:1])
        views.append(view)
        picks.append(uv_px)
    planned = plan(views, np.stack(picks)[:, 0], np.stack(picks)[:, 1], snapped=True, kind=kind("free-wire"))
    robot, q = nominal_manipulator(), np.zeros(5)
    q[YAW] = imaging_yaw("right")
    entry, tip = hip.wire_mm + np.array([3.0, 0.0, 2.0])
    groups["wire"] = wire_objects(planned.trajectory, 2.5) + drilled_objects(entry, tip, 2.5)
    groups["wire"] += point_objects(hip.head_mm[None], [HOSTILE])
    groups["robot"] = robot_objects(robot, q, robot.T_mcs_cfcs(q))
    groups["sides"] = side_objects("right", hip.head_mm)
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
