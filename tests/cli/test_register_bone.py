"""`sightline register-bone`: a bone of balls in two rendered images; its files, its starts, and what is refused."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

import sightline as sl
from sightline.calibration.exchange.markups import read_points
from sightline.calibration.exchange.pose_file import read_pose
from sightline.case import stages
from sightline.case.interop.slicer import markup_bytes
from sightline.case.journal import Actor, Case
from sightline.case.views import calibrate_pair, see_pair
from sightline.cli.base import Output
from sightline.cli.bone.register_bone import ShotFiles
from sightline.cli.robot.commands import read_plan
from sightline.common.checks import failed
from sightline.errors import UnusableInputError
from sightline.from_images.ct_wire import ct_wire
from sightline.from_images.registration import BoneStart
from sightline.from_images.registration.clicks import read_clicks, start_of_clicks
from sightline.imaging import write_dicom
from sightline.imaging.volumes import CtScan
from sightline.imaging.volumes.ct import hu_of_bone, write_ct
from sightline.planning import kind
from sightline.planning.bone.registered import RegisteredBone

# Off the grid, without symmetry; the first is the largest.
CENTRES_MM = np.array([[3.2, -1.1, 41.3], [-14.9, 6.2, 22.7], [2.3, 3.9, 1.4], [-3.8, -9.6, -22.2], [7.1, 4.4, -38.9]])
RADII_MM = np.array([21.3, 13.8, 16.1, 12.4, 14.7])
POSE = RigidTransform.from_components([4.7, -2.9, 7.3], Rotation.from_rotvec([0.21, -0.34, 0.17]))
NEAR = RigidTransform.from_components([3.1, 2.2, -4.0], Rotation.from_rotvec([0.05, -0.06, 0.04])) * POSE
SHAPE = (320, 320)
NAMES = ("head", "shaft", "knee")
AT_MM = np.array([CENTRES_MM[0], CENTRES_MM[4], [-31.0, 12.0, 3.0]])  # the third to one side
CLICKS = "name,view,u,v\n"
POINTS = "name,coordinates,x_mm,y_mm,z_mm\n"
LINE_MM = np.array([[24.0, 18.0, -30.0], [-1.0, -6.0, 40.0]])
CT_AXES = Rotation.from_euler("xyz", [4.0, -3.0, 6.0], degrees=True).as_matrix()


def view(name: str, turn_deg: float, covariance: np.ndarray | None) -> sl.CalibratedView:
    """A view 600 mm from the origin along CFCS z, turned about y."""
    turned = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    camera = np.array([[1250.0, 0, 159.5], [0, 1250, 159.5], [0, 0, 1]])
    return sl.view_from_matrix(camera @ np.column_stack([turned.T, [0, 0, 600.0]]), covariance, name)


def scan(*, alone: bool = False) -> CtScan:
    """The balls of cortical bone in soft tissue and fat, in coordinates of their own; or what they attenuate beyond
    soft tissue, alone."""
    low, counts = np.array([-50.0, -45.0, -60.0]), (90, 85, 125)
    at = low + np.moveaxis(np.indices(counts), 0, -1)
    depth = (RADII_MM - np.linalg.norm(at[..., None, :] - CENTRES_MM @ CT_AXES.T, axis=-1)).max(axis=-1)
    share = np.clip(depth + 0.5, 0, 1)
    hu = hu_of_bone(share) - hu_of_bone(np.zeros(1)) - 1000 if alone else np.where(share > 0, hu_of_bone(share), -110)
    return CtScan(np.rint(hu).astype(np.int16), low @ CT_AXES, np.ones(3), CT_AXES)


@dataclass(frozen=True)
class Files:
    """A CT, two images, their views, a start, points and clicks, in one folder."""

    folder: Path
    views: tuple[sl.CalibratedView, ...]

    def arguments(self, *more: object) -> tuple[object, ...]:
        named = [part for name in ("pa", "lateral") for part in ("--view", self.folder / f"{name}.json")]
        return ("register-bone", *(self.folder / name for name in ("ct.nrrd", "pa.dcm", "lateral.dcm")), *named, *more)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("bone")
    exact = np.zeros((12, 12))
    views = view("pa", 3.0, exact), view("lateral", 86.0, exact)
    for seen in views:
        write_dicom(sl.render(scan(alone=True), seen, POSE, SHAPE), folder / f"{seen.name}.dcm")
        sl.save(seen, folder / f"{seen.name}.json")
    write_ct(scan(), folder / "ct.nrrd")
    (folder / "start.json").write_text(json.dumps(NEAR.as_matrix().tolist()))
    lines = [f"{name},RAS,{-x},{-y},{z}" for name, (x, y, z) in zip(NAMES, AT_MM, strict=True)]
    (folder / "points.csv").write_text("\n".join(["name,coordinates,x_mm,y_mm,z_mm", *lines]))
    markups = markup_bytes("Fiducial", "bone", AT_MM[:2], NAMES[:2], colour=(1, 0, 0), description="")
    (folder / "two.mrk.json").write_bytes(markups)
    lines = [
        f"{name},{seen.name},{u},{v}"
        for seen in views
        for name, (u, v) in zip(NAMES, seen.project(POSE.apply(AT_MM)), strict=True)
    ]
    (folder / "clicks.csv").write_text("\n".join(["name,view,u,v", *lines]))
    (folder / "two.csv").write_text("\n".join(["name,view,u,v", *(line for line in lines if "knee" not in line)]))
    return Files(folder, views)


def off_mm(pose: RigidTransform) -> float:
    """The largest error of a pose at the balls."""
    return float(np.linalg.norm(pose.apply(CENTRES_MM) - POSE.apply(CENTRES_MM), axis=1).max())


# Exact images, whose pixels are 0.5 mm at the bone, and voxels of 1 mm.
OFF_MM = 0.1


def test_the_pose_leaves_as_files_that_read_back(run: Callable, files: Files, tmp_path: Path) -> None:
    out = tmp_path / "pose"
    ran = run(*files.arguments("--start", files.folder / "start.json", "--out", out, "--json"))
    assert ran.code == 0, ran.err
    pose = read_pose(out / "bone-pose.json")
    assert off_mm(pose) < OFF_MM
    placed = read_pose(out / "bone-pose.tfm").inv()  # Slicer places by the inverse
    assert placed.as_matrix() == pytest.approx(pose.as_matrix(), abs=1e-9)
    assert (out / "bone.png").read_bytes().startswith(b"\x89PNG")
    written = json.loads((out / "bone-pose.json").read_text())
    assert written["matrix"] == ran.document["matrix"]
    assert written["trusted"]
    bone = sl.load(out / "bone-pose.json", RegisteredBone)
    assert [seen.view for seen in bone.views] == ["pa", "lateral"]
    bone.refuse_other_views(files.views)
    assert len({bone.volume_sha256, *(seen.pixels_sha256 for seen in bone.views)}) == 3
    image = sl.render(scan(), files.views[0], pose, SHAPE)
    assert image.pixels.shape == SHAPE


def test_two_clicked_points_start_a_registration_and_a_view_without_its_error_is_not_trusted(
    run: Callable, files: Files, tmp_path: Path
) -> None:
    unknown = tmp_path / "lateral.json"
    sl.save(view("lateral", 86.0, None), unknown)
    clicked = ("--points", files.folder / "two.mrk.json", "--clicks", files.folder / "two.csv")
    ran = run(*files.arguments(*clicked, "--out", tmp_path / "pose", "--json"))
    assert ran.code == 0, ran.err
    assert off_mm(RigidTransform.from_matrix(ran.document["matrix"])) < OFF_MM
    given = [unknown if str(part).endswith("lateral.json") else part for part in files.arguments(*clicked)]
    ran = run(*given, "--out", tmp_path / "unknown")
    assert ran.code == 3
    assert "error of the bone's pose is unknown" in " ".join(ran.out.split())
    assert off_mm(read_pose(tmp_path / "unknown" / "bone-pose.json")) < OFF_MM


@pytest.fixture(scope="module")
def found(files: Files) -> sl.BonePose:
    images = [sl.read_image(files.folder / f"{seen.name}.dcm") for seen in files.views]
    return sl.register_bone(files.folder / "ct.nrrd", images, files.views, BoneStart(NEAR))


def test_a_wire_of_the_ct_has_the_registrations_error_and_its_verdict(found: sl.BonePose) -> None:
    wire = ct_wire(found, LINE_MM, kind("free-wire"), "right")
    assert wire.verdict.go
    assert wire.trajectory.points.xyz_mm == pytest.approx(POSE.apply(LINE_MM), abs=OFF_MM)
    assert wire.trajectory.covariance_mm2 == pytest.approx(found.covariance_at(LINE_MM))
    assert set(wire.trajectory.budget_rms()) == {"bone"}
    hip_screw = ct_wire(found, LINE_MM, kind("hip-screw"), "right").verdict
    assert hip_screw.state == "incomplete"
    assert "tip in head" in {check.name for check in failed(hip_screw.checks)}
    loose = ct_wire(replace(found, covariance=400 * found.covariance), LINE_MM, kind("free-wire"))
    assert {check.name for check in failed(loose.verdict.checks)} == {"entry error", "end error", "direction error"}
    moved = replace(found.checks[-1], name="bone movement", passed=False)
    assert not ct_wire(replace(found, checks=(moved,)), LINE_MM, kind("free-wire")).verdict.go
    unknown = ct_wire(replace(found, covariance=None), LINE_MM, kind("free-wire"))
    assert {check.name for check in failed(unknown.verdict.checks)} == {"error known"}
    with pytest.raises(UnusableInputError, match="several wires"):
        ct_wire(found, LINE_MM, kind("cannulated-hip-screws:inferior"))


def test_a_wire_of_the_ct_leaves_as_a_plan_for_a_robot(run: Callable, files: Files, tmp_path: Path) -> None:
    line, out = tmp_path / "line.mrk.json", tmp_path / "plan"
    line.write_bytes(markup_bytes("Line", "wire", LINE_MM, ("entry", "tip"), colour=(1, 0, 0), description=""))
    given = ("--start", files.folder / "start.json", "--line", line, "--side", "right", "--out", out)
    ran = run(*files.arguments(*given))
    assert ran.code == 0, ran.err
    plan = read_plan(out / "plan.json")
    assert plan.points_mm == pytest.approx(POSE.apply(LINE_MM), abs=OFF_MM)
    assert plan.side == "right"
    assert plan.limits.position_mm == kind("free-wire").limits.position_mm


@pytest.mark.parametrize(
    ("names", "more", "why"),
    [
        (("tip", "entry"), (), "give two points, the entry first"),
        (("entry", "middle", "tip"), (), "give two points, the entry first"),
        (None, ("--side", "right"), "give it with --line"),
    ],
)
def test_lines_that_are_no_wire_are_refused(
    run: Callable, files: Files, tmp_path: Path, names: tuple[str, ...] | None, more: tuple[str, ...], why: str
) -> None:
    line = tmp_path / "line.csv"
    line.write_text(POINTS + "\n".join(f"{name},LPS,{k},{40 * k},0" for k, name in enumerate(names or ())))
    ran = run(*files.arguments(*more, *(("--line", line) if names else ())))
    assert ran.code == 2
    assert why in ran.said


def test_clicks_give_the_pose_or_leave_the_rotation_about_their_axis_open(files: Files) -> None:
    points, clicks = read_points(files.folder / "points.csv"), read_clicks(files.folder / "clicks.csv")
    start = start_of_clicks(points, clicks, files.views)
    assert off_mm(start.pose) < 1e-6
    two = start_of_clicks(points, read_clicks(files.folder / "two.csv"), files.views)
    poses = two.turned(None)
    ends = POSE.apply(AT_MM[:2])
    assert all(pose.apply(AT_MM[:2]) == pytest.approx(ends, abs=1e-6) for pose in poses)
    nearest = min((pose.rotation * POSE.rotation.inv()).magnitude() for pose in poses)
    assert nearest < np.deg2rad(5.01)  # every 10°


def test_a_case_gives_its_newest_images_and_views(pair: dict[str, Path], frame: sl.Frame, tmp_path: Path) -> None:
    images = calibrate_pair(see_pair(pair["pa"], pair["lateral"], frame), frame, "smooth")
    with Case.create(tmp_path / "case") as case:
        ref = stages.keep_frame(case, frame)
        for image in images:
            stages.record_view(case, pair[image.name], image, frame_ref=ref, by=Actor.RECEIVER)
    named = [image.seen.source for image in images]
    shown = ShotFiles(case=tmp_path / "case").read(Output(json=False, quiet=True, every=False))
    assert [seen.name for seen in shown.views] == ["pa", "lateral"]
    assert (shown.sources, shown.frame.fingerprint) == (named, frame.fingerprint)
    for image, seen, made in zip(shown.images, shown.views, images, strict=True):
        assert image.shape == seen.image_shape
        assert seen.focal_point_mm == pytest.approx(made.view.focal_point_mm, abs=1e-9)


@pytest.mark.parametrize(
    ("points", "clicks", "why"),
    [
        (POINTS + "head,XYZ,1,2,3", CLICKS, "must be LPS or RAS"),
        (POINTS + "head,LPS,1,2,nan", CLICKS, "3 finite numbers"),
        (POINTS + "head,LPS,1,2,3\nhead,LPS,4,5,6", CLICKS, "give each a name of its own"),
        ("name,x\nhead,3", CLICKS, "x_mm,y_mm,z_mm are needed"),
        (None, "u,v\n3,4", "name,view,u,v are needed"),
        (None, CLICKS + "hip,pa,3,4", "name hip"),
        (None, CLICKS + "head,oblique,3,4", "name oblique"),
        (None, CLICKS + "head,pa,3,4\nhead,pa,3,5", "stands twice"),
        (None, CLICKS + "head,pa,3,4\nhead,lateral,3,4\nshaft,pa,1,2", "1 points are clicked in two views"),
        (
            None,
            CLICKS + "head,pa,150,60\nhead,lateral,150,60\nshaft,pa,150,70\nshaft,lateral,150,70",
            "check the names",
        ),
    ],
)
def test_points_and_clicks_that_give_no_start_are_refused(
    run: Callable, files: Files, tmp_path: Path, points: str | None, clicks: str, why: str
) -> None:
    table, at = tmp_path / "clicks.csv", files.folder / "points.csv"
    table.write_text(clicks)
    if points is not None:
        at = tmp_path / "points.csv"
        at.write_text(points)
    ran = run(*files.arguments("--points", at, "--clicks", table))
    assert ran.code == 2
    assert why in ran.said


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("{", "JSON"),
        ('{"markups": []}', "one list of points"),
        ('{"markups": [{"coordinateUnits": "um", "coordinateSystem": "LPS", "controlPoints": []}]}', "in mm"),
        ('{"markups": [{"coordinateSystem": "LPS", "controlPoints": [3]}]}', "must be a list"),
        ('{"markups": [{"coordinateSystem": "LPS", "controlPoints": [{"label": "a"}]}]}', "'position' is missing"),
    ],
)
def test_markups_that_hold_no_points_are_refused(
    run: Callable, files: Files, tmp_path: Path, content: str, why: str
) -> None:
    file = tmp_path / "points.mrk.json"
    file.write_text(content)
    ran = run(*files.arguments("--points", file, "--clicks", files.folder / "clicks.csv"))
    assert ran.code == 2
    assert why in ran.said


def test_inputs_that_do_not_belong_together_are_refused(run: Callable, files: Files) -> None:
    ct, pa, lateral = (files.folder / name for name in ("ct.nrrd", "pa.dcm", "lateral.dcm"))
    points, start = ("--points", files.folder / "points.csv"), ("--start", files.folder / "start.json")
    clicks = ("--clicks", files.folder / "clicks.csv")
    for given, why in [
        (("register-bone", ct, pa, "--view", files.folder / "pa.json"), "two images or more"),
        (("register-bone", ct, pa, lateral, "--view", files.folder / "pa.json"), "2 images and 1 views"),
        (("register-bone", ct, pa, "--case", files.folder), "leave the others out"),
        (files.arguments("--frame", "gamma"), "leave out --frame"),
        (files.arguments(*points), "belong together"),
        (files.arguments(*points, *clicks, *start), "both give a start"),
        (files.arguments("--cortex", 3), "leave out --cortex"),
        (files.arguments("--start", files.folder / "ct.nrrd"), "not a text file"),
    ]:
        ran = run(*given)
        assert ran.code == 2, given
        assert why in ran.said
