"""Bead centres in hard images of the twin against the Cramér-Rao bound; finders of OpenCV and trackpy beside them."""

from collections.abc import Callable

import numpy as np

from benchmarks.bench_detection import blobs_of_opencv, blobs_of_trackpy
from benchmarks.centroid_bound import centroid_bounds
from benchmarks.rows import Row
from sightline.detection import Detections, detect
from sightline.detection.labelling.label import label
from sightline.errors import DetectionRefusedError, LabellingRefusedError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.twin.hard import BeadTruth, hard_scene

_FINDABLE_PX = 0.5  # a bead counts where the image determines its centre at least this well
_FOUND_PX = 2.0
_PEERS: dict[str, Callable[[Radiograph], np.ndarray]] = {"opencv": blobs_of_opencv, "trackpy": blobs_of_trackpy}


def run(quick: bool) -> list[Row]:
    """Rows of the table; `quick` takes 2 hard images per dose class instead of 67."""
    return [row for dose in ("low", "medium", "high") for row in _dose(dose, 2 if quick else 67)]


def _dose(dose: str, images: int) -> list[Row]:
    counts = dict.fromkeys(("all", "ours", "images", "labelled", "false", *_PEERS), 0)
    errors, stated, named = [np.empty(0)], [np.empty(0)], [np.empty(0)]
    for seed in range(images):
        image, truth = hard_scene(np.random.default_rng([20, seed]), dose)
        bounds = centroid_bounds(truth)
        findable = np.trace(bounds, axis1=1, axis2=2) / 2 < _FINDABLE_PX**2
        counts["all"] += int(findable.sum())
        beads = _detected(image)
        if beads is not None:
            error, row = _errors(beads, truth, findable)
            counts["ours"] += len(error)
            errors.append(_squares(error, bounds[row[0]]))
            stated.append(_squares(error, beads.covariance_px2[row[1]]))
            false, squares = _labelled(beads, truth)
            counts["images"] += len(squares) > 0
            counts["labelled"] += len(squares)
            counts["false"] += false
            named.append(squares)
        for name, peer in _PEERS.items():
            places = peer(image)
            if len(places):
                apart = np.linalg.norm(places[:, None] - truth.shadow_px[findable][None], axis=-1)
                counts[name] += int((apart.min(axis=0) < _FOUND_PX).sum())
    recall = counts["ours"] / counts["all"]
    beside = ", ".join(f"{name} {counts[name] / counts['all']:.3f}" for name in _PEERS)
    ratio, honest = float(np.sqrt(np.concatenate(errors).mean())), float(np.concatenate(stated).mean())
    middle, of_named = float(np.median(np.concatenate(errors))), float(np.concatenate(named).mean())
    return [
        Row(
            "detection", f"recall where the bound < 0.5 px, {dose}", f"{recall:.3f}", ">= 0.99", beside, recall >= 0.99
        ),
        Row("detection", f"rms (error / bound), {dose}", f"{ratio:.2f}", "<= 1.2", met=ratio <= 1.2),
        Row("detection", f"median of (error / bound)², {dose}", f"{middle:.2f}", "0.69 of an efficient one"),
        Row(
            "detection",
            f"mean chi-square / 2 of stated covariance, {dose}",
            f"{honest:.2f}",
            "0.85-1.2",
            met=0.85 <= honest <= 1.2,
        ),
        Row("detection", f"the same of the {counts['labelled']} beads that were labelled, {dose}", f"{of_named:.2f}"),
        Row(
            "detection",
            f"false beads after labelling, {counts['images']} of {images} images labelled, {dose}",
            f"{counts['false']}",
            "0",
            met=counts["false"] == 0,
        ),
    ]


def _detected(image: Radiograph) -> Detections | None:
    try:
        return detect(image)
    except DetectionRefusedError:
        return None


def _labelled(beads: Detections, truth: BeadTruth) -> tuple[int, np.ndarray]:
    """Of the labelled beads how many are not where theirs is, and the squared normalised errors of the others."""
    try:
        seen = label(beads, Frame.load("gamma"))
    except LabellingRefusedError:
        return 0, np.empty(0)
    row = {name: i for i, name in enumerate(truth.ids)}
    theirs = np.array([row.get(name, -1) for name in seen.ids])
    error = seen.uv_px - truth.shadow_px[theirs]
    right = (theirs >= 0) & (np.linalg.norm(error, axis=1) < _FOUND_PX)
    assert seen.covariance_px2 is not None
    return int((~right).sum()), _squares(error[right], seen.covariance_px2[right])


def _errors(beads: Detections, truth: BeadTruth, findable: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Errors (M, 2) of the findable beads that were found; rows of the truth and of the detections."""
    apart = np.linalg.norm(truth.shadow_px[:, None] - beads.uv_px[None], axis=-1)
    nearest = apart.argmin(axis=1)
    seen = np.flatnonzero(findable & (apart.min(axis=1) < _FOUND_PX))
    return beads.uv_px[nearest[seen]] - truth.shadow_px[seen], (seen, nearest[seen])


def _squares(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squared error in units of its covariance, per axis."""
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) / 2
