"""Other programs read our files: each is run if installed, else reported as missing.

Peers: `pip install itk-rtk SimpleITK diffdrr`, and dcmtk from the system's packages. None is a dependency of
Sightline; DiffDRR needs torch, several gigabytes. Views are random cameras around a hip. Each peer's result is compared
with the formula of `Pinhole`.
"""

import json
import shutil
import subprocess
import tempfile
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.harness import Rows
from sightline.calibration.exchange.formats import write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.interop.dicom import ExportIdentity, capture, file_bytes
from sightline.case.interop.formats import T_cfcs_wire, T_lps_cfcs, transform_bytes
from sightline.case.interop.slicer import plate_bytes, plate_corner
from sightline.imaging import Radiograph, write_dicom

SEED, VIEWS, POINTS = 41, 40, 20
MAX_OFF = 1e-6  # px or mm [ours]: far below what matters in any use of the files
MAX_32_BIT_PX = 1e-3  # [ours] DiffDRR computes in 32 bits: about 1e-7 of 500 px, a few roundings
SIDE = "left"


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows = Rows("interop")
    views = [_drawn(np.random.default_rng([SEED, k])) for k in range(VIEWS // 10 if quick else VIEWS)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for package, compare in (("itk-rtk", _rtk), ("SimpleITK", _simple_itk), ("diffdrr", _diffdrr)):
            try:
                peer = f"{package} {version(package)}"
            except PackageNotFoundError:
                rows.add(package, "not installed", peer=f"pip install {package}")
                continue
            worst: dict[str, float] = {}
            for view in views:
                for what, off in compare(view, folder).items():
                    worst[what] = max(worst.get(what, 0.0), float(off))
            for what, off in worst.items():
                most = MAX_32_BIT_PX if package == "diffdrr" else MAX_OFF
                rows.number(f"{what}, at most, {len(views)} views", off, ".1e", most=most, peer=peer)
        _add_dcmtk(rows, views[0], folder)
    return rows


def _drawn(rng: np.random.Generator) -> Pinhole:
    """Return a C-arm's camera: any beam direction, the hip 300 to 900 mm from the source, its image off-centre."""
    height, width = (int(n) for n in rng.integers(64, 512, 2))
    across, down = (float(s) for s in rng.uniform(0.1, 0.5, 2))
    distance = rng.uniform(950.0, 1300.0)
    camera = np.diag([distance / across, distance / down, 1.0])
    camera[:2, 2] = rng.uniform(-0.5, 1.5, 2) * [width, height]
    place = np.array([*rng.uniform(-80.0, 80.0, 2), rng.uniform(300.0, 900.0)])
    return Pinhole("pa", camera, Rotation.random(rng=rng).as_matrix(), place, (height, width), (across, down))


def _pixels(view: Pinhole) -> np.ndarray:
    return np.random.default_rng(SEED).integers(0, 65536, view.stated_shape(), dtype=np.uint16)


def _projected(view: Pinhole, xyz_mm: np.ndarray) -> np.ndarray:
    """Return the projections (N, 2), px, by the definition of `Pinhole`."""
    w = (xyz_mm @ view.rotation.T + view.translation_mm) @ view.camera_matrix.T
    return w[:, :2] / w[:, 2:]


def _points(view: Pinhole) -> np.ndarray:
    return np.random.default_rng([SEED, *view.stated_shape()]).uniform(-90.0, 90.0, (POINTS, 3))


def _rtk(view: Pinhole, folder: Path) -> dict[str, Any]:
    """Compare projections by RTK's matrix of our geometry file, as pixels of its image."""
    from itk import RTK

    for name, data in write_view(view, "rtk", _pixels(view)).items():
        (folder / name).write_bytes(data)
    entry = RTK.read_geometry(str(folder / "pa.rtk.xml")).GetMatrix(0).GetVnlMatrix().get
    matrix, xyz = np.array([[entry(i, j) for j in range(4)] for i in range(3)]), _points(view)
    u, v, w = matrix @ np.column_stack([xyz, np.ones(POINTS)]).T
    _, across, down = view.detector_mm()
    uv = np.column_stack([u / w / across, view.stated_shape()[0] - 1 - v / w / down])  # bottom row first, at 0, 0
    return {"RTK's geometry, px": np.abs(uv - _projected(view, xyz)).max()}


def _simple_itk(view: Pinhole, folder: Path) -> dict[str, Any]:
    """Compare transformed points, and values and positions of images' pixels."""
    import SimpleITK

    to_lps, pixels, points = T_lps_cfcs(SIDE), _pixels(view), _points(view)
    wire = to_lps @ T_cfcs_wire(points[:2])
    (folder / "wire.tfm").write_bytes(transform_bytes(wire, "wire"))
    (folder / "plate.nrrd").write_bytes(plate_bytes(pixels, view, to_lps, "a plan"))
    (folder / "pa.rtk.mha").write_bytes(write_view(view, "rtk", pixels)["pa.rtk.mha"])
    transform = SimpleITK.ReadTransform(str(folder / "wire.tfm"))
    image, projection = (SimpleITK.ReadImage(str(folder / name)) for name in ("plate.nrrd", "pa.rtk.mha"))
    moved = np.array([transform.TransformPoint(point.tolist()) for point in points])
    corner, steps = plate_corner(view)
    uv = np.abs(points[:, :2])
    placed = np.array([image.TransformContinuousIndexToPhysicalPoint([*at, 0.0]) for at in uv.tolist()])
    return {
        "ITK's transforms, mm": np.abs(moved - points @ wire[:3, :3].T - wire[:3, 3]).max(),
        "places of an image's pixels (NRRD), mm": np.abs(placed - (corner + uv @ steps) @ to_lps[:3, :3].T).max(),
        "other pixels of NRRD and MetaImage": (SimpleITK.GetArrayFromImage(image)[0] != pixels).sum()
        + (SimpleITK.GetArrayFromImage(projection)[0] != pixels[::-1]).sum(),
    }


def _diffdrr(view: Pinhole, _: Path) -> dict[str, Any]:
    """Check that the rays that DiffDRR renders from our parameters meet the detector at the pixels' centres."""
    import torch
    from diffdrr.detector import Detector
    from diffdrr.pose import RigidTransform

    stated = json.loads(write_view(view, "diffdrr")["pa.diffdrr.json"])
    detector = Detector(
        *(stated[name] for name in ("sdd", "height", "width", "delx", "dely", "x0", "y0")),
        torch.eye(4)[None],
        reverse_x_axis=stated["reverse_x_axis"],
    )
    source, target = detector(RigidTransform(torch.tensor(stated["pose"])), None)
    height, width = view.stated_shape()
    v, u = np.divmod(np.arange(height * width), width)
    away = _projected(view, target[0].double().numpy()) - np.column_stack([u, v])
    apart = np.linalg.norm(source[0, 0].double().numpy() - view.focal_point_mm)
    return {"DiffDRR's rays, px": np.abs(away).max(), "DiffDRR's source, mm": apart}


def _add_dcmtk(rows: Rows, view: Pinhole, folder: Path) -> None:
    """Check that dcmtk reads every DICOM file without complaint, and finds the side in it."""
    program = shutil.which("dcmdump")
    if program is None:
        rows.add("dcmtk", "not installed", peer="apt-get install dcmtk")
        return
    pixels, filed = _pixels(view), ExportIdentity("bench-1", datetime(2024, 5, 17, 10, 30), SIDE)
    (folder / "capture.dcm").write_bytes(file_bytes(capture((pixels, 65535.0), view, filed, "a plan", 1)))
    write_dicom(Radiograph(pixels, 65535.0), folder / "image.dcm", SIDE)
    command = [program, "--print-all", "--search", "0020,0060", "--search", "0020,0010", "--search", "0020,0011"]
    sound = 0
    for name, study in (("capture.dcm", "bench-1"), ("image.dcm", "1")):
        done = subprocess.run([*command, str(folder / name)], capture_output=True, text=True, check=False)
        values = [line[line.index("[") + 1 : line.index("]")] for line in done.stdout.splitlines() if "[" in line]
        sound += done.returncode == 0 and not done.stderr and sorted(values) == sorted(["L", study, "1"])
    rows.add("DICOM files that are sound", f"{sound} of 2", "2 of 2", sound == 2, peer="dcmtk")
