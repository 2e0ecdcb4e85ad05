"""Detection of contact and break-through while drilling a wire, and false alarms, over simulated holes.

Each hole has two cortices: the lateral one where the wire enters, and the shell of the femoral head, where a wire fed
too far would leave. A third each of the femurs is healthy, osteopenic and osteoporotic (physics.md, Femur). The wire is
rigid (a guide at the bone) and is fed at 60 mm/min; the sensor is read at 200 Hz.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.harness import Rows, trials
from sightline.robot.control.supervision import EventKind, Supervision
from sightline.robot.plant import CYCLE_S
from sightline.twin.anatomy.femur import Femur, draw_femur, voxelise
from sightline.twin.robot.drilling import AXIAL_N_PER_MM, CORTICAL_G_CM3, Bone, Wire, sensed

FEED_MM_S = 1.0  # 60 mm/min: physics.md, Drilling
FEMURS, HOLES_A_FEMUR = 4, 20  # of each quality; 20 holes take a core about a minute
CORTICES = ("lateral cortex", "shell of the head")
BONES = {"healthy": 132.0, "osteopenic": 99.0, "osteoporotic": 41.0}  # HU: physics.md, Femur
BEFORE_MM, BEYOND_MM = 4.0, 12.0  # simulated range: before the entry point, beyond the surface of the head
NEAR_MM = 3.0  # largest distance of a detected break-through from the true one


def run(quick: bool) -> Rows:
    """Return the rows; `quick` drills 12 holes."""
    jobs = [(name, seed, 4 if quick else HOLES_A_FEMUR) for seed in range(1 if quick else FEMURS) for name in BONES]
    holes, rows = [hole for some in trials(_femur, jobs) for hole in some], Rows("supervision")
    missed, false = sum(hole[cortex] is None for hole in holes for cortex in CORTICES), sum(h["false"] for h in holes)
    name = f"break-throughs of {len(holes):,} holes, {', '.join(BONES)}: missed / noticed where none is"
    rows.add(name, f"{missed} of {2 * len(holes):,} / {false}")
    for k, what in enumerate(("noticed", "the tip rests")):
        ends = [np.array([hole[cortex][k] for hole in holes if hole[cortex] is not None]) for cortex in CORTICES]
        value = "; ".join(f"{np.median(end):.2f} / {np.quantile(end, 0.95):.2f} / {end.max():.2f} mm" for end in ends)
        rows.add(f"{what} beyond the lateral cortex; the shell of the head: median / 95 % / most", value)
    before = np.array([hole["contact"] for hole in holes])
    name = "contact noticed before the wire's axis meets bone: mean / s.d. / most"
    rows.number(name, [before.mean(), before.std(), before.max()], ".2f", "mm")
    return rows


def _femur(job: tuple[str, int, int]) -> list[dict[str, Any]]:
    name, seed, holes = job
    rng = np.random.default_rng([40, list(BONES).index(name), seed])
    femur = replace(draw_femur(rng), cancellous_hu=BONES[name], socket=False)
    bone = Bone((voxelise(femur, "right", np.zeros(3), rng),), RigidTransform.identity())
    return [_hole(bone, _wire(femur, rng), rng) for _ in range(holes)]


def _wire(femur: Femur, rng: np.random.Generator) -> np.ndarray:
    """Return the entry and the point (2, 3) where the wire would leave the head, within 5 mm and 5° of the ideal."""
    entry, end = (np.asarray(point) for point in femur.wire_mm(angle_deg=rng.uniform(130, 138)))
    along = (end - entry) / np.linalg.norm(end - entry)
    shift = rng.uniform(-4, 4, 3)
    entry = entry + shift - (shift @ along) * along
    return np.stack([entry, entry + along * (np.linalg.norm(end - entry) + 8.0)])


def _hole(bone: Bone, line_mm: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
    """Return the events of one hole, drilled until the wire is BEYOND_MM outside the head: how far beyond each cortex
    its break-through was detected and the tip stops, mm (None: not detected), and the number of false ones."""
    start, length = line_mm[0], float(np.linalg.norm(line_mm[1] - line_mm[0]))
    along = (line_mm[1] - start) / length
    x = np.linalg.svd(along[None])[2][1]
    axes = np.stack([x, np.cross(along, x), along])
    wire, watch = Wire(bone), Supervision(length + 100.0, length + 100.0)
    tip, noted, touched = 0.0, [], np.nan
    for step in range(int((length + BEFORE_MM + BEYOND_MM) / (FEED_MM_S * CYCLE_S))):
        depth = -BEFORE_MM + step * FEED_MM_S * CYCLE_S
        thrust = wire.step(start + depth * along, axes, 5.0, turning=True, dt_s=CYCLE_S)
        tip = float((wire.tip_mm - start) @ along)
        for event in watch.step(step * CYCLE_S, depth, sensed(thrust, rng)):
            if event.event is EventKind.BREAK_THROUGH:
                noted.append((tip, tip + thrust / AXIAL_N_PER_MM))  # the feed stops, the wire expands
            elif event.event is EventKind.CONTACT:
                touched = depth
    met = bone.first_met_mm(start - BEFORE_MM * along, line_mm[1], CORTICAL_G_CM3 / 2) - BEFORE_MM
    hole: dict[str, Any] = {"contact": met - touched}
    for name, end in zip(CORTICES, _cortex_ends(bone, start, along, tip), strict=True):
        mine = next((event for event in noted if -NEAR_MM / 6 <= event[0] - end <= NEAR_MM), None)
        hole[name] = None if mine is None else (mine[0] - end, mine[1] - end)
        noted = [event for event in noted if event is not mine]
    return {**hole, "false": len(noted)}


def _cortex_ends(bone: Bone, start: np.ndarray, along: np.ndarray, last_mm: float) -> list[float]:
    """Return where the density on the wire's axis falls to half of that of the first and of the last cortex."""
    at = np.arange(-BEFORE_MM, last_mm, 0.02)
    density = bone.density(start + at[:, None] * along)
    ends = []
    for part in (at < 25.0, at >= last_mm - 40.0):
        place, value = at[part], density[part]
        peak = int(value.argmax())
        ends.append(float(place[peak + np.flatnonzero(value[peak:] < value[peak] / 2)[0]]))
    return ends
