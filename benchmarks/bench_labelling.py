"""Labelling of plates and of solids in random scenes of points: shares labelled, wrong and refused."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.harness import Row, Rows, trials
from benchmarks.scenes.balls import BALL_SD_MM, draw_cloud, draw_cloud_scene
from benchmarks.scenes.plates import Scene, draw_scene
from sightline.detection import Observations, label
from sightline.detection.labelling.cloud import label_cloud
from sightline.errors import LabellingRefusedError
from sightline.frame import Frame

SCENES = 5_000
BLOCK = 50  # scenes of one job
PLATE_SEED, SOLID_SEED = 2, 5
SEEN = 9  # balls seen from which a scene must be labelled, where the solid has as many
MIN_LABELLED = {"labelling": 98.0, "cloud": 99.0}  # % of the scenes that can be


@dataclass(frozen=True)
class Kind:
    """Scenes of one kind of solid: a new random cloud for each, or the built-in block; `share` of SCENES."""

    name: str
    cloud: Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]
    hidden: float
    false: int
    share: float = 1.0
    most_ms: float = np.inf
    focal_known: bool = True


def _block60(_: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    solid = Frame.load("block60").solid
    assert solid is not None
    return solid.xyz_mm, solid.diameter_mm


KINDS = (
    Kind("12 balls", lambda rng: draw_cloud(rng, 12, 60.0), 0.0, 0, most_ms=10.0),
    Kind("12 among 20 false, 20 % hidden", lambda rng: draw_cloud(rng, 12, 60.0), 0.2, 20, most_ms=300.0),
    Kind("block60 the same", _block60, 0.2, 20, most_ms=300.0),
    Kind("block60 the same, focal length unknown", _block60, 0.2, 20, focal_known=False),
    Kind("9 in 30 x 30 x 50 mm, 20 false", lambda rng: draw_cloud(rng, 9, (30.0, 30.0, 50.0), (2.0,)), 0.0, 20),
    Kind("six alone", lambda rng: draw_cloud(rng, 6, 60.0), 0.0, 0),
    Kind("six among 20 false", lambda rng: draw_cloud(rng, 6, 60.0), 0.0, 20),
    Kind("32, 20 % hidden, 20 false", lambda rng: draw_cloud(rng, 32, 60.0), 0.2, 20, share=0.5),
    Kind("200, 20 % hidden, 20 false", lambda rng: draw_cloud(rng, 200, 100.0, (2.0,)), 0.2, 20, 0.05),
)


@dataclass(frozen=True)
class Outcome:
    """Result of one scene. `wrong`: beads with another bead's label; `false`: false detections with a label; `misread`:
    view or handedness; `share`: of the beads seen that were labelled."""

    solvable: bool
    labelled: bool
    seconds: float
    wrong: int = 0
    false: int = 0
    misread: bool = False
    share: float = 0.0

    @property
    def mistaken(self) -> bool:
        """Whether anything is wrong but a false detection."""
        return self.wrong > 0 or self.misread


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return _plates(SCENES // 10 if quick else SCENES) + _solids(10 if quick else 1)


def _plates(number: int) -> Rows:
    rows = Rows("labelling")
    every = [scene for job in trials(_plate_scenes, range(0, number, BLOCK)) for scene in job]
    solvable, fewer = ([scene for scene in every if scene.solvable is can] for can in (True, False))
    name = f"{number:,} scenes: labelled where three datums of each plate remain"
    rate, least = 100 * np.mean([scene.labelled for scene in solvable]), MIN_LABELLED["labelling"]
    rows.number(f"{name} ({len(solvable):,})", rate, ".2f", "%", least=least)
    known = [scene for scene in fewer if scene.labelled]
    mistaken = sum(scene.mistaken or scene.false > 0 for scene in known)
    name = f"fewer than three isolated datums of a plate remain, or all on a line ({len(fewer):,} scenes)"
    value = f"{len(known):,} / {len(fewer) - len(known)} / {mistaken}"
    rows.add(f"{name}: labelled / refused / wrong", value, "wrong 0", mistaken == 0)
    wrong = [sum(getattr(scene, key) for scene in every) for key in ("wrong", "false", "misread")]
    name = "beads with a wrong id; false candidates taken; views misread"
    rows.add(name, "; ".join(map(str, wrong)), "0", not any(wrong))
    share, taken = 100 * np.mean([s.share for s in every if s.labelled]), np.median([s.seconds for s in every])
    rows.add("beads seen that were labelled; processor time, median", f"{share:.1f} %; {1e3 * taken:.1f} ms")
    return rows


def _plate_scenes(start: int) -> list[Outcome]:
    frame = Frame.load("gamma")
    return [_plate_scene(frame, number) for number in range(start, start + BLOCK)]


def _plate_scene(frame: Frame, number: int) -> Outcome:
    scene = draw_scene(np.random.default_rng([PLATE_SEED, number]), frame)
    started = time.process_time()
    try:
        seen = label(scene.detections, frame)
    except LabellingRefusedError:
        return Outcome(scene.solvable, False, time.process_time() - started)
    seconds = time.process_time() - started
    misread = (seen.view, seen.mirrored) != (scene.view, scene.mirrored)
    wrong, false, right = _judged(seen, scene)
    share = right / max(1, sum(len(truth) == 1 for truth in scene.truth))
    return Outcome(scene.solvable, True, seconds, wrong, false, misread, share)


def _judged(seen: Observations, scene: Scene) -> tuple[int, int, int]:
    """Return the numbers of wrong labels, of labelled false candidates, and of right labels."""
    truths = {tuple(uv): truth for uv, truth in zip(scene.detections.uv_px, scene.truth, strict=True)}
    of = [truths[tuple(uv)] for uv in seen.uv_px]
    wrong = sum(bool(truth) and name not in truth for name, truth in zip(seen.ids, of, strict=True))
    false = sum(not truth for truth in of)
    return wrong, false, len(of) - wrong - false


def _solids(share: int) -> Rows:
    rows, counts = Rows("cloud"), [max(BLOCK, int(SCENES * kind.share / share)) for kind in KINDS]
    starts = [(kind, first) for kind, count in enumerate(counts) for first in range(0, count, BLOCK)]
    jobs = list(zip(starts, trials(_solid_scenes, starts), strict=True))
    of_kind = [[scene for (number, _), job in jobs if number == kind for scene in job] for kind in range(len(KINDS))]
    every = [scene for scenes in of_kind for scene in scenes]
    mistaken = sum(scene.mistaken for scene in every)
    rows.none("scenes with a wrong label or handedness", mistaken, f"{len(every):,}")
    rows.add("false detections taken for hidden balls", f"{sum(s.false for s in every)} in {len(every):,} scenes")
    for kind, scenes in zip(KINDS, of_kind, strict=True):
        solvable = [scene for scene in scenes if scene.solvable]
        rate = 100 * np.mean([scene.labelled for scene in solvable or scenes])
        where = f" where nine balls are seen ({len(solvable):,})" if solvable else ""
        least = MIN_LABELLED["cloud"] if solvable else -np.inf
        rows.number(f"labelled{where}: {kind.name}", rate, ".2f", "%", least=least)
        taken = 1e3 * np.array([scene.seconds for scene in scenes])
        name = f"processor time, median; 99 % {np.quantile(taken, 0.99):.0f} ms: {kind.name}"
        rows.number(name, np.median(taken), ".1f", "ms", most=kind.most_ms)
    return rows


def _solid_scenes(start: tuple[int, int]) -> list[Outcome]:
    kind, first = start
    return [_solid_scene(KINDS[kind], number) for number in range(first, first + BLOCK)]


def _solid_scene(kind: Kind, number: int) -> Outcome:
    rng = np.random.default_rng([SOLID_SEED, number])
    cloud = kind.cloud(rng)
    scene = draw_cloud_scene(rng, cloud, hidden=kind.hidden, false=kind.false)
    width = scene.detections.image_shape[1]
    focal_px = scene.focal_px if kind.focal_known else (1.8 * width, 8.0 * width)
    started = time.process_time()
    try:
        match = label_cloud(scene.detections, *cloud, focal_px, BALL_SD_MM)
    except LabellingRefusedError:
        return Outcome(scene.clear >= SEEN, False, time.process_time() - started)
    seconds, truth = time.process_time() - started, scene.truth[match.rows]
    wrong, false = int(((truth >= 0) & (truth != match.balls)).sum()), int((truth < 0).sum())
    share = (len(truth) - wrong - false) / max(1, scene.clear)
    return Outcome(scene.clear >= SEEN, True, seconds, wrong, false, match.mirrored != scene.mirrored, share)
