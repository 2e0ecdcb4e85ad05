"""Runs of two views: a table of tracked points to points in space, and balls followed through images.

Points: twenty markers that move together by a few mm, 0.3 px of noise, columns of XMALab, by `sightline reconstruct`.
Balls: four of 1 mm on a body whose plan has an error of 0.02 mm, drawn at random poses on two panels that a block
calibrates.
"""

import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.distance import pdist
from scipy.spatial.transform import RigidTransform, Rotation
from typer.testing import CliRunner

from benchmarks.harness import Rows
from sightline.case.saved import document
from sightline.cli import commands
from sightline.detection import detect
from sightline.frame import Frame
from sightline.planning.points.body import BallBody, BodyFinder, BodyPose
from sightline.studies.scenes import calibrated_views, draw_scene
from sightline.twin import Scene, render
from sightline.twin.objects.things import Ball

MARKERS, FRAMES, SD_PX, FIRST_SEED = 20, 50_000, 0.3, 4
MAX_S = 60.0
BODY_MM = np.array([[0.0, 0.0, 0.0], [17.3, 2.1, -1.4], [4.8, 21.9, 3.3], [-6.2, 8.7, 14.1]])
BODY_SD_MM, SET_UPS, POSES = 0.02, 10, 8
# XMALab, markers in a machined object: Knörlein et al. 2016, J. Exp. Biol. 219, 3701
PUBLISHED = "XMALab 0.043 mm, published of real images"


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows = Rows("reconstruct")
    _points(rows, FRAMES // 50 if quick else FRAMES)
    _balls(rows, *((2, 8) if quick else (SET_UPS, POSES)))
    return rows


def _points(rows: Rows, frames: int) -> None:
    rng = np.random.default_rng(FIRST_SEED)
    scene = draw_scene(rng, Frame.load("gamma"), 0.1, targets=1)
    views = calibrated_views(scene.setup, scene.observations)
    sway = np.sin(np.arange(frames)[:, None] / [50.0, 70.0, 30.0]) * [8.0, 6.0, 5.0]
    xyz = (rng.uniform(-30.0, 30.0, (MARKERS, 3)) + sway[:, None]).reshape(-1, 3)
    uv = np.array([np.concatenate([view.project(part) for part in np.array_split(xyz, 128)]) for view in views])
    uv += rng.normal(0.0, SD_PX, uv.shape)
    header = ",".join(f"m{k}_cam{c}_{axis}" for k in range(MARKERS) for c in (1, 2) for axis in "XY")
    with TemporaryDirectory() as folder:
        table, file = Path(folder) / "points.csv", Path(folder) / "views.json"
        cells = uv.reshape(2, frames, MARKERS, 2).transpose(1, 2, 0, 3).reshape(frames, -1)
        np.savetxt(table, cells, "%.3f", ",", header=header, comments="")
        file.write_text(json.dumps([document(view, source="") for view in views]))
        given = [table, "--views", file, "--out", Path(folder) / "xyz.csv", "--points", "distorted", "--first-pixel", 0]
        started, used = time.perf_counter(), time.process_time()
        ran = CliRunner().invoke(commands, ["reconstruct", *map(str, given), "--sd", str(SD_PX), "--json"])
        used, wall = time.process_time() - used, time.perf_counter() - started
    assert json.loads(ran.stdout)["reconstructed"] == len(xyz)  # all points lie within both images
    rows.number(f"{len(xyz):,} points, file to file, by the clock", wall, ".0f", "s", most=MAX_S)
    rows.number("the same, processor time", used, ".0f", "s", most=MAX_S)


def _balls(rows: Rows, setups: int, poses: int) -> None:
    sd_mm, squares, asked = [], [], setups * poses
    for seed in range(setups):
        rng = np.random.default_rng([FIRST_SEED, seed])
        scene = draw_scene(rng, Frame.load("block60"), 0.05, targets=1)
        views = calibrated_views(scene.setup, scene.observations)
        finder = BodyFinder(views, BallBody(tuple("abcd"), BODY_MM, BODY_SD_MM**2 * np.eye(12)))
        built = BODY_MM + rng.normal(0.0, BODY_SD_MM, BODY_MM.shape)
        followed = []
        for _ in range(poses):
            place = scene.target_mm[0] + rng.uniform(-10.0, 10.0, 3)
            truth = RigidTransform.from_components(place, Rotation.random(rng=rng))
            balls = tuple(Ball(tuple(xyz), 0.5, within=None) for xyz in truth.apply(built).tolist())
            found = finder.find([detect(render(scene.setup, view.name, Scene(solids=balls), rng)) for view in views])
            if isinstance(found, BodyPose):
                turn = (truth.rotation * found.pose.rotation.inv()).as_rotvec()
                off = np.concatenate([turn, truth.apply(BODY_MM).mean(axis=0) - found.centre_mm])
                squares.append(off @ np.linalg.solve(found.covariance, off) / 6)
                followed.append(pdist(found.xyz_mm))
        sd_mm.append(np.std(followed, axis=0, ddof=1))
    share = 100.0 * len(squares) / asked
    rows.number(f"balls: frames of {asked:,} with a pose", share, ".1f", "%", least=90.0)
    precision = float(np.sqrt(np.mean(np.square(sd_mm))))
    rows.number("balls: s.d. of the distances between them", precision, ".3f", "mm", peer=PUBLISHED)
    rows.number("balls: normalised error of a pose, rms", float(np.sqrt(np.mean(squares))), ".2f", least=0.8, most=1.2)
