"""`plan.json` as `sightline plan --out` writes it, and read back and checked.

It holds geometry of the images, beads and lines of sight, so that it can be exported without the case. Its digest
detects changes made by accident or by hand. It is not a signature: anybody can compute a new digest.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from sightline.calibration.exchange import opencv, reading
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.canonical import canonical, digest
from sightline.case.interop.plate import plate_image
from sightline.case.views import CalibratedImage
from sightline.common.bounded import MAX_JSON_BYTES
from sightline.common.checks import CheckCode, Limits
from sightline.common.geometry.covariance import length_quantile
from sightline.common.strict import naming
from sightline.errors import OutsideRegionError, RobotRefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.imaging import read_image
from sightline.planning import Plan, Trajectory
from sightline.planning.bone.directions import caudal
from sightline.planning.document import SOLID, PlanFileDocument
from sightline.planning.plan import DRAWN_POINTS
from sightline.planning.points.results import SpacePoints
from sightline.planning.procedures.procedure import ProcedureKey
from sightline.planning.verdict.relations import refuse_unrelated

_DIGEST = "digest"
_WIRES = "wires"
# What each wire of a file of several wires has of its own; the rest is the same for all.
_OWN = (
    "go",
    "verdict",
    "missing",
    "noticed_along_mm",
    "kind",
    "procedure",
    "unchecked_relations",
    "trajectory",
    "landmarks",
    "implant",
    "hole",
    "checks",
    "lines_of_sight",
    "drawn",
)
_MIN_RISE_MM = 10.0  # [ours] cranial rise from entry to end that decides the side; a hip screw at 135° rises 60 mm


def sealed(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a plan's document with its digest: the SHA-256 of the canonical JSON of everything else in it."""
    rest = {key: value for key, value in document.items() if key != _DIGEST}
    return {**rest, _DIGEST: f"sha256:{digest(canonical(rest))}"}


def of_wires(whole: Mapping[str, Any], plans: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the document of several wires: `whole`, what their plans' documents share, and "wires" with the rest."""
    first = next(iter(plans.values()))
    shared = {key: value for key, value in first.items() if key not in _OWN}
    own = {wire: {key: document[key] for key in _OWN if key in document} for wire, document in plans.items()}
    return {**shared, **whole, _WIRES: own}


def _wires(given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return what each wire of a file of several has of its own, by key; nothing in a file of one wire."""
    wires = given.get(_WIRES)
    return (
        {key: document for key, document in wires.items() if isinstance(document, dict)}
        if isinstance(wires, dict)
        else {}
    )


def _of_wire(given: Mapping[str, Any], wire: str | None) -> dict[str, Any]:
    """Return the document of one wire. Raises UnusableInputError."""
    if wire is None and _WIRES not in given:
        return dict(given)
    wires = _wires(given)
    if wire not in wires:
        known = ", ".join(wires) or "none: it is the plan of one wire"
        raise UnusableInputError(f"name one of its wires with --wire; they are {known}")
    shared = {key: value for key, value in given.items() if key not in (_WIRES, _DIGEST, *_OWN)}
    document = {**shared, **wires[wire], "all_wires": given.get("verdict")}
    return sealed(document) if _DIGEST in given else document


class PlanFile:
    """A plan to be exported or sent: the content of its file, and values derived from it."""

    def __init__(self, document: PlanFileDocument, folder: Path) -> None:
        self.document = document
        self._folder = folder

    @staticmethod
    def read(path: str | Path, wire: str | None = None) -> "PlanFile":
        """Read plan.json, or the one in a folder; `wire`: the key of one, in a file of several.

        Raises UnusableInputError if it is damaged or was changed.
        """
        file, given = _given(path)
        return _checked(file, given, wire)

    @staticmethod
    def read_all(path: str | Path) -> "dict[str, PlanFile]":
        """Read the plans of a file by their wires' keys, in the order of drilling; "" in a file of one wire.

        Raises UnusableInputError.
        """
        file, given = _given(path)
        return {key: _checked(file, given, key or None) for key in _wires(given) or [""]}

    def refuse_contradictions(self) -> None:
        """Raise UnusableInputError if the file contradicts itself: GO beside a failed check or another verdict, a
        digest without verdict, kind or limits, no checks, entry and end at one point, an invalid covariance."""
        document = self.document
        if document.digest is not None and None in (document.verdict, document.kind, document.limits):
            raise UnusableInputError("it has a digest, but no verdict, kind or limits; plan again")
        if document.verdict is not None and document.go != (document.verdict == "go"):
            raise UnusableInputError(f"its verdict is {document.verdict!r} and go {document.go}; plan again")
        if self.document.go and self.failed:
            raise UnusableInputError(f"it says GO beside failed checks ({', '.join(self.failed)}); plan again")
        if not self.document.checks or self.length_mm < 1.0:
            raise UnusableInputError("it has no checks, or entry and end are one point; plan again")
        covariance = self.covariance_mm2
        if covariance is not None and np.linalg.eigvalsh(covariance).min() < -1e-9 * np.abs(covariance).max():
            raise UnusableInputError("its covariance is not positive; plan again")

    def refuse_for_robot(self) -> None:
        """Raise RobotRefusedError unless this plan may be sent to a robot."""
        document = self.document
        if not document.go:
            raise RobotRefusedError(
                f"the plan is {self.verdict}: it is not sent to a robot; see its checks, and plan again"
            )
        if document.all_wires not in (None, "go"):
            raise RobotRefusedError(
                f"the plan of all wires is {document.all_wires.upper()}: none of them is sent to a robot; see its "
                "checks and relations, and plan again"
            )
        if ProcedureKey.of(document.kind or "").wire:  # one of several
            refuse_unrelated(document.unchecked_relations)
        if document.digest is None:
            raise RobotRefusedError(
                "the plan was written by an older version without a digest, so changes cannot be detected; plan again"
            )
        if document.side is None:
            raise RobotRefusedError("the plan does not say which side of the patient it is for: plan again with --side")
        if self.covariance_mm2 is None:
            raise RobotRefusedError("the plan's error is unknown; calibrate both views from beads")

    def refuse_other_side(self, side: str) -> None:
        """Raise UnusableInputError if the plan is for the other side, as it states or as its wire shows.

        A wire that is checked against the side, such as that of a hip screw, runs from the lateral cortex up into the
        head, so its entry lies caudal of its end.
        """
        if self.side is not None and self.side != side:
            raise UnusableInputError(
                f"--side is {side}, but the plan is of the {self.side} side; find out which it is, and plan again if "
                "the plan is wrong"
            )
        entry, end = self.points_mm
        down_mm = float((entry - end) @ caudal(side))
        of_hip = self.document.kind == "hip-screw" or any(
            (check.code or check.name) == CheckCode.SIDE for check in self.document.checks
        )
        if of_hip and down_mm < -_MIN_RISE_MM:
            other = "left" if side == "right" else "right"
            raise UnusableInputError(
                f"the side is given as {side}, but the wire is that of a {other} hip: in a {side} one its entry would "
                f"lie {-down_mm:.0f} mm above its end; find out which it is, and plan again with that --side"
            )

    @property
    def go(self) -> bool:
        """Whether the verdict is GO."""
        return self.document.go

    @property
    def side(self) -> Literal["right", "left"] | None:
        """The patient's side; None if the plan does not state it."""
        return self.document.side

    @property
    def procedure(self) -> str:
        """Key of the procedure's file; "" if the plan does not state it."""
        return ProcedureKey.of(self.document.kind or "").file

    @property
    def images(self) -> dict[str, str]:
        """The image of each view that the plan was made on, by the name that a case gives its file."""
        return {view.view: view.source for view in self.document.views}

    @property
    def frame(self) -> str:
        """Fingerprint of the frame's file; "" if the plan does not state it."""
        return self.document.frame.fingerprint if self.document.frame else ""

    @property
    def of_solid(self) -> bool:
        """Whether the plan was made with a solid, a block, instead of plates."""
        return self.document.frame is not None and any(bead.plate == SOLID for bead in self.document.frame.beads)

    def identifier(self, name: str) -> str:
        """Return the identifier that a robot is sent; plans with other images or points have other identifiers."""
        return f"{name}-{(self.document.digest or '').removeprefix('sha256:')[:12]}"

    @property
    def limits(self) -> Limits:
        """The limits that the plan was judged by. Raises UnusableInputError for a plan of an older version."""
        limits = self.document.limits
        if limits is None:
            raise UnusableInputError("the plan was written by an older version without its limits; plan again")
        direction_rad = float(np.deg2rad(limits.direction_deg))
        return Limits(limits.position_mm, direction_rad, limits.beyond_mm, limits.before_mm)

    @property
    def failed(self) -> list[str]:
        """Names of the failed checks."""
        return [check.name for check in self.document.checks if not check.passed]

    @property
    def points_mm(self) -> np.ndarray:
        """Entry and end (2, 3), CFCS."""
        return np.array([self.document.trajectory.entry_mm, self.document.trajectory.end_mm])

    @property
    def length_mm(self) -> float:
        """Length from entry to end."""
        return float(np.linalg.norm(self.points_mm[1] - self.points_mm[0]))

    @property
    def covariance_mm2(self) -> np.ndarray | None:
        """Joint covariance (6, 6) of entry and end; None if unknown."""
        given = self.document.trajectory.covariance_mm2
        return None if given is None else reading.array(given, (6, 6), "the covariance")

    @property
    def trajectory(self) -> Trajectory:
        """The trajectory, without the distances between lines of sight, which planning has judged already."""
        none = np.zeros(2)
        points = SpacePoints(self.points_mm, none, none > 0, None, self.covariance_mm2, None, none == 0)
        return Trajectory(points)

    @property
    def errors_95_mm(self) -> tuple[float, float] | None:
        """95 % bounds of the errors of entry and end; None if unknown."""
        c = self.covariance_mm2
        return None if c is None else (float(length_quantile(c[:3, :3])), float(length_quantile(c[3:, 3:])))

    @property
    def verdict(self) -> str:
        """GO, or NO-GO with the failed checks, or INCOMPLETE with the checks that could not be made."""
        if self.go:
            return "GO"
        names = ", ".join(dict.fromkeys(self.failed)) or "see the plan"
        return f"INCOMPLETE (missing: {names})" if self.document.verdict == "incomplete" else f"NO-GO (failed: {names})"

    @property
    def statement(self) -> str:
        """The statement that every exported file carries, as far as its format allows."""
        errors = self.errors_95_mm
        stated = (
            "errors unknown" if errors is None else f"95 % errors: entry {errors[0]:.2f} mm, end {errors[1]:.2f} mm"
        )
        state = self.document.all_wires
        of_all = "" if state in (None, "go") else f"; the plan of all wires is {state.upper()}"
        return (
            f"{self.verdict}{of_all}; {stated}; wire {self.length_mm:.1f} mm; research software, not a medical device"
        )

    @property
    def plates(self) -> Mapping[str, Pinhole]:
        """The pinhole of each view's undistorted image. Raises UnusableInputError if the plan has none."""
        return {name: opencv.of_document(given, name) for name, given in self._plates().items()}

    def pixels(self, view: str) -> tuple[np.ndarray, float] | None:
        """Return the undistorted image (H, W) of a view and its white; None if the plan was made without images."""
        given = self._plates()[view]
        name = given.get("file")
        if name is None:
            return None
        if not isinstance(name, str) or Path(name).name != name:
            raise UnusableInputError(f"the image of view {view} must be a plain file name without a folder; plan again")
        image = read_image(self._folder / name)
        if image.shape != self.plates[view].shape:
            raise UnusableInputError(f"{name} is not the image that the plan was made on: its size differs")
        return image.pixels, reading.positive(given.get("white", image.white), "white")

    def _plates(self) -> dict[str, dict[str, Any]]:
        if not self.document.plates:
            raise UnusableInputError("the plan holds no geometry of its images; plan again with --out")
        return self.document.plates


def _given(path: str | Path) -> tuple[Path, dict[str, Any]]:
    """Return the file of plan.json, or of the one in a folder, and its content. Raises UnusableInputError."""
    file = Path(path) / "plan.json" if Path(path).is_dir() else Path(path)
    data = reading.read_bytes(file, MAX_JSON_BYTES)
    with naming(file):
        given = reading.json_object(data, depth=12)
        if _DIGEST in given and given[_DIGEST] != sealed(given)[_DIGEST]:
            raise UnusableInputError("it was changed after it was made: its digest does not match; plan again")
    return file, given


def _checked(file: Path, given: Mapping[str, Any], wire: str | None) -> PlanFile:
    """Return the plan of a file's content, of one of its wires where it has several. Raises UnusableInputError."""
    with naming(file, "plan again with --out"):
        plan = PlanFile(PlanFileDocument.model_validate_json(json.dumps(_of_wire(given, wire))), file.parent)
        plan.refuse_contradictions()
    return plan


POINTS = ("entry", "end")


def bundle(plan: Plan, images: Sequence[CalibratedImage], frame: Frame) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the keys to add to plan.json, and the undistorted images as files to write beside it."""
    plates, files = {}, {}
    for image in images:
        seen = image.seen.image
        plate = plate_image(image.view, None if seen is None else seen.pixels)
        plates[image.name] = opencv.document(plate.pinhole) | {"file": None}
        if plate.pixels is not None and seen is not None and plate.pixels.dtype in (np.uint8, np.uint16):
            name = f"{image.name}-plate.png"
            files[name] = cv2.imencode(".png", plate.pixels)[1].tobytes()
            plates[image.name] |= {"file": name, "white": seen.white}
    document = {
        "frame": frame_document(frame),
        "plates": plates,
        "lines_of_sight": [line for k, image in enumerate(images) for line in _lines(plan, k, image)],
        "drawn": {image.name: _drawn(plan, k, image) for k, image in enumerate(images)},
    }
    return document, files


def frame_document(frame: Frame) -> dict[str, Any]:
    """Return the frame of a plan as the JSON types of `FrameReference`."""
    bodies = frame.named_plates if frame.solid is None else (("all", SOLID, frame.solid),)  # the rest is not CFCS
    beads = [
        {"id": bead.id, "view": name, "plate": role, "xyz_mm": list(map(float, bead.xyz_mm))}
        for name, role, body in bodies
        for bead in body.fiducials
    ]
    return {"name": frame.name, "serial": frame.serial, "fingerprint": frame.fingerprint, "beads": beads}


def _lines(plan: Plan, k: int, image: CalibratedImage) -> list[dict[str, Any]]:
    uv = np.array([pick[k].uv_px for pick in plan.picks])
    shown = np.isfinite(uv).all(axis=1)
    sight = image.view.lines_of_sight(uv[shown])
    return [
        {
            "point": point,
            "view": image.name,
            "focal_point_mm": sight.focal_point_mm.tolist(),
            "plate_mm": sight.points_mm[i].tolist(),
        }
        for i, point in enumerate(np.array(POINTS)[shown].tolist())
    ]


def _drawn(plan: Plan, k: int, image: CalibratedImage) -> dict[str, Any]:
    """Return the picks of an image, for a point that it was not picked in the point's projection, and its wire."""
    picks = np.array([pick[k].uv_px for pick in plan.picks], dtype=np.float64)
    missed = np.isnan(picks).any(axis=1)
    if missed.any():
        picks[missed] = image.view.project(plan.trajectory.points.xyz_mm[missed])
    entry, end = picks.tolist()
    path = plan.trajectory
    along = path.entry_mm + np.linspace(0, 1, DRAWN_POINTS)[:, None] * (path.end_mm - path.entry_mm)
    try:
        wire = image.view.project(along).tolist()
    except OutsideRegionError:
        wire = []
    return {"entry_px": entry, "end_px": end, "wire_px": wire}
