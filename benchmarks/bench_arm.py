"""Arms of six and seven axes: their inverse, and insertions as of figure 15 by a person through the guide they hold."""

import time
from typing import Any

import numpy as np

from benchmarks import arm_peers
from benchmarks.harness import Rows, trials
from sightline.errors import RobotRefusedError
from sightline.robot.kinematics.designs import DESIGNS, Design
from sightline.robot.kinematics.manipulator import MIN_SINGULAR
from sightline.robot.kinematics.target import STANDOFF_MM
from sightline.studies.rendered.fig15 import Figure15
from sightline.studies.scenes import PAPER_DEG, PAPER_MM

FIRST_SEED = 34
TRIALS, PLANS = 300, 1000
WIRE_MM = 80.0
MAX_MEDIAN_MM, MAX_MEDIAN_DEG, COVERAGE = 0.3, 0.15, (92.0, 98.0)
MIN_FOUND, MAX_ERROR_MM, MAX_MS = 99.0, 1e-6, 20.0


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark; `quick` does a tenth of the trials."""
    rows = Rows("arm")
    inverse_rows(rows, PLANS // 10 if quick else PLANS)
    hand_rows(rows, TRIALS // 10 if quick else TRIALS)
    rows.extend(arm_peers.rows(quick))
    return rows


def inverse_rows(rows: Rows, plans: int) -> None:
    """Add what the inverse finds of wires that random joints within the limits hold, away from singular positions."""
    for name in ("six-axis", "seven-axis"):
        arm, rng = DESIGNS[name](), np.random.default_rng(FIRST_SEED)
        errors_mm, spent_ms, missed = [], [], 0
        while len(errors_mm) + missed < plans:
            q = rng.uniform(arm.lower, arm.upper)
            if arm.singular(q[None])[0] < MIN_SINGULAR:
                continue
            tool = arm.T_mcs_tool(q)
            entry, end = tool.apply([[0.0, 0.0, STANDOFF_MM], [0.0, 0.0, STANDOFF_MM + WIRE_MM]])
            started = time.perf_counter()
            try:
                found = arm.inverse(entry, end, -STANDOFF_MM)
            except RobotRefusedError:
                missed += 1
                continue
            finally:
                spent_ms.append(1e3 * (time.perf_counter() - started))
            laid = arm.along(found, STANDOFF_MM + WIRE_MM).translation - end
            held = arm.T_mcs_tool(found).translation - tool.translation
            errors_mm.append(max(np.linalg.norm(laid), np.linalg.norm(held)))
        what = f"inverse, {name}, {plans:,} reachable plans"
        rows.number(f"{what}: found", 100 * len(errors_mm) / plans, ".1f", "%", least=MIN_FOUND)
        rows.number(f"{what}: largest error at guide and tip", max(errors_mm), ".1e", "mm", most=MAX_ERROR_MM)
        rows.number(f"{what}: median time", float(np.median(spent_ms)), ".1f", "ms", most=MAX_MS)


def hand_rows(rows: Rows, number: int) -> None:
    """Add the errors of wires that a person drills through the guide of the six-axis arm."""
    results = trials(hand_trial, range(number))
    drilled = [wire for wire in results if "refused" not in wire]
    good = sum(wire["entry"] <= PAPER_MM and wire["angle"] <= PAPER_DEG for wire in drilled)
    what = "fig15 with the six-axis arm and a person's hand (play 0.05 mm, push 20 N)"
    value = f"{good} of {number}; {number - len(drilled)} not drilled"
    rows.add(f"{what}: within {PAPER_MM:g} mm and {PAPER_DEG}°", value, "all", good == number)
    for of, unit, most in (("entry", "mm", MAX_MEDIAN_MM), ("angle", "°", MAX_MEDIAN_DEG)):
        name = {"entry": "entry", "angle": "direction"}[of]
        rows.number(f"{what}: {name}, median", np.median([wire[of] for wire in drilled]), ".3f", unit, most=most)
        within = [wire[of] <= wire[f"stated_{of}"] for wire in drilled]
        low, high = COVERAGE
        rows.number(f"{what}: {name} within its stated 95 %", 100 * np.mean(within), ".1f", "%", least=low, most=high)


def hand_trial(seed: int, arm: Design = "six-axis") -> dict[str, Any]:
    """Return one trial's errors, mm and °, and their stated 95 % bounds; or why it was refused."""
    trial = Figure15(methods=("smooth",), arm=arm).trial(np.random.default_rng([FIRST_SEED, seed]))
    return trial.get("smooth", trial)
