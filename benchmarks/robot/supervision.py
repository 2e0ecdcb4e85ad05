"""Detection of contact and break-through while drilling a wire, and false alarms, over 1,000 simulated holes.

Each hole has two cortices: the lateral one where the wire enters, and the shell of the femoral head, where a wire fed
too far would leave. A third each of the femurs is healthy, osteopenic and osteoporotic (physics.md, Femur). The wire is
rigid (a guide at the bone) and is fed at 60 mm/min; the sensor is read at 200 Hz.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.robot.control.supervision import EventKind, Supervision
from sightline.robot.plant import CYCLE_S
from sightline.twin.anatomy.femur import draw_femur, voxelise
from sightline.twin.robot.drilling import AXIAL_N_PER_MM, CORTICAL_G_CM3, Bone, Wire, sensed

FEED_MM_S = 1.0  # 60 mm/min: physics.md, Drilling
HOLES_A_FEMUR = 20
CORTICES = ("lateral cortex", "shell of the head")
BONES = {"healthy": 132.0, "osteopenic": 99.0, "osteoporotic": 41.0}  # HU: physics.md, Femur
BEFORE_MM, BEYOND_MM = 4.0, 12.0  # simulated range: before the entry point, beyond the surface of the head
_NEAR_MM = 3.0  # largest distance of a detected break-through from the true one


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark; `quick` drills 60 holes."""
    jobs = [(name, seed) for seed in range(1 if quick else 17) for name in BONES]
    holes = [hole for some in in_parallel(_femur, jobs) for hole in some]
    return [row for name in BONES for row in _rows(name, [hole for hole in holes if hole["bone"] == name])]


def _rows(name: str, holes: list[dict[str, Any]]) -> list[Row]:
    rows = []
    for cortex in CORTICES:
        ends = np.array([hole[cortex] for hole in holes if hole[cortex] is not None])
        for what, off in zip(("noticed", "the tip rests"), ends.T, strict=True):
            value = f"{np.median(off):.2f} / {np.quantile(off, 0.95):.2f} / {off.max():.2f} mm"
            rows.append(Row("supervision", f"{what} beyond the {cortex}, {name}: median / 95 % / most", value))
        missed = f"{len(holes) - len(ends)} of {len(holes)}"
        rows.append(Row("supervision", f"break-throughs of the {cortex} missed, {name}", missed))
    before = np.array([hole["contact"] for hole in holes])
    told = f"{before.mean():.2f} / {before.std():.2f} / {before.min():.2f} to {before.max():.2f} mm"
    rows.append(Row("supervision", f"contact noticed before the axis meets bone, {name}: mean / s.d. / range", told))
    false = f"{sum(hole['false'] for hole in holes)} in {len(holes)} holes"
    return [*rows, Row("supervision", f"break-throughs noticed where none is, {name}", false)]


def _femur(job: tuple[str, int]) -> list[dict[str, Any]]:
    name, seed = job
    rng = np.random.default_rng([40, list(BONES).index(name), seed])
    femur = replace(draw_femur(rng), cancellous_hu=BONES[name], socket=False)
    bone = Bone((voxelise(femur, "right", np.zeros(3), rng),), RigidTransform.identity())
    return [{"bone": name, **_hole(bone, _wire(femur, rng), rng)} for _ in range(HOLES_A_FEMUR)]


def _wire(femur, rng: np.random.Generator) -> np.ndarray:
    """Return the entry and the point (2, 3) where the wire would leave the head, within 5 mm and 5° of the ideal."""
    entry, end = (np.asarray(point) for point in femur.wire_mm(angle_deg=rng.uniform(130, 138)))
    along = (end - entry) / np.linalg.norm(end - entry)
    shift = rng.uniform(-4, 4, 3)
    entry = entry + shift - (shift @ along) * along
    return np.stack([entry, entry + along * (np.linalg.norm(end - entry) + 8.0)])


def _hole(bone: Bone, line_mm: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
    """Return the events of one hole, drilled until the wire is BEYOND_MM outside the head."""
    along = line_mm[1] - line_mm[0]
    length = float(np.linalg.norm(along))
    along = along / length
    x = np.linalg.svd(along[None])[2][1]
    axes = np.stack([x, np.cross(along, x), along])
    wire, watch = Wire(bone), Supervision(length + 100.0, length + 100.0)
    tip, noted, touched = 0.0, [], np.nan
    for step in range(int((length + BEFORE_MM + BEYOND_MM) / (FEED_MM_S * CYCLE_S))):
        depth = -BEFORE_MM + step * FEED_MM_S * CYCLE_S
        thrust = wire.step(line_mm[0] + depth * along, axes, 5.0, turning=True, dt_s=CYCLE_S)
        tip = float((wire.tip_mm - line_mm[0]) @ along)
        for one in watch.step(step * CYCLE_S, depth, sensed(thrust, rng)):
            if one.kind is EventKind.BREAK_THROUGH:
                noted.append((tip, tip + thrust / AXIAL_N_PER_MM))  # the feed stops, the wire expands
            elif one.kind is EventKind.CONTACT:
                touched = depth
    met = bone.first_met_mm(line_mm[0] - BEFORE_MM * along, line_mm[1], CORTICAL_G_CM3 / 2) - BEFORE_MM
    return {"contact": met - touched, **_judged(_cortex_ends(bone, line_mm[0], along, tip), noted)}


def _judged(ends_mm: tuple[float, float], noted: list[tuple[float, float]]) -> dict[str, Any]:
    """Return how far beyond each cortex its break-through was detected and the tip stops, mm; None: not detected."""
    out: dict[str, Any] = {}
    left = list(noted)
    for name, end in zip(CORTICES, ends_mm, strict=True):
        mine = next((one for one in left if -_NEAR_MM / 6 <= one[0] - end <= _NEAR_MM), None)
        out[name] = None if mine is None else (mine[0] - end, mine[1] - end)
        left = [one for one in left if one is not mine]
    return {**out, "false": len(left)}


def _cortex_ends(bone: Bone, start: np.ndarray, along: np.ndarray, last_mm: float) -> tuple[float, float]:
    """Return where the density on the wire's axis falls to half of that of the first and of the last cortex."""
    at = np.arange(-BEFORE_MM, last_mm, 0.02)
    density = bone.density(start + at[:, None] * along)
    first = slice(0, int(np.searchsorted(at, 25.0)))
    last = slice(int(np.searchsorted(at, last_mm - 40.0)), None)
    out = []
    for part in (first, last):
        peak = int(density[part].argmax())
        after = np.flatnonzero(density[part][peak:] < density[part][peak] / 2)
        out.append(float(at[part][peak + after[0]]))
    return out[0], out[1]
