"""Other programs read our files: each is run if installed, else reported as missing.

Peers: `pip install itk-rtk SimpleITK slicerio diffdrr`, and dcmtk from the system's packages. None is a dependency of
Sightline; DiffDRR needs torch, several gigabytes. Views are random cameras around a hip. Each peer's result is compared
with the formula of `Pinhole`.
"""

import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.rows import Row
from sightline.calibration.exchange.formats import write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.interop.dicom import ExportIdentity, capture, file_bytes
from sightline.case.interop.formats import T_cfcs_wire, T_lps_cfcs, transform_bytes
from sightline.case.interop.slicer import nrrd_bytes, plate_corner
from sightline.imaging import Radiograph, write_dicom

GROUP = "interop"
SEED, VIEWS, POINTS = 41, 40, 20
REQUIRED = {"px": 1e-6, "mm": 1e-6}  # [ours] far below what matters in any use of the files
REQUIRED_32_BIT_PX = 1e-3  # [ours] DiffDRR computes in 32 bits: about 1e-7 of 500 px, a few roundings
SIDE = "left"


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    views = [_drawn(np.random.default_rng([SEED, k])) for k in range(VIEWS // 10 if quick else VIEWS)]
    peers: dict[str, Callable[[list[Pinhole], Path], list[Row]]] = {
        "itk-rtk": _rtk,
        "SimpleITK": _simple_itk,
        "slicerio": _slicerio,
        "diffdrr": _diffdrr,
    }
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for package, measure in peers.items():
            try:
                version(package)
            except PackageNotFoundError:
                rows.append(Row(GROUP, package, "not installed", "", f"pip install {package}"))
            else:
                rows += measure(views, Path(folder))
        return [*rows, *_dcmtk(views[0], Path(folder))]


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


def _row(name: str, worst: float, unit: str, package: str, trials: str) -> Row:
    required = REQUIRED[unit]
    value = f"{worst:.1e} {unit} at most, {trials}"
    return Row(GROUP, name, value, f"{required:g} {unit}", f"{package} {version(package)}", worst <= required)


def _rtk(views: list[Pinhole], folder: Path) -> list[Row]:
    """Compare projections by RTK's matrix of each of our geometry files, as pixels of its image."""
    from itk import RTK

    worst = 0.0
    rng = np.random.default_rng(SEED)
    for view in views:
        for name, data in write_view(view, "rtk", _pixels(view)).items():
            (folder / name).write_bytes(data)
        entry = RTK.read_geometry(str(folder / "pa.rtk.xml")).GetMatrix(0).GetVnlMatrix().get
        matrix = np.array([[entry(i, j) for j in range(4)] for i in range(3)])
        xyz = rng.uniform(-90.0, 90.0, (POINTS, 3))
        u, v, w = matrix @ np.column_stack([xyz, np.ones(POINTS)]).T
        _, across, down = view.detector_mm()
        found = np.column_stack(
            [u / w / across, view.stated_shape()[0] - 1 - v / w / down]
        )  # bottom row first, at 0, 0
        worst = max(worst, float(np.abs(found - _projected(view, xyz)).max()))
    return [_row("RTK's geometry", worst, "px", "itk-rtk", f"{len(views)} views")]


def _simple_itk(views: list[Pinhole], folder: Path) -> list[Row]:
    """Compare transformed points, and values and positions of images' pixels."""
    import SimpleITK

    rng = np.random.default_rng(SEED)
    moved, placed, same = 0.0, 0.0, True
    to_lps = T_lps_cfcs(SIDE)
    for view in views:
        wire = to_lps @ T_cfcs_wire(rng.uniform(-90.0, 90.0, (2, 3)))
        (folder / "wire.tfm").write_bytes(transform_bytes(wire, "wire"))
        transform = SimpleITK.ReadTransform(str(folder / "wire.tfm"))
        for point in rng.uniform(-90.0, 90.0, (POINTS, 3)):
            expected = wire[:3, :3] @ point + wire[:3, 3]
            moved = max(moved, float(np.abs(np.array(transform.TransformPoint(point.tolist())) - expected).max()))
        pixels = _pixels(view)
        (folder / "plate.nrrd").write_bytes(nrrd_bytes(pixels, view, to_lps, "a plan"))
        image = SimpleITK.ReadImage(str(folder / "plate.nrrd"))
        (folder / "pa.rtk.mha").write_bytes(write_view(view, "rtk", pixels)["pa.rtk.mha"])
        projection = SimpleITK.ReadImage(str(folder / "pa.rtk.mha"))
        same &= bool((SimpleITK.GetArrayFromImage(image)[0] == pixels).all())
        same &= bool((SimpleITK.GetArrayFromImage(projection)[0] == pixels[::-1]).all())
        corner, steps = plate_corner(view)
        for u, v in rng.uniform(0.0, 60.0, (POINTS, 2)):
            expected = to_lps[:3, :3] @ (corner + u * steps[0] + v * steps[1])
            found = np.array(image.TransformContinuousIndexToPhysicalPoint([float(u), float(v), 0.0]))
            placed = max(placed, float(np.abs(found - expected).max()))
    trials = f"{len(views)} views"
    return [
        _row("ITK's transforms", moved, "mm", "SimpleITK", trials),
        _row("places of an image's pixels (NRRD)", placed, "mm", "SimpleITK", trials),
        Row(GROUP, "pixels of NRRD and MetaImage", "the same" if same else "others", "the same", "SimpleITK", same),
    ]


def _slicerio(views: list[Pinhole], folder: Path) -> list[Row]:
    """Compare pixels and LPS positions of the plate's image, read by 3D Slicer's stand-alone reader."""
    import slicerio

    worst, same = 0.0, True
    to_lps = T_lps_cfcs(SIDE)
    for view in views:
        pixels = _pixels(view)
        (folder / "plate.nrrd").write_bytes(nrrd_bytes(pixels, view, to_lps, "a plan"))
        found = slicerio.read_volume(str(folder / "plate.nrrd"))
        same &= bool((pixels == np.asarray(found["voxels"])[..., 0].T).all())
        corner, steps = plate_corner(view)
        expected = to_lps[:3, :3] @ np.column_stack([steps[0], steps[1], corner])
        worst = max(worst, float(np.abs(np.asarray(found["ijkToLPS"])[:3, [0, 1, 3]] - expected).max()))
    return [
        _row("axes of 3D Slicer's volumes", worst, "mm", "slicerio", f"{len(views)} views"),
        Row(GROUP, "pixels of these volumes", "the same" if same else "others", "the same", "slicerio", same),
    ]


def _diffdrr(views: list[Pinhole], _: Path) -> list[Row]:
    """Check that the rays that DiffDRR renders from our parameters meet the detector at the pixels' centres."""
    import torch
    from diffdrr.detector import Detector
    from diffdrr.pose import RigidTransform

    worst = 0.0
    for view in views:
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
        worst = max(worst, float(np.abs(away).max()))
        assert apart < 1e-3, "DiffDRR's source is not at the focal point"
    value = f"{worst:.1e} px at most, every pixel of {len(views)} views"
    peer = f"diffdrr {version('diffdrr')}, in 32 bits"
    return [Row(GROUP, "DiffDRR's rays", value, f"{REQUIRED_32_BIT_PX:g} px", peer, worst <= REQUIRED_32_BIT_PX)]


def _dcmtk(view: Pinhole, folder: Path) -> list[Row]:
    """Check that dcmtk reads every DICOM file without complaint, and finds the side in it."""
    program = shutil.which("dcmdump")
    if program is None:
        return [Row(GROUP, "dcmtk", "not installed", "", "apt-get install dcmtk")]
    pixels = _pixels(view)
    filed = ExportIdentity("bench-1", datetime(2024, 5, 17, 10, 30), SIDE)
    (folder / "capture.dcm").write_bytes(file_bytes(capture((pixels, 65535.0), view, filed, "a plan", 1)))
    write_dicom(Radiograph(pixels, 65535.0), folder / "image.dcm", SIDE)
    said = [program, "--print-all", "--search", "0020,0060", "--search", "0020,0010", "--search", "0020,0011"]
    sound = 0
    for name in ("capture.dcm", "image.dcm"):
        done = subprocess.run([*said, str(folder / name)], capture_output=True, text=True, check=False)
        values = [line[line.index("[") + 1 : line.index("]")] for line in done.stdout.splitlines() if "[" in line]
        sound += done.returncode == 0 and not done.stderr and sorted(values) == sorted(["L", *_identity(name)])
    release = subprocess.run([program, "--version"], capture_output=True, text=True, check=False).stdout.split()
    peer = f"dcmtk {next((word.strip('v') for word in release if word.startswith('v')), '')}"
    return [Row(GROUP, "DICOM files that are sound", f"{sound} of 2", "2 of 2", peer, sound == 2)]


def _identity(name: str) -> tuple[str, str]:
    """Return study ID and series number."""
    return ("bench-1", "1") if name == "capture.dcm" else ("1", "1")
