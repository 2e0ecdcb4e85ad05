"""Labelling of solids by geometry alone, in random scenes of points: shares labelled, wrong and refused, and times."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.labelling.solid_scenes import BALL_SD_MM, CloudScene, draw_cloud, draw_cloud_scene
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.detection.labelling.cloud import label_cloud
from sightline.errors import LabellingRefusedError
from sightline.frame import Frame

SCENES = 10_000
BLOCK = 50
SEED = 5
CLEAR = 9  # balls seen from which a scene must be labelled, where the solid has as many


@dataclass(frozen=True)
class Kind:
    """Scenes of one kind: a new random cloud for each, or the built-in block; `share` of SCENES."""

    name: str
    cloud: Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]
    hidden: float
    false: int
    share: float = 1.0
    median_ms: float | None = None
    focal_known: bool = True


@dataclass(frozen=True)
class Outcome:
    """Result of one scene. `wrong`: beads with another ball's label; `false`: false detections with a label."""

    number: int
    clear: int
    refusal: str | None
    wrong: int
    false: int
    misread: bool
    found: int
    seconds: float


def _block60(_: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    solid = Frame.load("block60").solid
    assert solid is not None
    return solid.xyz_mm, solid.diameter_mm


KINDS = (
    Kind("12 balls in 60 mm", lambda rng: draw_cloud(rng, 12, 60.0), 0.0, 0, median_ms=10.0),
    Kind("12 balls in 60 mm, 20 % hidden, 20 false", lambda rng: draw_cloud(rng, 12, 60.0), 0.2, 20, median_ms=300.0),
    Kind("block60, 20 % hidden, 20 false", _block60, 0.2, 20, median_ms=300.0),
    Kind("block60, 20 % hidden, 20 false, focal length unknown", _block60, 0.2, 20, focal_known=False),
    Kind("9 balls in 30 x 30 x 50 mm, 20 false", lambda rng: draw_cloud(rng, 9, (30.0, 30.0, 50.0), (2.0,)), 0.0, 20),
    Kind("6 balls in 60 mm", lambda rng: draw_cloud(rng, 6, 60.0), 0.0, 0),
    Kind("6 balls in 60 mm, 20 false", lambda rng: draw_cloud(rng, 6, 60.0), 0.0, 20),
    Kind("32 balls in 60 mm, 20 % hidden, 20 false", lambda rng: draw_cloud(rng, 32, 60.0), 0.2, 20, share=0.5),
    Kind("200 balls in 100 mm, 20 % hidden, 20 false", lambda rng: draw_cloud(rng, 200, 100.0, (2.0,)), 0.2, 20, 0.05),
)


def _scene(kind: Kind, number: int) -> tuple[CloudScene, tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng([SEED, number])
    cloud = kind.cloud(rng)
    return draw_cloud_scene(rng, cloud, hidden=kind.hidden, false=kind.false), cloud


def outcome(kind: Kind, number: int) -> Outcome:
    """Return the result of scene `number` of a kind."""
    scene, cloud = _scene(kind, number)
    width = scene.detections.image_shape[1]
    focal_px = scene.focal_px if kind.focal_known else (1.8 * width, 8.0 * width)
    started = time.process_time()
    try:
        found = label_cloud(scene.detections, *cloud, focal_px, BALL_SD_MM)
    except LabellingRefusedError as refusal:
        return Outcome(number, scene.clear, str(refusal), 0, 0, False, 0, time.process_time() - started)
    seconds = time.process_time() - started
    truth = scene.truth[found.rows]
    wrong, false = int(((truth >= 0) & (truth != found.balls)).sum()), int((truth < 0).sum())
    misread = found.mirrored != scene.mirrored
    return Outcome(number, scene.clear, None, wrong, false, misread, len(truth) - wrong - false, seconds)


def _block(start: tuple[int, int]) -> list[Outcome]:
    kind, first = start
    return [outcome(KINDS[kind], number) for number in range(first, first + BLOCK)]


def _rows(kind: Kind, every: list[Outcome]) -> list[Row]:
    group = f"labelling of a solid, {kind.name}: {len(every)} scenes"
    solvable = [one for one in every if one.clear >= CLEAR]
    refused = sum(one.refusal is not None for one in every)
    wrong = sum(one.wrong > 0 or one.misread for one in every)
    labelled = [one for one in every if one.refusal is None]
    found = sum(one.found for one in labelled) / max(1, sum(one.clear for one in labelled))
    times = np.array([one.seconds for one in every]) * 1e3
    rows = [
        Row(group, "labelled", f"{1 - refused / len(every):.2%}"),
        Row(group, "labelled wrongly: a ball or the handedness", str(wrong), "0", met=wrong == 0),
        Row(group, "false detections taken for hidden balls", str(sum(one.false for one in every))),
        Row(group, "balls seen that were labelled, where labelled", f"{found:.2%}"),
        Row(
            group,
            "processor time: median; 99 %",
            f"{np.median(times):.1f} ms; {np.quantile(times, 0.99):.0f} ms",
            "" if kind.median_ms is None else f"median <= {kind.median_ms:g} ms",
            met=None if kind.median_ms is None else bool(np.median(times) <= kind.median_ms),
        ),
    ]
    if solvable:
        share = sum(one.refusal is None for one in solvable) / len(solvable)
        name = f"labelled where {CLEAR} balls are seen ({len(solvable)} scenes)"
        rows.insert(1, Row(group, name, f"{share:.2%}", ">= 99 %", met=share >= 0.99))
    return rows


def run(quick: bool = False) -> list[Row]:
    """Return the rows of this benchmark."""
    counts = [max(BLOCK, int(SCENES * kind.share / (10 if quick else 1))) for kind in KINDS]
    starts = [(kind, first) for kind, count in enumerate(counts) for first in range(0, count, BLOCK)]
    results = in_parallel(_block, starts)
    rows = []
    for index, kind in enumerate(KINDS):
        every = [one for (number, _), block in zip(starts, results, strict=True) if number == index for one in block]
        rows += _rows(kind, every)
    return rows
