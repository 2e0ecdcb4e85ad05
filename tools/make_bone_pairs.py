"""Make the stored pairs of tests/registration/test_pairs.py: a scan of a bone, two images of it, and the truth.

`PYTHONPATH=. python tools/make_bone_pairs.py [FOLDER]`, with gVirtualXray installed and the femur's mesh beside the
repository. Each pair is a file SEED.npz of at most 300 kB:

- `code_pa`, `code_lateral` (288, 288) uint8: roots of the light of 2 x 2 pixels, at most 127, so that noise
  has the same size everywhere: light = code², over the white `white_pa`, `white_lateral`
- `matrix_pa`, `matrix_lateral` (3, 4): CFCS, mm, to these pixels, exact
- `steps` (nx, ny, nz) uint8: the scan in steps of 32 HU from 0; `origin_mm`, `voxel_mm`, `axes` as of `CtScan`
- `pose` (4, 4): patient coordinates to CFCS; `targets_mm` (5, 3): patient coordinates, the first at the joint
- `strata`: JSON, what was drawn
"""

import json
import sys
from pathlib import Path

import numpy as np
from benchmarks.scenes.bones import BoneScene, draw_bone_scene, panel_matrix

FOLDER = Path("tests/registration/pairs")
BIN, STEP_HU, VOXEL_MM, TOP, LIMIT = 2, 32.0, 2.0, 127, 300_000
MOVED_MM = np.array([1.5, 3.4, 1.5])  # 4 mm: of the bone between the two images [ours]
DRAWN = {
    9500: {"anatomy_name": "femur", "chain": "panel", "overlap": False, "metal": False},
    9501: {"anatomy_name": "femur", "chain": "panel", "overlap": True, "metal": False},
    9502: {"anatomy_name": "pelvis", "chain": "panel", "overlap": False, "metal": False},
    9503: {"anatomy_name": "pelvis", "chain": "panel", "overlap": True, "metal": False},
    9504: {"anatomy_name": "vertebra", "chain": "panel", "overlap": False, "metal": False},
    9505: {"anatomy_name": "vertebra", "chain": "panel", "overlap": True, "metal": False},
    9506: {"anatomy_name": "femur", "chain": "panel", "overlap": False, "metal": True},
    9507: {"anatomy_name": "pelvis", "chain": "panel", "overlap": True, "metal": True},
    9508: {"anatomy_name": "femur", "chain": "panel low dose", "overlap": False, "metal": False},
    9509: {"anatomy_name": "vertebra", "chain": "panel JPEG", "overlap": False, "metal": False},
    9510: {"anatomy_name": "femur", "fault": "mirrored"},
    9511: {"anatomy_name": "femur", "fault": "other bone"},
    9512: {"anatomy_name": "pelvis", "fault": "scaled"},
    9513: {"anatomy_name": "vertebra", "fault": "swollen"},
    9514: {"anatomy_name": "femur", "fault": "fragment"},
    9515: {"anatomy_name": "femur"},  # the bone moves
}
MOVED = 9515


def main(folder: Path) -> None:
    """Write all pairs that are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, drawn in DRAWN.items():
        file = folder / f"{seed}.npz"
        if file.exists():
            continue
        plain = {"chain": "panel", "overlap": False, "metal": False}
        scene = draw_bone_scene(seed, voxel_mm=VOXEL_MM, **plain | drawn)
        np.savez_compressed(file, **stored(scene, moved=seed == MOVED))
        size = file.stat().st_size
        print(file, f"{size / 1000:.0f} kB", scene.strata, flush=True)
        if size > LIMIT:
            raise SystemExit(f"{file} is larger than {LIMIT / 1000:.0f} kB")


def stored(scene: BoneScene, *, moved: bool) -> dict[str, np.ndarray]:
    """Return the arrays of a pair; `moved`: by the matrix of the second view the bone has moved since the first."""
    arrays: dict[str, np.ndarray] = {}
    centre = (BIN - 1) / 2
    binned = np.array([[1 / BIN, 0, -centre / BIN], [0, 1 / BIN, -centre / BIN], [0, 0, 1]])
    for k, (name, image) in enumerate(scene.images.items()):
        small = image.binned(BIN)
        scale = TOP**2 / small.pixels.max()
        arrays[f"code_{name}"] = np.rint(np.sqrt(small.pixels * scale)).astype(np.uint8)
        arrays[f"white_{name}"] = np.array(small.white * scale)
        matrix = binned @ panel_matrix(scene.true_views[name])
        if moved and k:
            matrix[:, 3] -= matrix[:, :3] @ MOVED_MM
        arrays[f"matrix_{name}"] = matrix
    strata = scene.strata | ({"fault": "moved"} if moved else {})
    return arrays | {
        "views": np.array(list(scene.images)),
        "steps": np.clip(np.rint(scene.ct.hu / STEP_HU), 0, 255).astype(np.uint8),
        "origin_mm": scene.ct.origin_mm,
        "voxel_mm": scene.ct.voxel_mm,
        "axes": scene.ct.axes,
        "pose": scene.pose.as_matrix(),
        "targets_mm": scene.targets_mm,
        "strata": np.array(json.dumps(strata)),
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else FOLDER)
