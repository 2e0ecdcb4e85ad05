"""The plan drawn on an image: pixels of entry, end and wire, and a copy of the image with them burnt in."""

from dataclasses import dataclass

import cv2
import numpy as np

from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.interop.plan_file import PlanFile

STRETCH = (0.5, 99.5)  # percentiles of the pixels that become black and white [ours]


@dataclass(frozen=True, eq=False)
class PlanOverlay:
    """Entry and end point (2,), and the wire from entry to end (M, 2), IDCS of the image that is drawn on."""

    entry_px: np.ndarray
    end_px: np.ndarray
    wire_px: np.ndarray


def on_plate(plan: PlanFile, pinhole: Pinhole) -> PlanOverlay:
    """Return the projected plan, not the picks, in a pinhole's image, where the wire is straight."""
    entry, end = pinhole.view().project(plan.points_mm)
    return PlanOverlay(entry, end, np.stack([entry, end]))


def burn_in(pixels: np.ndarray, drawn: PlanOverlay, words: str) -> np.ndarray:
    """Return the image (H, W) as uint8, contrast stretched, with `words` and the wire in white with a black rim."""
    low, high = np.percentile(pixels, STRETCH)
    shown = np.clip((pixels.astype(np.float32) - low) / max(float(high - low), 1e-6) * 255, 0, 255).astype(np.uint8)
    fine = 16  # OpenCV draws to 1/16 px
    path = np.rint(drawn.wire_px * fine).astype(np.int32).reshape(-1, 1, 2)
    for colour, width in ((0, 5), (255, 1)):
        cv2.polylines(shown, [path], False, colour, width, cv2.LINE_AA, 4)
        for place in (drawn.entry_px, drawn.end_px):
            u, v = (int(x) for x in np.rint(np.asarray(place) * fine))
            cv2.circle(shown, (u, v), 6 * fine, colour, width, cv2.LINE_AA, 4)
        cv2.putText(shown, words, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA)
    return shown
