"""Labelling of random scenes of points: shares labelled, refused and labelled wrongly."""

import time
from dataclasses import dataclass

import numpy as np

from benchmarks.labelling.plate_scenes import Scene, clean_views, draw_scene
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.detection import Observations, label
from sightline.errors import LabellingRefusedError
from sightline.frame import Frame
from sightline.twin.xray.presets import PRESETS

SCENES = 10_000
BLOCK = 250
SEED = 2


@dataclass(frozen=True)
class Outcome:
    """Result of one scene. `wrong`: beads with another bead's id; `false`: false candidates with an id."""

    number: int
    solvable: bool
    refusal: str | None
    wrong: int
    false: int
    misread: bool  # view or handedness
    share: float  # of the beads seen that were labelled
    seconds: float


def _judged(observations: Observations, scene: Scene) -> tuple[int, int, float]:
    """Return the numbers of wrong labels and labelled false candidates, and the share of beads labelled correctly."""
    at = {tuple(uv): truth for uv, truth in zip(scene.detections.uv_px, scene.truth, strict=True)}
    found = [(one, at[tuple(uv)]) for one, uv in zip(observations.ids, observations.uv_px, strict=True)]
    wrong = sum(bool(truth) and one not in truth for one, truth in found)
    false = sum(not truth for _, truth in found)
    return wrong, false, (len(found) - wrong - false) / max(1, sum(len(truth) == 1 for truth in scene.truth))


def outcome(frame: Frame, number: int, seed: int = SEED) -> Outcome:
    """Return the result of scene `number` of the benchmark."""
    scene = draw_scene(np.random.default_rng([seed, number]), frame)
    started = time.process_time()
    try:
        found = label(scene.detections, frame)
    except LabellingRefusedError as refusal:
        return Outcome(number, scene.solvable, str(refusal), 0, 0, False, 0.0, time.process_time() - started)
    seconds = time.process_time() - started
    misread = (found.view, found.mirrored) != (scene.view, scene.mirrored)
    return Outcome(number, scene.solvable, None, *_judged(found, scene)[:2], misread, _judged(found, scene)[2], seconds)


def _block(start: int) -> list[Outcome]:
    frame = Frame.load("gamma")
    return [outcome(frame, number) for number in range(start, start + BLOCK)]


def _refused_clean(chain: str, cropped: bool, count: int) -> tuple[int, int]:
    """Return how many of `count` clean views are refused or labelled wrongly, and how many correctly."""
    frame, wrong, right, seed = Frame.load("gamma"), 0, 0, 0
    while wrong + right < count:
        for scene in clean_views(np.random.default_rng([9, seed]), frame, chain, cropped=cropped):
            if scene.solvable:
                try:
                    good = _judged(label(scene.detections, frame), scene)[:2] == (0, 0)
                except LabellingRefusedError:
                    good = False
                wrong, right = wrong + (not good), right + good
        seed += 1
    return wrong, right


def _clean_rows(count: int) -> list[Row]:
    rows = []
    for chain in PRESETS:
        for cropped in (False, True):
            wrong, right = _refused_clean(chain, cropped, count)
            name = f"{chain}{', cropped' if cropped else ''}: refused or wrong, of {wrong + right}"
            rows.append(Row("labelling, clean views of the twin", name, str(wrong), "0", met=wrong == 0))
    return rows


def run(quick: bool = False) -> list[Row]:
    """Return the rows of this benchmark."""
    starts = range(0, SCENES // 10 if quick else SCENES, BLOCK)
    every = [scene for block in in_parallel(_block, starts) for scene in block]
    solvable = [one for one in every if one.solvable]
    labelled = [one for one in every if one.refusal is None]
    fewer = [one for one in every if not one.solvable]
    known = [one for one in fewer if one.refusal is None]
    mistaken = sum(one.wrong + one.false > 0 or one.misread for one in known)
    rate = np.mean([one.refusal is None for one in solvable])
    wrong = sum(one.wrong for one in every)
    false = sum(one.false for one in every)
    misread = sum(one.misread for one in every)
    share = np.mean([one.share for one in labelled])
    warm_ms = 1e3 * np.median([one.seconds for one in every])
    group = f"labelling, {len(every)} scenes"
    return [
        Row(
            group,
            f"labelled where 3 datums of each plate remain ({len(solvable)} scenes)",
            f"{rate:.2%}",
            ">= 98 %",
            met=bool(rate >= 0.98),
        ),
        Row(
            group,
            f"fewer than 3 datums of a plate remain ({len(fewer)} scenes): labelled / refused / wrong",
            f"{len(known)} / {len(fewer) - len(known)} / {mistaken}",
            "wrong 0",
            met=mistaken == 0,
        ),
        Row(group, "labelled, of all scenes", f"{len(labelled) / len(every):.2%}"),
        Row(group, "beads labelled wrongly", str(wrong), "0", met=wrong == 0),
        Row(group, "false candidates taken for hidden beads", str(false), "0", met=false == 0),
        Row(group, "views or mirror images misread", str(misread), "0", met=misread == 0),
        Row(group, "beads seen that were labelled, where labelled", f"{share:.1%}"),
        Row(group, "median processor time of one image", f"{warm_ms:.1f} ms"),
        *_clean_rows(50 if quick else 500),
    ]
