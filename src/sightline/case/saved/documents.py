"""Results and their documents. A view is calibrated again from its beads and its frame, a plan from views and picks."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration import BeadView, CalibrationInputs, CArm, MatrixView, calibrate
from sightline.calibration.exchange import opencv
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.reading import array
from sightline.calibration.maps.grid import GridMap
from sightline.case.canonical import plain, with_null
from sightline.case.contents import PlanRequest
from sightline.case.interop.plan_file import bundle
from sightline.case.views import CalibratedImage, ObservedView, view_document
from sightline.common.checks import Check
from sightline.common.geometry.rigid import why_not_rigid
from sightline.detection import Detections, Observations, RejectedCandidate
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.imaging.formats import check_size
from sightline.planning import Plan, SpacePoints, Trajectory
from sightline.planning.bone.registered import RegisteredBone
from sightline.planning.check.result import CheckShot
from sightline.planning.points.gaps import Movement
from sightline.planning.procedures.procedure import keeping


def detections(given: dict[str, Any]) -> Detections:
    """Return the detections of a document. Raises UnusableInputError where its lists differ in length."""
    _refuse_uneven(given, "uv_px", "radius_px", "covariance_px2", "kind", "contrast")
    return Detections(
        uv_px=np.array(given["uv_px"]).reshape(-1, 2),
        radius_px=np.array(given["radius_px"]),
        covariance_px2=np.array(given["covariance_px2"]).reshape(-1, 2, 2),
        kind=tuple(given["kind"]),
        contrast=np.array(given["contrast"]),
        image_shape=_shape(given["image_shape"]),
        rejected=_rejected(given["rejected"]),
    )


def observations(given: dict[str, Any]) -> Observations:
    """Return the observations of a document. Raises UnusableInputError where its lists differ in length."""
    covariance, radius, shape = (given[key] for key in ("covariance_px2", "radius_px", "image_shape"))
    known = [name for name in ("covariance_px2", "radius_px") if given[name] is not None]
    _refuse_uneven(given, "ids", "uv_px", *known)
    return Observations(
        view=given["view"],
        ids=tuple(given["ids"]),
        uv_px=np.array(given["uv_px"]).reshape(-1, 2),
        covariance_px2=None if covariance is None else np.array(covariance).reshape(-1, 2, 2),
        mirrored=given["mirrored"],
        image_shape=None if shape is None else _shape(shape),
        radius_px=None if radius is None else np.array(radius),
        rejected=None if given["rejected"] is None else _rejected(given["rejected"]),
    )


def _refuse_uneven(given: dict[str, Any], *names: str) -> None:
    if len({len(given[name]) for name in names}) > 1:
        raise UnusableInputError(f"{', '.join(names)} differ in length; save the result again")


def _shape(given: list[int]) -> tuple[int, int]:
    return given[0], given[1]


def _rejected(given: list[dict[str, Any]]) -> tuple[RejectedCandidate, ...]:
    return tuple(
        RejectedCandidate((document["uv_px"][0], document["uv_px"][1]), document["radius_px"], document["reason"])
        for document in given
    )


# Machines and versions of libraries differ by less; an estimator that has changed, by more [ours].
_SAME_VIEW_MM = 1e-3
_SAME_PLAN_MM = 10 * _SAME_VIEW_MM  # a wire's end lies beyond the plates of its views


def as_image(view: BeadView) -> CalibratedImage:
    """Return a view as the reports and exports take it, without its image. Raises UnusableInputError."""
    return CalibratedImage(ObservedView("", inputs_of(view).observations), view)


def inputs_of(view: BeadView) -> CalibrationInputs:
    """Return what a view was calibrated from. Raises UnusableInputError where it was not made by `calibrate`."""
    if view.inputs is None:
        raise UnusableInputError(f"view {view.name} was not made by `calibrate`, so it cannot be saved; calibrate it")
    return view.inputs


def view_written(view: BeadView) -> dict[str, Any]:
    """Return the document of a view. Raises UnusableInputError where it was not made by `calibrate`."""
    inputs = inputs_of(view)
    return {
        **view_document(as_image(view)),
        "made_from": {
            "observations": plain(inputs.observations),
            "frame": json.loads(inputs.frame.to_json()),
            "degree": inputs.degree,
            "plate": inputs.plate,
            "mirrored_display": view.mirrored_display,
            "c_arm": None if view.c_arm is None else plain(view.c_arm),
        },
    }


def view(given: dict[str, Any]) -> BeadView:
    """Return the view of a document, with the document's checks.

    Raises UnusableInputError where it comes out otherwise than the document states, and what `calibrate` raises.
    """
    made_from = given["made_from"]
    c_arm = made_from["c_arm"]
    made = calibrate(
        observations(made_from["observations"]),
        Frame.from_json(json.dumps(made_from["frame"]).encode()),
        method=given["method"],
        degree=made_from["degree"],
        plate=made_from["plate"],
        mirrored_display=made_from["mirrored_display"],
        c_arm=None if c_arm is None else CArm(**c_arm),
    )
    off_mm = float(np.linalg.norm(made.focal_point_mm - np.array(given["focal_point_mm"])))
    if not off_mm <= _SAME_VIEW_MM or made.name != given["view"]:
        raise UnusableInputError(
            f"this version puts the focal point of view {made.name} {off_mm:.3f} mm from where the file has it; "
            "calibrate the image again"
        )
    return replace(made, checks=checks(given["checks"]))


def checks(given: list[dict[str, Any]]) -> tuple[Check, ...]:
    """Return the checks of a document."""
    return tuple(Check.of(document) for document in given)


def matrix_written(view: MatrixView) -> dict[str, Any]:
    """Return the document of a matrix's view, as the export to OpenCV writes it."""
    return opencv.document(Pinhole.of_matrix(view.matrix, view.name, covariance=view.covariance))


def matrix_view(given: dict[str, Any]) -> MatrixView:
    """Return the view of a document. Raises UnusableInputError."""
    return opencv.of_document(given, given["view"]).view()


def points(given: dict[str, Any]) -> SpacePoints:
    """Return the points of a document. Raises UnusableInputError where its lists differ in length."""
    count = len(given["xyz_mm"])
    joint, budget, sigma, near = (given[k] for k in ("joint_covariance_mm2", "budget_mm2", "gap_sigma", "beads_near"))
    square = 3 * count, 3 * count
    tested = np.array(given["gap_tested"], dtype=bool)
    if {len(tested), len(given["inside_hull"])} != {count} or (sigma is not None and len(sigma) != count):
        raise UnusableInputError("its points, gaps and flags differ in number; save the result again")
    return SpacePoints(
        xyz_mm=array(given["xyz_mm"], (count, 3), "the points"),
        gap_mm=array(given["gap_mm"], (count,), "the gaps"),
        gap_tested=tested,
        gap_sigma=None if sigma is None else _masked(sigma),
        joint_covariance_mm2=None if joint is None else array(joint, square, "the covariance"),
        budget_mm2=None
        if budget is None
        else {name: array(covariance, square, name) for name, covariance in budget.items()},
        inside_hull=np.array(given["inside_hull"], dtype=bool),
        beads_near=None if near is None else {name: array(n, (count, 3), name).astype(int) for name, n in near.items()},
        movement=None if given.get("movement") is None else _movement(given["movement"]),
        head_tested=given.get("head_tested", False),
        **{name: given[name] for name in ("method", "shift_mm", "shift_sd_mm", "gap_chi2", "upright")},
    )


def _movement(given: dict[str, Any]) -> Movement:
    known = array(given["information"], (len(given["information"]), 3, 3), "what is known of a movement")
    return Movement(given["chi2"], given["freedom"], known, np.array(given["shown"]), given["redundancy"])


def _masked(given: list[float | None]) -> np.ma.MaskedArray:
    """Numbers, masked where they are not known."""
    return np.ma.array([np.nan if value is None else value for value in given], mask=[value is None for value in given])


def trajectory_written(trajectory: Trajectory) -> dict[str, Any]:
    """Return the document of a trajectory: that of reports, and all that is known of its points."""
    return {**trajectory.document(), "points": plain(trajectory.points)}


def trajectory(given: dict[str, Any]) -> Trajectory:
    """Return the trajectory of a document. Raises UnusableInputError."""
    return Trajectory(points(given["points"]))


def plan_written(plan: Plan) -> dict[str, Any]:
    """Return the document of a plan: plan.json without images, and what it was made from.

    Raises UnusableInputError where a view of it cannot be saved."""
    views_of, limits = plan.views, plan.kind.limits
    seen = [as_image(view) for view in views_of if isinstance(view, BeadView)]
    geometry: dict[str, Any] = {}
    if len(seen) == len(views_of):
        geometry, _ = bundle(plan, seen, inputs_of(seen[0].view).frame)
    return {
        **plan.document(),
        "views": [_view_written(view) for view in views_of],
        "asked": {
            **with_null(dict(plan.arguments)),
            "kind": plan.kind.key,
            "procedure": keeping(plan.kind),
            "limits": limits,
        },
        **({"relations": plan.relations} if plan.relations else {}),
        **geometry,
    }


def _view_written(view: Any) -> dict[str, Any]:
    if isinstance(view, BeadView):
        return {"schema": "sightline-view/1", **view_written(view)}
    return {"schema": "sightline-matrix-view/1", "source": "", **matrix_written(view)}


def plan(given: dict[str, Any]) -> Plan:
    """Return the plan of a document, made again on its views.

    Raises UnusableInputError where it comes out otherwise than the document states, and what `plan` raises.
    """
    on = [
        view(document) if document["schema"] == "sightline-view/1" else matrix_view(document)
        for document in given["views"]
    ]
    made = PlanRequest.of(given["asked"]).plan_on(on)
    if "relations" in given:  # to wires that the file does not hold
        made = made.related(checks(given["relations"]))
    ends = np.array([given["trajectory"][name] for name in ("entry_mm", "end_mm")])
    off_mm = float(np.linalg.norm(made.trajectory.points.xyz_mm - ends, axis=1).max())
    if not off_mm <= _SAME_PLAN_MM or made.verdict.state != given["verdict"]:
        raise UnusableInputError(
            f"this version plans otherwise: {off_mm:.3f} mm from the file's points, and says {made.verdict.state} "
            f"where the file says {given['verdict']}; plan again"
        )
    return made


def registered_bone(given: dict[str, Any]) -> RegisteredBone:
    """Return the registered bone of a document. Raises UnusableInputError."""
    bone = RegisteredBone.of(given)
    if why := why_not_rigid(bone.matrix):
        raise UnusableInputError(f"its pose is not rigid: {why}; register the bone again")
    return bone


def shot_written(shot: CheckShot) -> dict[str, Any]:
    """Return the document of a check shot: that of reports, and the numbers that it is made of."""
    names = ("deviation_mm", "covariance_mm2", "across", "length_mm", "outlier_sigma")
    return {**shot.document(), **{name: getattr(shot, name) for name in names}}


def shot(given: dict[str, Any]) -> CheckShot:
    """Return the check shot of a document. Raises UnusableInputError."""
    shapes = {"entry_mm": (3,), "tip_mm": (3,), "deviation_mm": (5,), "covariance_mm2": (5, 5), "across": (2, 3)}
    moved = RigidTransform.from_matrix(array(given["bone_moved"], (4, 4), "the bone's movement"))
    numbers = ("length_mm", "landmarks", "bow_mm", "bow_sigma", "residual_rms", "outlier_sigma")
    return CheckShot(
        **{name: array(given[name], shape, name) for name, shape in shapes.items()},
        **{name: given[name] for name in numbers},
        movement=moved,
        checks=checks(given["checks"]),
    )


def grid_written(grid: GridMap) -> dict[str, Any]:
    """Return the document of a grid's map: its error, and the points that it is fitted to."""
    points = {name: getattr(grid, name) for name in ("uv_px", "index", "pitch_mm", "shape")}
    return {**grid.document(), **plain(points)}


def grid_map(given: dict[str, Any]) -> GridMap:
    """Return the grid's map of a document. Raises UnusableInputError where its lists differ in length."""
    _refuse_uneven(given, "uv_px", "index")
    shape = _shape(given["shape"])
    check_size(*shape, "the map")
    return GridMap(
        np.array(given["uv_px"]).reshape(-1, 2),
        np.array(given["index"]).reshape(-1, 2),
        given["pattern"] == "hexagonal",
        given["pitch_mm"],
        shape,
        given["kind"],
        given["left_out"],
    )
