"""Draw docs/pictures/frame-assembly.svg, the assembled Γ frame: `python tools/draw_frame_assembly.py FILE`.

Positions of plates and balls come from the built-in frame, the plate from its workshop drawing; arms and clearances are
our choice (docs/your-first-frame.md).
"""

import sys

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle

from sightline.frame import Frame

PLATE_MM, EDGE_MM = 8.0, 15.0  # of the workshop drawings
THIGH_MM = 105.0  # of the twin
HOLE = "milled: 3.00 to 3.014 (H8)\nprinted: print 2.7, drill out to 3.0 by hand"
GREY, BLUE, RED, GREEN = "#8a8f98", "#2f6db5", "#c0392b", "#3c8d4f"


def main(file: str) -> None:
    """Write the drawing."""
    mpl.rcParams.update({"svg.fonttype": "path", "svg.hashsalt": "sightline", "font.size": 8})
    figure, (whole, bore) = plt.subplots(1, 2, figsize=(10, 5.4), width_ratios=(1.5, 1), layout="constrained")
    assembly(whole)
    section(bore)
    figure.savefig(file, metadata={"Date": None})


def assembly(axes: Axes) -> None:
    """Draw the frame along Y, seen from the feet of a patient with a right hip."""
    axes.set_title("Γ frame, seen along the patient (mm)")
    axes.add_patch(Circle((0, 0), THIGH_MM, facecolor="#f4e3d7", edgecolor="#d9b89f"))
    axes.plot(0, 0, "+", color="black")
    axes.text(0, -22, "origin: the hip's centre", ha="center", fontsize=7)
    axes.text(-48, -70, "patient, 105 mm", color="#a07a5c")
    for name, along in (("pa", 1), ("lateral", 0)):
        view = Frame.load("gamma").views[name]
        for plate in (view.xrii, view.source):
            balls = plate.xyz_mm[:, (0, 2)]
            half = np.ptp(balls[:, 1 - along]) / 2 + EDGE_MM
            at = balls[0, along]
            corner = (-half, at - PLATE_MM / 2) if along else (at - PLATE_MM / 2, -half)
            size = (2 * half, PLATE_MM) if along else (PLATE_MM, 2 * half)
            axes.add_patch(Rectangle(corner, *size, facecolor="#cfe0f3", edgecolor=BLUE))
            axes.plot(*np.unique(balls, axis=0).T, ".", color="black", ms=2.5)
    gusset = [(84, 160), (94, 292), (114, 292), (292, 114), (292, 94), (160, 84), (160, 106), (106, 160)]
    axes.add_patch(Polygon(gusset, facecolor="#dcead9", edgecolor=GREEN))
    for side in (-1, 1):
        post = np.array([(60, 154), (68, 154), (78, 296), (70, 296)]) * (side, 1)
        axes.add_patch(Polygon(post, facecolor="#dcead9", edgecolor=GREEN))
        axes.add_patch(Polygon(post[:, ::-1], facecolor="#dcead9", edgecolor=GREEN))
    axes.text(188, 192, "corner bracket:\none part, both arms", color=GREEN, rotation=-45, ha="center", va="center")
    axes.annotate("posts outside the\noutermost balls", (-72, 240), (-208, 232), color=GREEN, arrowprops=arrow(GREEN))
    axes.annotate("XRII plate", (-60, 300), (-208, 322), color=BLUE, arrowprops=arrow(BLUE))
    axes.annotate("source plate", (-50, 150), (-208, 120), color=BLUE, arrowprops=arrow(BLUE))
    for start, end, text, place in (
        ((0, -200), (0, -125), "PA beam", (6, -180)),
        ((-200, 0), (-125, 0), "lateral beam", (-208, -22)),
    ):
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": RED, "lw": 2})
        axes.text(*place, text, color=RED)
    for z, x in ((150, -118), (300, -138)):
        axes.annotate("", (x, z), (x, 0), arrowprops={"arrowstyle": "<->", "color": GREY, "lw": 0.8})
        axes.text(x - 3, z / 2 + (30 if z == 300 else -20), f"{z}", color=GREY, ha="right", rotation=90)
        axes.plot([x - 6, -4], [z, z], color=GREY, lw=0.4)
    skin = "at least 5 mm to the skin: source\nplates 114 mm or more from the hip"
    axes.annotate(skin, (118, 20), (60, -150), color=GREY, arrowprops=arrow(GREY))
    axes.annotate("housing of the intensifier: plate\n346 mm or less from the hip", (40, 350), (-30, 362), color=GREY)
    axes.set(xlim=(-215, 345), ylim=(-215, 395), xlabel="X, lateral", ylabel="Z, anterior", aspect="equal")


def section(axes: Axes) -> None:
    """Draw a section of a plate's bore with its ball."""
    axes.set_title("a bore for a 3 mm ball, section (mm)")
    axes.add_patch(Rectangle((-9, 0), 18, PLATE_MM, facecolor="#cfe0f3", edgecolor=BLUE))
    axes.add_patch(Rectangle((-1.5, 2.5), 3, 5.6, facecolor="white", edgecolor="white"))
    axes.plot([-1.5, -1.5, 1.5, 1.5], [8, 2.5, 2.5, 8], color=BLUE)
    axes.add_patch(Rectangle((-1.5, 2.5), 3, 0.35, facecolor="#f3e6a8", edgecolor="none"))
    axes.add_patch(Circle((0, 4), 1.5, facecolor="#9aa3ad", edgecolor="black"))
    axes.plot([-9.5, 9.5], [4, 4], "-.", color=GREY, lw=0.7)
    axes.text(9.6, 4, "middle of\nthe plate", va="center", color=GREY)
    for x, low, high, text in ((-7, 0, 8, "8"), (-4, 2.5, 8, "5.5")):
        axes.annotate("", (x, high), (x, low), arrowprops={"arrowstyle": "<->", "color": GREY})
        axes.text(x - 0.3, (low + high) / 2, text, ha="right", va="center", color=GREY)
    axes.annotate("", (-1.5, 9), (1.5, 9), arrowprops={"arrowstyle": "<->", "color": GREY})
    axes.text(
        0, 9.3, "milled: 3.00 to 3.014 (H8)\nprinted: print 2.7, drill out to 3.0 by hand", ha="center", color=GREY
    )
    axes.annotate("a drop of adhesive on the floor;\npress the ball down to it", (0.6, 2.6), (0.3, -2.6),
                  ha="center", arrowprops=arrow(GREY))  # fmt: skip
    axes.text(-9, -6.2, "printed parts, clearance in diameter:\n"
              "  dowel pin in its hole: 0 (drill out)\n  post in its socket: 0.2 to 0.3\n"
              "  screw in its hole: 0.5 (dowels locate, screws clamp)", va="center")  # fmt: skip
    axes.set(xlim=(-10, 14), ylim=(-9, 13), aspect="equal")
    axes.axis("off")


def arrow(colour: str) -> dict[str, object]:
    """Return the style of a thin arrow."""
    return {"arrowstyle": "-", "color": colour, "lw": 0.7}


if __name__ == "__main__":
    main(sys.argv[1])
