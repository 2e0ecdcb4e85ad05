"""Draw docs/pictures/manipulator.svg from the manipulator's data: `python tools/draw_manipulator.py FILE`."""

import sys

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from sightline.robot.kinematics.manipulator import LIFT, PITCH, TRAVERSE, WRIST_MM, YAW, nominal_manipulator
from sightline.robot.kinematics.reach import MACHINE, PLATES_MM, Obstacle, hip_surroundings

# Title, axes shown, limits of the second one, and offsets of the joints' labels (points).
VIEWS = (
    ("from above", (0, 1), (-260, 560), {LIFT: (-30, -58), TRAVERSE: (4, 2), YAW: (24, -4), PITCH: (4, -4)}),
    ("from the side", (0, 2), (-150, 670), {LIFT: (3, 2), TRAVERSE: (-40, -42), YAW: (3, 10), PITCH: (4, 4)}),
)
LABELS = (  # text, place in both views
    ("patient", (640, 20), (740, 320)),
    ("table", None, (640, 110)),
    ("C-arm's detector, swept", (-95, 450), (560, 640)),
    ("plates of the frame", (600, 375), (620, 475)),
    ("drill", (345, 45), (300, 195)),
)
GREY, BLUE, RED, GREEN = "#8a8f98", "#2f6db5", "#c0392b", "#3c8d4f"


Place = tuple[int, int]


def outline(axes: Axes, xyz: np.ndarray, show: Place, **style) -> None:
    """Draw the convex hull of points (N, 3), projected."""
    flat = xyz[:, show]
    axes.add_patch(Polygon(flat[ConvexHull(flat).vertices], closed=True, **style))


def sphere(radius: float) -> np.ndarray:
    """Return points (N, 3) on three great circles."""
    angle = np.linspace(0, 2 * np.pi, 48)
    ring = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(48)], axis=1)
    return np.concatenate([ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]])


def box(obstacle: Obstacle) -> np.ndarray:
    """Return the corners (8, 3) of an obstacle, MCS."""
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return obstacle.T_mcs_box.apply(corners * obstacle.half_mm)


def draw(axes: Axes, show: Place, q: np.ndarray) -> None:
    """Draw robot, wire, frame and surroundings at joint values q (5,)."""
    robot = nominal_manipulator()
    frame = robot.T_mcs_cfcs(q)
    theatre = hip_surroundings(frame)
    for obstacle in theatre.obstacles:
        swing = obstacle.name == "C-arm"
        outline(axes, box(obstacle), show, facecolor="none" if swing else "#efe9e1", edgecolor="#cfc6ba", lw=0.6)
    stages = robot.stages(q)
    for part in MACHINE:
        ends = robot.T_mcs_flange_home.apply(part.ends_mm)
        moved = stages[part.joints]
        line = ends @ moved[:3, :3].T + moved[:3, 3]
        whole = np.concatenate([end + sphere(part.radius_mm) for end in line])
        outline(axes, whole, show, facecolor=GREY, alpha=0.45, edgecolor="#555b63", lw=0.8)
    for distance, half in PLATES_MM:
        rim = np.array([[-half, -half], [half, -half], [half, half], [-half, half], [-half, -half]])
        pa = np.column_stack([rim, np.full(5, distance)])
        for plate in (pa, pa[:, [2, 0, 1]]):
            axes.plot(*frame.apply(plate)[:, show].T, color=GREEN, lw=1.5)
    wire = robot.T_mcs_tool(q).apply([[0.0, 0.0, -200.0], [0.0, 0.0, 0.0]])
    axes.plot(*wire[:, show].T, color=RED, lw=1.6)
    axes.plot(*frame.translation[list(show)], "+", color=GREEN, ms=9)
    hip = frame.translation[list(show)]
    axes.annotate("hip: origin of CFCS", hip, (10, -34), textcoords="offset points", fontsize=8)


def joints(axes: Axes, show: Place, q: np.ndarray, offsets: dict[int, Place]) -> None:
    """Draw the axes of the joints, with names and limits, and those of MCS."""
    robot = nominal_manipulator()
    wrist = np.array(WRIST_MM)
    names = {LIFT: "q1 lift ±100 mm", TRAVERSE: "q2 traverse ±100 mm", YAW: "q3 yaw ±60°", PITCH: "q4 pitch ±45°"}
    places = {LIFT: wrist - [200, 0, 0], TRAVERSE: wrist - [140, 0, 0], YAW: wrist, PITCH: wrist}
    for joint, name in names.items():
        turns = joint >= YAW
        along = robot.stages(q)[joint, :3, :3] @ robot.axes[joint, slice(0, 3) if turns else slice(3, 6)]
        at, flat = places[joint][list(show)], along[list(show)]
        style = {"arrowstyle": "-" if turns else "<->", "color": BLUE, "lw": 1.4, "ls": "-." if turns else "-"}
        reach = 0 if np.hypot(*flat) < 0.1 else 130
        if reach:
            axes.annotate("", at + reach * flat, at - reach * flat, arrowprops=style)
        else:  # towards the viewer
            axes.plot(*at, "o", color=BLUE, ms=6, mfc="white")
            axes.plot(*at, ".", color=BLUE, ms=3)
        axes.annotate(name, at + reach * flat, offsets[joint], textcoords="offset points", color=BLUE, fontsize=8)
    home = robot.T_mcs_tool(q * [1, 1, 1, 1, 0])
    near, far = home.apply([[0.0, 0.0, 0.0], [0.0, 0.0, 250.0]])[:, show]
    side = np.array([(far - near)[1], -(far - near)[0]]) / np.linalg.norm(far - near) * 22
    axes.annotate("", far + side, near + side, arrowprops={"arrowstyle": "->", "color": RED, "lw": 1.4})
    axes.annotate("q5 feed 0..250 mm", near + 1.9 * side, color=RED, fontsize=8, va="center")
    for name, axis in zip("XYZ", np.eye(3), strict=True):
        flat = 90 * axis[list(show)]
        if flat.any():
            axes.annotate("", flat, (0, 0), arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.2})
            axes.annotate(name, flat, (3, 3), textcoords="offset points", fontsize=9)
    axes.annotate("MCS", (0, 0), (-26, -12), textcoords="offset points", fontsize=8)


def main() -> None:
    """Draw both views side by side, with the wire advanced to 198 mm."""
    mpl.rcParams["svg.hashsalt"] = "manipulator"
    figure, both = plt.subplots(1, 2, figsize=(11.5, 5.0), layout="constrained")
    q = np.array([0.0, 0.0, np.deg2rad(45.0), 0.0, 198.0])
    for index, (axes, (title, show, limits, offsets)) in enumerate(zip(both, VIEWS, strict=True)):
        draw(axes, show, q)
        joints(axes, show, q, offsets)
        for text, *places in LABELS:
            if places[index]:
                axes.annotate(text, places[index], fontsize=8, color="#444444")
        axes.set(title=title, aspect="equal", xlim=(-130, 900), ylim=limits)
        axes.set(xlabel="X / mm", ylabel=f"{'XYZ'[show[1]]} / mm")
        axes.title.set_size(10)
    figure.savefig(sys.argv[1], metadata={"Date": None} if sys.argv[1].endswith("svg") else None)


if __name__ == "__main__":
    main()
