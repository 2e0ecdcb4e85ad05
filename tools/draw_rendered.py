"""Draw docs/pictures/rendered.jpg: an image of the twin, and its bone alone as the image's calibrated view sees it.

`python tools/draw_rendered.py FILE`
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import sightline as sl
from sightline.imaging import Radiograph, write_dicom
from sightline.imaging.volumes import CtScan
from sightline.imaging.volumes.ct import AIR_HU
from sightline.imaging.volumes.filled import CORTICAL_HU
from sightline.twin import render
from sightline.twin.scenes.specimens import SetUpSpec, specimen

SEED, SIDE = 3, 512


def main(file: str) -> None:
    """Write the picture."""
    rng = np.random.default_rng(SEED)
    drawn = specimen("hip", rng, SetUpSpec(sl.Frame.load("gamma")))
    image = render(drawn.setup, "pa", drawn.scene, rng)
    dicom = write_dicom(image, Path(file).with_suffix(".dcm"))
    view = sl.calibrate_image(dicom, "gamma", "pa")
    dicom.unlink()
    bone = drawn.scene.volumes[0]
    hu = np.rint(AIR_HU + bone.values * (CORTICAL_HU - AIR_HU)).astype(np.int16)
    seen = sl.render(CtScan(hu, bone.origin_mm, bone.voxel_mm, bone.axes), view)
    cv2.imwrite(file, np.hstack([shown(image), np.full((SIDE, 8), 255, np.uint8), shown(seen)]))


def shown(image: Radiograph) -> np.ndarray:
    """Return an image (SIDE, SIDE) as uint8: the logarithm of its pixels, stretched."""
    small = cv2.resize(image.pixels.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    log = np.log(np.maximum(small, 1) / image.white)
    low, high = np.percentile(log[small > 0.01 * image.white], [0.5, 99.5])
    return np.clip((log - low) / (high - low) * 255, 0, 255).astype(np.uint8)


if __name__ == "__main__":
    main(sys.argv[1])
