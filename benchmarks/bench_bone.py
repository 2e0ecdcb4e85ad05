"""Poses of bones from a CT and two images that gVirtualXray drew, from starts that are off, and without one."""

import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks import bone_peers, gvxr
from benchmarks.bone_trials import (
    REACH,
    SIZES,
    WAYS,
    Record,
    fault_trial,
    hidden_trial,
    noticed_trial,
    right_trial,
    start_off,
)
from benchmarks.harness import Refusal, Rows, finished, time_ms, trials
from benchmarks.scenes.bones import FIRST_SEED, draw_bone_scene
from sightline.from_images.registration import ScannedBone, register_bone

TRIALS, FAULT_TRIALS, QUICK = 150, 120, 4
PEER_TRIALS = 6
MOVED_SCENES, NOTICED, MAX_HIDDEN = 10, 0.95, 1.0
# Mean error over the targets of a pose that counts as found, and of one that counts as wrong [ours].
FOUND_MM, WRONG_MM = 1.0, 2.0
COVERAGE, MIN_COVERED = {0.95: 0.03}, 50
INSIDE, CALLS = chi2.isf(1e-3, 3), 3
# Of each way of registering: what is told, and the least share found, %.
MIN_FOUND = {
    "own": ("start within 10 mm, 10°", 98.0),
    "wide": ("start within 20 mm, 20°", 80.0),
    "clicks": ("two points clicked", 99.0),
    "none": ("no start", 90.0),
    "none exact": ("no start, exact views", 90.0),
}
MAX_MEDIAN_MM = {
    "exact": ("exact views", 0.10),
    "own": ("views from their beads", 0.25),
    "2 mm": ("CT of 2 mm, exact views", 0.4),
    "head": ("femur's head alone in the field, exact views", 0.5),
}
MAX_95_MM, MAX_95_DEG, MAX_REFUSED, MIN_FAULTS, MAX_WARM_S, MAX_FIRST_S = 0.20, 0.5, 3.0, 99.0, 5.0, 20.0
_FIRST_CALL = """
import pickle, sys
from pathlib import Path
from sightline.from_images.registration import register_bone
register_bone(*pickle.loads(Path(sys.argv[1]).read_bytes()))
"""


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark; `quick` does few trials."""
    rows = Rows("bone")
    if not gvxr.INSTALLED:
        rows.add("registration of a bone", "not installed", peer="pip install gvxr")
        return rows
    scenes, out = finished(trials(right_trial, range(QUICK if quick else TRIALS)))
    rows.add("scenes whose beads give no views", out)
    for add in (right_rows, refusal_rows, coverage_rows):
        add(rows, scenes)
    fault_rows(rows, 6 if quick else FAULT_TRIALS)
    movement_rows(rows, 1 if quick else MOVED_SCENES, 3 if quick else FAULT_TRIALS)
    peer_rows(rows, 1 if quick else PEER_TRIALS)
    time_rows(rows)
    return rows


def of_way(scenes: Sequence[dict[str, Record]], way: str, *, trusted: bool = False) -> list[Record]:
    """Return the records of one way of registering, all or the trusted ones."""
    records = [scene[way] for scene in scenes if way in scene]
    return [each for each in records if each["trusted"]] if trusted else records


def right_rows(rows: Rows, scenes: Sequence[dict[str, Record]]) -> None:
    """Add how many poses are found, the median error of all, and the larger errors of those that are trusted."""
    for way, (told, least) in MIN_FOUND.items():
        share = [each["error_mm"] < FOUND_MM for each in of_way(scenes, way)]
        name = f"{told} ({len(share)}): mean error of targets below {FOUND_MM:g} mm"
        rows.number(name, 100 * np.mean(share), ".1f", "%", least=least)
    for way, (told, most) in MAX_MEDIAN_MM.items():
        found, trusted = of_way(scenes, way), of_way(scenes, way, trusted=True)
        if not found:
            rows.add(told, "no scene")
            continue
        median, name = np.median([each["error_mm"] for each in found]), f"{told} ({len(found)})"
        rows.number(f"{name}: mean error of targets, median", median, ".3f", "mm", most=most)
        limits = {
            "error_mm": ("mean error of targets", "mm", MAX_95_MM if way == "exact" else np.inf),
            "turn_deg": ("rotation", "°", MAX_95_DEG if way in ("exact", "own") else np.inf),
        }
        for key, (what, unit, limit) in limits.items() if trusted else ():
            value = np.quantile([each[key] for each in trusted], 0.95)
            rows.number(f"{name}: {what}, 95 % of {len(trusted)} trusted", value, ".3f", unit, most=limit)
    alone = np.concatenate([each["alone"] for each in of_way(scenes, "own", trusted=True)])
    text = "one view alone: error along its beam"
    for name, column in {text: 0, f"{text}, stated 95 % bound": 1}.items():
        rows.number(f"{name}, median of {len(alone)}", np.median(alone[:, column]), ".2f", "mm")
    rows.number(f"{text}: inside the bound", 100 * np.mean(alone[:, 0] <= alone[:, 1]), ".1f", "%")


def refusal_rows(rows: Rows, scenes: Sequence[dict[str, Record]]) -> None:
    """Add the wrong poses that were accepted, and the right ones that were refused."""
    for way, told in {way: texts[0] for way, texts in (MIN_FOUND | MAX_MEDIAN_MM).items()}.items():
        wrong = [each["trusted"] for each in of_way(scenes, way) if each["error_mm"] > WRONG_MM]
        rows.none(f"{told}: wrong by more than {WRONG_MM:g} mm and trusted", sum(wrong), f"{len(wrong)} wrong")
        right = [not each["trusted"] for each in of_way(scenes, way) if each["error_mm"] < FOUND_MM]
        most = MAX_REFUSED if way in ("own", "exact") else np.inf
        if right:
            rows.number(f"{told} ({len(right)} right): refused", 100 * np.mean(right), ".1f", "%", most=most)


def coverage_rows(rows: Rows, scenes: Sequence[dict[str, Record]]) -> None:
    """Add how often the stated errors of trusted poses hold, over all scenes and by stratum."""
    covered(rows, "exact views", of_way(scenes, "exact", trusted=True))
    covered(rows, "views from their beads", of_way(scenes, "own", trusted=True))
    wires = [end for each in of_way(scenes, "own") if each.get("go") for end in each["wire2"]]
    rows.covers("wires planned on the CT that are GO: entry and end", wires, COVERAGE, MIN_COVERED)
    for stratum in ("anatomy", "chain", "overlap", "metal"):
        for value in sorted({scene["strata"][stratum] for scene in scenes}):
            own = [scene for scene in scenes if scene["strata"][stratum] == value]
            covered(rows, f"views from their beads, {stratum} {value}", of_way(own, "own", trusted=True))


def covered(rows: Rows, told: str, records: Sequence[Record]) -> None:
    rows.covers(f"{told}: pose", [each["pose2"] for each in records], COVERAGE, MIN_COVERED, dof=6)
    rows.covers(f"{told}: joint", [each["targets2"][0] for each in records], COVERAGE, MIN_COVERED, dof=3)


def fault_rows(rows: Rows, count: int) -> None:
    """Add how many faults are refused, or leave all targets inside their stated error."""
    records, _ = finished(trials(fault_trial, range(count)))
    good = [not each["trusted"] or bool((each["targets2"] < INSIDE).all()) for each in records]
    for fault in dict.fromkeys(each["fault"] for each in records):
        own = [(ok, each["trusted"]) for ok, each in zip(good, records, strict=True) if each["fault"] == fault]
        text = f"{sum(ok for ok, _ in own)} of {len(own)}; refused {sum(not trusted for _, trusted in own)}"
        rows.add(f"{fault}: refused or inside the stated error", text)
    name = f"all faults ({len(good)}): refused or inside the stated error"
    rows.number(name, 100 * np.mean(good), ".1f", "%", least=MIN_FAULTS)


def movement_rows(rows: Rows, scenes: int, count: int) -> None:
    """Add the smallest movements between the images that are noticed, and how many that are not make a pose wrong."""
    cases = [(k, way) for k in range(scenes) for way in range(2 * len(WAYS))]
    smallest = dict(zip(cases, trials(noticed_trial, cases), strict=True))
    for way, told in enumerate([f"{what}: {w}" for what in ("shift along, mm", "rotation about, °") for w in WAYS]):
        sizes = [size for case, size in smallest.items() if case[1] == way and not isinstance(size, Refusal)]
        size = np.quantile(sizes or [np.nan], NOTICED, method="higher")
        text = f"{size:g}" if size < np.inf else f"above {SIZES[-1]:g}"
        rows.add(f"smallest movement noticed in {100 * NOTICED:.0f} % of scenes ({len(sizes)}), {told}", text)
    records, _ = finished(trials(hidden_trial, range(count)))
    wrong = [each["trusted"] and not (each["targets2"] < INSIDE).all() for each in records]
    for movement in dict.fromkeys(each["movement"] for each in records):
        own = [bad for bad, each in zip(wrong, records, strict=True) if each["movement"] == movement]
        rows.add(f"moved by {movement}: trusted and outside the stated 99.9 %", f"{sum(own)} of {len(own)}")
    name = f"all these movements ({len(wrong)}): trusted and outside the stated 99.9 %"
    rows.number(name, 100 * np.mean(wrong), ".1f", "%", most=MAX_HIDDEN)


def peer_rows(rows: Rows, count: int) -> None:
    """Add ours beside ITK's registration of two projections, with the bone alone and with the whole scan."""
    name = "exact views, start within 10 mm, 10°, beside ITK"
    if not bone_peers.INSTALLED:
        rows.add(name, "not installed", peer="pip install itk-twoprojectionregistration")
        return
    scenes, _ = finished(trials(bone_peers.peer_trial, range(count)))
    for what, key, unit, form in (
        ("median of the mean error of targets", "error_mm", "mm", ".3f"),
        (f"mean error of targets below {FOUND_MM:g} mm", "error_mm", "%", ".0f"),
        ("processor time of a trial, median", "time_s", "s", ".1f"),
    ):
        texts = {}
        for way in ("ours", "bone alone", "whole scan"):
            values = np.array([each[way][key] for each in scenes])
            value = 100 * np.mean(values < FOUND_MM) if unit == "%" else np.median(values)
            texts[way] = f"{value:{form}} {unit}"
        peer = f"ITK: bone alone {texts['bone alone']}, whole scan {texts['whole scan']}"
        rows.add(f"{name} ({len(scenes)}): {what}", texts["ours"], peer=peer)


def time_rows(rows: Rows) -> None:
    """Add the times of one scene: of a call when all is compiled, and of a program that compiles all."""
    scene = draw_bone_scene(FIRST_SEED, anatomy_name="femur", chain="panel")
    bone = ScannedBone.of_ct(scene.ct)
    start = start_off(scene, bone, np.random.default_rng(FIRST_SEED), REACH["near"])
    given = bone, list(scene.images.values()), scene.views(), start
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "given.pickle"
        file.write_bytes(pickle.dumps(given))
        before = time.perf_counter(), children_s()
        command, own = [sys.executable, "-c", _FIRST_CALL, str(file)], os.environ | {"NUMBA_CACHE_DIR": folder}
        subprocess.run(command, env=own, check=True)
        first = time.perf_counter() - before[0], children_s() - before[1]
    call = partial(register_bone, *given)
    warm = (np.median(time_ms(call, CALLS, clock)) / 1e3 for clock in (time.perf_counter, time.process_time))
    told = {"a call, all compiled": (warm, MAX_WARM_S), "a program that compiles all": (first, MAX_FIRST_S)}
    for name, ((wall, of_cores), most) in told.items():
        rows.number(name, wall, ".1f", "s", most=most)
        rows.number(f"{name}: time of all cores", of_cores, ".1f", "s")


def children_s() -> float:
    """Return the processor time of all programs that this one has run."""
    spent = os.times()
    return spent.children_user + spent.children_system
