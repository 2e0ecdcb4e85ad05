"""Bead centres in real and hard simulated images, beside OpenCV, trackpy and the Cramér-Rao bound; the second look.

Against the bound a bead counts if its image determines its centre to 0.5 px. For the second look it counts if its image
determines its centre to 0.25 px (quadratic background) and its view was labelled. Its kind: clipped where more than 0.3
of its surroundings are; beside metal where metal lies within 4 px of its rim; overlapping by a share of the smaller
radius. The seeds were not used for tuning. Scatter follows the object. Each scene is exposed at each dose: the noise of
one exposure alone moves error / stated of twenty beads by a tenth.

That bound takes the light behind two balls for known. Beads in deep overlaps are counted again if the pixels that
only they change determine them (`own`).
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from benchmarks import blobs
from benchmarks.centroid_bound import centroid_bounds
from benchmarks.harness import ARCADIS, Refusal, Row, Rows, finished, mahalanobis2, rms, trials
from sightline.detection import Observations, detect, label, look_again
from sightline.errors import DetectionRefusedError, LabellingRefusedError
from sightline.frame import Frame
from sightline.imaging import read_image
from sightline.twin.scenes.hard import BeadTruth, HardView, hard_scene, hard_view
from sightline.twin.xray.setup import shadow_centres_px

DOSES = ("low", "medium", "high")
IMAGES, SCENES = 20, 20  # of each dose, against the bound; for the second look
BOUND_PX, LOOK_PX = 0.5, 0.25  # within which a bead that counts is determined
FOUND_PX = 2.0
OPENCV = {"minArea": np.pi * 4, "maxArea": np.pi * 625, "minThreshold": 10, "maxThreshold": 250, "thresholdStep": 10,
          "minDistBetweenBlobs": 5}  # dark blobs of 2-25 px radius  # fmt: skip
SMALL_PX = 19  # diameter of the smaller balls

DEEP = tuple(f"overlap {what}" for what in ("0.4 to 0.8", "0.8 to 1.2", "1.2 to 1.6", "above 1.6"))
METAL_PX, CLIPPED, TOUCHING = 4.0, 0.3, -0.4
ISOLATED_PX = 6.0  # from rim to rim, or to the field's edge: nothing else lies in the window of the fit
EDGE = 0.15  # of the light around a bead: range beyond which a bone's edge, not its slope alone, lies in the window


def run(quick: bool) -> list[Row]:
    """Return the rows; `quick` uses 2 hard images of each dose and 3 scenes."""
    return _real() + _against_bound(2 if quick else IMAGES) + _second_look(3 if quick else SCENES)


def _real() -> Rows:
    rows = Rows("detection")
    if not ARCADIS.is_dir():
        rows.add("ARCADIS images", "absent, skipped")
        return rows
    counts, holes = [], []
    for name in ("beads_0", "beads_orbit30", "beads_orbit60", "beads_spine_0"):
        beads = detect(read_image(ARCADIS / f"{name}.dcm"))
        size = beads.radius_px / np.median(beads.radius_px)
        small, large = int((abs(size - 1) < 0.15).sum()), int(((size > 1.4) & (size < 2)).sum())
        counts.append((small, large, len(beads) - small - large))
    value = "; ".join("{} small + {} large, {} of no ball's size".format(*count) for count in counts)
    met = set(counts) == {(16, 2, 0)}
    rows.add("ARCADIS beads_0, orbit30, orbit60, spine_0", value, "16 small + 2 large, no other", met)
    for name in ("plate_0", "plate_orbit30", "plate_orbit60"):
        holes.append(detect(read_image(ARCADIS / f"{name}.dcm")).kind.count("hole"))
    rows.number("ARCADIS plate_0 / orbit30 / orbit60", holes, ",", "holes", least=3500)
    return rows


def _against_bound(images: int) -> Rows:
    rows, all_of = Rows("detection"), trials(_scored, product(DOSES, range(images)))
    by_dose = [all_of[k * images : (k + 1) * images] for k in range(len(DOSES))]
    keys = all_of[0]["counts"]
    counts = [{key: sum(image["counts"][key] for image in dose) for key in keys} for dose in by_dose]
    keys = ("bound", "stated", "labelled")
    squares = [{key: np.concatenate([image[key] for image in dose]) for key in keys} for dose in by_dose]

    def recall(name: str) -> list[float]:
        return [count[name] / count["findable"] for count in counts]

    others = ("detect alone", "OpenCV", "trackpy")
    beside = ", ".join(f"{name} {' / '.join(f'{share:.3f}' for share in recall(name))}" for name in others)
    name = f"recall where the own bound is under {BOUND_PX} px, low / medium / high dose, {images} scenes each"
    rows.number(name, recall("either"), peer=beside, least=0.99)
    rows.number("rms (error / own bound), low / medium / high dose", [rms(np.sqrt(s["bound"])) for s in squares], ".2f",
                most=1.2)  # fmt: skip
    rows.number("median of (error / bound)²; of an efficient one 0.69", [np.median(s["bound"]) for s in squares], ".2f")
    for name in ("stated", "labelled"):
        honest = [s[name].mean() for s in squares]
        of = "all" if name == "stated" else "labelled beads"
        rows.number(f"mean chi-square / 2 of the stated covariance: {of}", honest, ".2f", least=0.85, most=1.2)
    beads, labelled = sum(len(s["labelled"]) for s in squares), sum(count["images"] for count in counts)
    name = f"false beads after labelling ({labelled} of {len(all_of)} scenes labelled, {beads:,} beads)"
    rows.none(name, sum(count["false"] for count in counts))
    return rows


def _scored(case: tuple[str, int]) -> dict[str, Any]:
    """Return the squared errors of one hard image over the bound, over their stated covariance, and over that of the
    labelled beads; and counts."""
    dose, seed = case
    image, truth = hard_scene(np.random.default_rng([20, seed]), dose)
    bounds = centroid_bounds(truth)
    findable = np.trace(bounds, axis1=1, axis2=2) / 2 < BOUND_PX**2
    scores: dict[str, Any] = {key: np.empty(0) for key in ("bound", "stated", "labelled")}
    counts = dict.fromkeys(("detect alone", "either", "images", "false"), 0) | {"findable": int(findable.sum())}
    peers = {"OpenCV": blobs.opencv(**OPENCV), "trackpy": blobs.trackpy(SMALL_PX, characterize=False)}
    for name, peer in peers.items():
        places = peer(image.pixels.astype(np.float64) if name == "trackpy" else image.pixels, image.white)
        apart = np.linalg.norm(places[:, None] - truth.shadow_px[findable][None], axis=-1)
        counts[name] = int((apart.min(axis=0) < FOUND_PX).sum()) if len(places) else 0
    found: set[int] = set()
    try:
        beads = detect(image)
        apart = np.linalg.norm(truth.shadow_px[:, None] - beads.uv_px[None], axis=-1)
        rows = np.flatnonzero(findable & (apart.min(axis=1) < FOUND_PX))
        nearest = apart.argmin(axis=1)[rows]
        error = beads.uv_px[nearest] - truth.shadow_px[rows]
        scores["bound"] = mahalanobis2(error, bounds[rows]) / 2
        scores["stated"] = mahalanobis2(error, beads.covariance_px2[nearest]) / 2
        found, counts["detect alone"] = set(rows.tolist()), len(rows)
        frame = Frame.load("gamma")
        labelled = label(beads, frame)
        counts["images"] = 1
        for seen in (labelled, look_again(image, beads, labelled, frame)):
            theirs, right, scores["labelled"] = _labelled(seen, truth)
            found |= set(theirs[right & findable[theirs]].tolist())
            counts["false"] = int((~right).sum())
    except (DetectionRefusedError, LabellingRefusedError):
        pass
    return {**scores, "counts": {**counts, "either": len(found)}}


def _labelled(seen: Observations, truth: BeadTruth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for labelled beads (N,) the rows of the truth, whether they are right, and the squared errors of those."""
    assert seen.covariance_px2 is not None
    row = {name: i for i, name in enumerate(truth.ids)}
    theirs = np.array([row.get(name, -1) for name in seen.ids])
    error = seen.uv_px - truth.shadow_px[theirs]
    right = (theirs >= 0) & (np.linalg.norm(error, axis=1) < FOUND_PX)
    return theirs, right, mahalanobis2(error[right], seen.covariance_px2[right]) / 2


@dataclass(frozen=True, eq=False)
class _Bead:
    """A bead: its kind, the dose, whether labelling alone and the second look found it, half its squared normalised
    error, and whether its own pixels determine it."""

    kind: str
    dose: str
    at_first: bool
    found: bool
    square: float
    own: bool


def _second_look(number: int) -> Rows:
    rows = Rows("second look")
    views, refused = finished([view for scene in trials(_views, range(number)) for view in scene])
    beads = [bead for view in views for bead in view[0]]

    def of(*kinds: str, own: bool = False) -> list[list[_Bead]]:
        return [[bead for bead in beads if bead.kind == kind and (bead.own or not own)] for kind in kinds]

    clear = [bead for bead in beads if bead.kind != "clipped"]
    simple, limits = ("free", "bone edge", "touching"), (0.998, 0.99, 0.99)
    _add_recall(rows, "recall by what covers a bead: free / bone edge / touching", of(*simple), limits)
    _add_recall(rows, "recall of overlaps by 0.4-0.8 / 0.8-1.2 / 1.2-1.6 / above 1.6 radii", of(*DEEP), 4 * (0.9,))
    name = f"overlapping, of the beads that the pixels of their own shadow determine to {LOOK_PX} px"
    _add_recall(rows, name, of(*DEEP, own=True), 4 * (0.9,))
    _add_recall(rows, "beside metal", of("beside metal"), (0.85,))
    _add_recall(rows, "clipped surroundings", of("clipped"), ())
    _add_recall(rows, "all / all but clipped", [beads, clear], (0.98, 0.98))
    name = "error / stated s.d.: "
    _add_honesty(rows, f"{name}free, bone edge, touching, beside metal", of(*simple, "beside metal"))
    _add_honesty(rows, f"{name}overlaps of 0.4-0.8 / 0.8-1.2 / 1.2-1.6 / above 1.6", of(*DEEP))
    _add_honesty(rows, f"{name}clipped surroundings", of("clipped"))
    by_dose = [[bead for bead in beads if bead.dose == dose] for dose in DOSES]
    _add_honesty(rows, f"{name}all beads, low / medium / high dose", by_dose)
    rows.none(f"false beads in {len(views)} images; refused {refused}", sum(false for _, false in views))
    return rows


def _add_recall(rows: Rows, name: str, groups: Sequence[Sequence[_Bead]], limits: Sequence[float]) -> None:
    recall = [np.mean([bead.found for bead in group]) for group in groups]
    first = [np.mean([bead.at_first for bead in group]) for group in groups]
    name = f"{name} ({' / '.join(f'{len(group):,}' for group in groups)})"
    value, peer = (" / ".join(f"{share:.3f}" for share in shares) for shares in (recall, first))
    met = all(share >= limit for share, limit in zip(recall, limits, strict=True)) if limits else None
    asked = f">= {' / '.join(f'{limit:g}' for limit in limits)}" if limits else ""
    rows.add(name, value, asked, met, peer=f"labelling alone {peer}")


def _add_honesty(rows: Rows, name: str, groups: Sequence[Sequence[_Bead]]) -> None:
    squares = [np.array([bead.square for bead in group if bead.found]) for group in groups]
    name = f"{name} ({' / '.join(f'{len(each):,}' for each in squares)})"
    rows.number(name, [np.sqrt(each.mean()) if len(each) else np.nan for each in squares], ".2f", least=0.9, most=1.15)


def _views(seed: int) -> list[tuple[list[_Bead], int] | Refusal]:
    """Return one scene at each dose, that which its seed draws first; or why an image has no beads."""
    warnings.simplefilter("ignore", RuntimeWarning)  # of bounds where no bead is whole
    rng = np.random.default_rng([78, seed])
    scene = hard_view(rng)
    return [_view(scene, rng, DOSES[(seed + k) % len(DOSES)]) for k in range(len(DOSES))]


def _view(scene: HardView, rng: np.random.Generator, dose: str) -> tuple[list[_Bead], int] | Refusal:
    """Return the beads of one exposure, and the number of false ones; or why there are none."""
    frame = Frame.load("gamma")
    image, truth = scene.exposed(rng, dose, even_scatter=False, scatter_mm=12.0)
    bound, own = (np.sqrt(np.trace(centroid_bounds(truth, own=each), axis1=1, axis2=2) / 2) for each in (False, True))
    try:
        beads = detect(image)
        labelled = label(beads, frame)
    except (DetectionRefusedError, LabellingRefusedError) as refused:
        return Refusal(f"{dose} dose: {refused}")
    seen = look_again(image, beads, labelled, frame)
    assert seen.covariance_px2 is not None
    balls = scene.setup.true_frame.fiducials  # also those whose centres lie just outside the field
    xyz, radius = np.array([ball.xyz_mm for ball in balls]), np.array([ball.diameter_mm / 2 for ball in balls])
    place = dict(zip([ball.id for ball in balls], shadow_centres_px(scene.projection.view, xyz, radius), strict=True))
    row, kinds, plates = {name: k for k, name in enumerate(seen.ids)}, covers(truth), frame.view(labelled.view).by_id
    false = sum(np.hypot(*(seen.uv_px[k] - place[name])) > FOUND_PX for name, k in row.items())
    counted = []
    for i in np.flatnonzero((bound < LOOK_PX) & [name in plates for name in truth.ids]):
        k = row.get(truth.ids[i])
        error = np.zeros(2) if k is None else seen.uv_px[k] - truth.shadow_px[i]
        square = 0.0 if k is None else float(mahalanobis2(error, seen.covariance_px2[k])) / 2
        at_first = truth.ids[i] in labelled.ids
        counted.append(_Bead(kinds[i], dose, at_first, k is not None, square, bool(own[i] < LOOK_PX)))
    return counted, int(false)


def covers(truth: BeadTruth) -> list[str]:
    """Return what covers each bead."""
    radius = truth.radius_px
    between = np.linalg.norm(truth.shadow_px[:, None] - truth.shadow_px, axis=-1) - radius[:, None] - radius
    np.fill_diagonal(between, np.inf)
    overlap = (-between / np.minimum(radius[:, None], radius)).max(axis=1)
    metal = (truth.gap_px < between.min(axis=1) - 0.5) & (truth.gap_px < METAL_PX)
    deep = np.array(DEEP)[np.clip(np.searchsorted([0.8, 1.2, 1.6], overlap), 0, 3)]
    alone = (truth.rim_px > ISOLATED_PX) & (truth.saturated == 0) & (truth.gap_px > ISOLATED_PX)
    lying = [truth.saturated > CLIPPED, metal, overlap > 0.4, overlap > TOUCHING, alone & (_bends(truth) > EDGE)]
    return np.select(lying, ["clipped", "beside metal", deep, "touching", "bone edge"], "free").tolist()


def _bends(truth: BeadTruth) -> np.ndarray:
    """Return the range (N,) of the background around each bead, after subtracting a plane, over its mean."""
    light = truth.exposure.open_pixels() - truth.exposure.black
    ranges = np.zeros(len(truth))
    for i, ((u, v), radius) in enumerate(zip(truth.shadow_px, truth.radius_px, strict=True)):
        reach = int(radius) + 5
        left, top = max(round(u) - reach, 0), max(round(v) - reach, 0)
        part = light[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
        y, x = np.mgrid[: part.shape[0], : part.shape[1]]
        design = np.stack([np.ones(part.size), x.ravel(), y.ravel()], axis=1)
        plane = design @ np.linalg.lstsq(design, part.ravel())[0]
        ranges[i] = np.ptp(part.ravel() - plane) / part.mean()
    return ranges
