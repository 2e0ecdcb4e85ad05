"""Detection on ARCADIS images and hard images of the twin, and its time; SimpleBlobDetector and trackpy beside it."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.rows import Row
from sightline.detection import detect
from sightline.errors import DetectionRefusedError
from sightline.imaging import Radiograph, read_image
from sightline.twin.hard import hard_scene

_DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "arcadis"
_BEADS = ("beads_0", "beads_orbit30", "beads_orbit60", "beads_spine_0")
_PLATES = ("plate_0", "plate_orbit30", "plate_orbit60")
_LEAST_GAP_PX = 2.0  # below it another sharp thing covers the rim


def run(quick: bool) -> list[Row]:
    """Rows of the table; `quick` takes 2 hard images per dose class instead of 67."""
    return _arcadis() + _hard(2 if quick else 67) + _time()


def _found(image: Radiograph) -> np.ndarray:
    try:
        return detect(image).uv_px
    except DetectionRefusedError:
        return np.empty((0, 2))


def blobs_of_opencv(image: Radiograph) -> np.ndarray:
    """Dark blobs of 2-25 px radius by SimpleBlobDetector, at 8 bit, thresholds 10 apart."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = np.pi * 4, np.pi * 625
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 10, 250, 10
    parameters.minDistBetweenBlobs = 5
    pixels = np.uint8(image.pixels * (255.0 / image.white))
    return np.array([k.pt for k in cv2.SimpleBlobDetector.create(parameters).detect(pixels)]).reshape(-1, 2)


def blobs_of_trackpy(image: Radiograph) -> np.ndarray:
    """Dark blobs by trackpy.locate at the diameter of the smaller balls (19 px)."""
    import trackpy  # pyright: ignore[reportMissingImports]

    trackpy.quiet()
    frame = trackpy.locate(image.pixels.astype(np.float64), 19, invert=True, engine="numba", characterize=False)
    return frame[["x", "y"]].to_numpy()


def _arcadis() -> list[Row]:
    if not _DATA.is_dir():
        return [Row("detection", "ARCADIS images: absent, skipped", "")]
    rows = []
    for name in _BEADS:
        found = detect(read_image(_DATA / f"{name}.dcm"))
        size = found.radius_px / np.median(found.radius_px)
        small, large = int((abs(size - 1) < 0.15).sum()), int(((size > 1.4) & (size < 2)).sum())
        figure = f"{small} small + {large} large + {len(found) - small - large} of no ball's size"
        met = (small, large, len(found)) == (16, 2, 18)
        rows.append(Row("detection", name, figure, "16 small + 2 large, no other", met=met))
    for name in _PLATES:
        found = detect(read_image(_DATA / f"{name}.dcm"))
        holes = found.kind.count("hole")
        rows.append(Row("detection", name, f"{holes} holes", ">= 3500", met=holes >= 3500))
    return rows


def _hard(images: int) -> list[Row]:
    peers: dict[str, Callable[[Radiograph], np.ndarray]] = {"opencv": blobs_of_opencv, "trackpy": blobs_of_trackpy}
    rows = []
    for dose in ("low", "medium", "high"):
        seen, false, hits, normalised = 0, 0, dict.fromkeys(("ours", *peers), 0), []
        for seed in range(images):
            image, truth = hard_scene(np.random.default_rng([20, seed]), dose)
            clear = (truth.gap_px > _LEAST_GAP_PX) & (truth.rim_px > 0)
            seen += int(clear.sum())
            beads = detect(image)
            apart = np.linalg.norm(beads.uv_px[:, None] - truth.uv_px[None], axis=-1)
            false += int((apart.min(axis=1) > 5).sum())
            nearest = apart.argmin(axis=0)[clear]
            hit = apart.min(axis=0)[clear] < 2
            hits["ours"] += int(hit.sum())
            error = (beads.uv_px[nearest] - truth.uv_px[clear])[hit]
            cov = beads.covariance_px2[nearest][hit]
            normalised.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error) / 2)
            for name, peer in peers.items():
                places = peer(image)
                near = np.linalg.norm(places[:, None] - truth.uv_px[clear][None], axis=-1) if len(places) else None
                hits[name] += 0 if near is None else int((near.min(axis=0) < 2).sum())
        recall = hits["ours"] / seen
        beside = ", ".join(f"{name} {hits[name] / seen:.3f}" for name in peers)
        rows.append(
            Row("detection", f"recall of clear beads, {dose} dose", f"{recall:.3f}", ">= 0.99", beside, recall >= 0.99)
        )
        rms = float(np.sqrt(np.concatenate(normalised).mean()))
        rows.append(Row("detection", f"rms (error / stated s.d.), {dose} dose", f"{rms:.2f}", "1"))
        rows.append(Row("detection", f"false beads before labelling, {dose} dose", f"{false / images:.2f} per image"))
    return rows


def _best_ms(what: Callable[[], object], times: int = 7) -> float:
    what()
    taken = []
    for _ in range(times):
        started = time.perf_counter()
        what()
        taken.append(time.perf_counter() - started)
    return 1e3 * min(taken)


def _time() -> list[Row]:
    image, _ = hard_scene(np.random.default_rng([20, 0]), "medium")
    pixels, white = np.array(image.pixels), image.white
    ours = _best_ms(lambda: _found(Radiograph(pixels, white)))
    peers = {
        "opencv": _best_ms(lambda: blobs_of_opencv(image)),
        "trackpy": _best_ms(lambda: blobs_of_trackpy(image), 3),
    }
    beside = ", ".join(f"{name} {ms:.0f} ms" for name, ms in peers.items())
    name = f"detect, field mask included, 1024², {os.cpu_count()} cores, best of 7"
    return [Row("detection", name, f"{ours:.0f} ms", "<= 18 ms", beside, ours <= 18)]
