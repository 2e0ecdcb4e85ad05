"""Draw docs/pictures/registered.png: a CT registered to two images of the twin.

`python tools/draw_registered.py FOLDER FILE`: in FOLDER the commands of docs/register-bone.md were run.
"""

import sys
from pathlib import Path

import sightline as sl
from sightline.calibration.exchange.pose_file import read_pose
from sightline.from_images.registration import BoneStart

DPI = 120


def main(folder: str, file: str) -> None:
    """Write the picture."""
    paths = [Path(folder) / f"out/hip/{view}.dcm" for view in ("pa", "lateral")]
    views = [sl.calibrate_image(path, "gamma") for path in paths]
    images = [sl.read_image(path) for path in paths]
    start = BoneStart(read_pose(Path(folder) / "out/bone/bone-pose.json"))
    found = sl.register_bone(Path(folder) / "bone.nrrd", images, views, start)
    Path(file).write_bytes(found.png(DPI))


if __name__ == "__main__":
    main(*sys.argv[1:])
