"""What other programs are shown of a procedure in progress: OpenIGTLink messages in CFCS, mm (docs/live.md).

What must not be trusted is not sent: a plan that is not GO is an empty TRAJ, and a bone's pose whose checks failed is
left out. A message that is no longer sent no longer holds.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from sightline.calibration import BeadView
from sightline.calibration.maps.undistort import PlaneImage, undistort
from sightline.case.interop.bone import CT
from sightline.case.interop.formats import T_cfcs_wire, T_lps_cfcs
from sightline.case.interop.slicer import RAS_LPS
from sightline.case.watch.analyser import Watched
from sightline.errors import SightlineError
from sightline.imaging import Radiograph
from sightline.planning.bone.registered import RegisteredBone
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import Image, Message, Path, Status, String, Trajectories, Transform, timestamp_of
from sightline.robot.igtl.messages import Body

# Device names of the live image and of its STATUS; planning images have the names of their views.
LIVE, STATUS = "live", "status"
NO_PLAN = "no plan"
_METADATA = {contract.UNITS: contract.MM, contract.COORDINATES: contract.CFCS}
# [ours] a quarter of a pixel of 0.4 mm: below it the resampling of the image before is used, which takes 0.1 s to make.
_SAME_MM = 0.1


@dataclass(frozen=True, eq=False)
class ShownImage:
    """An image, its view, and when it was received, s since 1970; None if unknown."""

    image: Radiograph
    view: BeadView
    stamped_s: float | None = None


@dataclass(frozen=True, eq=False)
class LiveState:
    """A procedure at one moment.

    `statuses`, `images`: by device name. `verdict`: on the plan, for people; None without one. `wire_mm`: its entry and
    end (2, 3), CFCS, where it is GO, else None. `bone`: None without one. `T_cfcs_tool` (4, 4): pose of the robot's
    tool. `side`: of the patient; None where the axes of CFCS are not known in the patient.
    """

    statuses: Mapping[str, Status] = field(default_factory=dict)
    images: Mapping[str, ShownImage] = field(default_factory=dict)
    verdict: str | None = None
    wire_mm: np.ndarray | None = None
    bone: RegisteredBone | None = None
    T_cfcs_tool: np.ndarray | None = None
    side: str | None = None


def status_of(watched: Watched | None) -> Status:
    """Return the status of a live image: good only if it is fresh, has a view, and nothing moved."""
    if watched is None:
        return Status(Code.NOT_READY, "WAITING", "no live image yet")
    if watched.moved and watched.movement is not None:
        return Status(Code.NOT_READY, "MOVED", watched.movement.text)
    if watched.stale:
        return Status(Code.NOT_READY, "STALE", f"the newest image is {watched.age_s:.1f} s old")
    if watched.view is None:
        return Status(Code.NOT_READY, "NO_VIEW", watched.reason)
    return Status(Code.OK, "", watched.note if watched.movement is None else watched.movement.text)


def shown_of(watched: Watched | None) -> dict[str, ShownImage]:
    """Return the live image by its device name; none if it gave no view."""
    if watched is None or watched.view is None:
        return {}
    return {LIVE: ShownImage(watched.image, watched.view, watched.stamped_s)}


@dataclass(frozen=True, eq=False)
class _Sent:
    """The message of an image, and the view and plane by which it was resampled."""

    shown: ShownImage
    by: BeadView
    plane: PlaneImage
    message: Message

    def serves(self, view: BeadView) -> bool:
        """Return True if an image of `view` is resampled alike to within _SAME_MM on the plate."""
        corners = self.by.hull.corners_px
        return (view.name, view.frame_key, view.image_shape) == (
            self.by.name,
            self.by.frame_key,
            self.by.image_shape,
        ) and bool(np.abs(view.plane_map.to_plane(corners) - self.by.plane_map.to_plane(corners)).max() < _SAME_MM)


class LiveMessages:
    """Makes the messages of `state`, which is called for each set of them. An image's message is made once."""

    def __init__(self, state: Callable[[], LiveState]) -> None:
        self._state = state
        self._sent: dict[str, _Sent] = {}

    def __call__(self) -> list[Message]:
        """Return the messages of now."""
        return self.of(self._state())

    def of(self, state: LiveState) -> list[Message]:
        """Return the messages of `state`."""
        now = timestamp_of(time.time())
        poses = {f"{name}-to-cfcs": view_pose(shown.view) for name, shown in state.images.items()}
        if state.bone is not None and state.bone.trusted:
            poses[f"{CT}-to-cfcs"] = state.bone.matrix
        if state.T_cfcs_tool is not None:
            poses["tool-to-cfcs"] = state.T_cfcs_tool
        if state.side is not None:
            poses["cfcs-to-ras"] = RAS_LPS @ T_lps_cfcs(state.side)
        paths = ()
        if state.wire_mm is not None:
            poses["wire-to-cfcs"] = T_cfcs_wire(state.wire_mm)
            paths = (Path("planned wire", *state.wire_mm, group="Sightline", owner=contract.CFCS),)
        bodies: dict[str, Body] = {name: Transform(pose) for name, pose in poses.items()}
        bodies |= {**state.statuses, "verdict": String(state.verdict or NO_PLAN), "plan": Trajectories(paths)}
        small = [Message(body, name, now, version=2, metadata=_METADATA) for name, body in bodies.items()]
        return [*small, *(self._image(name, shown) for name, shown in state.images.items())]

    def _image(self, name: str, shown: ShownImage) -> Message:
        sent = self._sent.get(name)
        if sent is None or sent.shown.image is not shown.image or sent.shown.view is not shown.view:
            try:
                sent = self._sent[name] = _resampled(name, shown, sent)
            except SightlineError as error:
                return Message(Status(Code.NOT_READY, "NO_IMAGE", str(error)), name)
        return sent.message


def _resampled(name: str, shown: ShownImage, sent: _Sent | None) -> _Sent:
    if sent is not None and sent.serves(shown.view):
        by, plane = sent.by, sent.plane
        u, v = np.moveaxis(plane.uv_px.astype(np.float32), 2, 0)
        pixels = cv2.remap(shown.image.pixels, u, v, cv2.INTER_CUBIC)
    else:
        by, plane = shown.view, undistort(shown.image.pixels, shown.view.plane_map, shown.view.hull)
        pixels = plane.pixels
    stamp = 0 if shown.stamped_s is None else timestamp_of(shown.stamped_s)
    body = Image(pixels[None], image_matrix(by, plane))
    return _Sent(shown, by, plane, Message(body, name, stamp, version=2, metadata=_METADATA))


def view_pose(view: BeadView) -> np.ndarray:
    """Return the pose (4, 4) of a view, CFCS: origin at the X-ray source, +z along the beam, +x along the image's rows
    as they lie on the XRII plate."""
    plane = view.plane
    along = -np.sign(float(plane.height_mm(view.focal_point_mm))) * plane.normal
    pose = np.eye(4)
    pose[:3] = np.column_stack([plane.axes[0], np.cross(along, plane.axes[0]), along, view.focal_point_mm])
    return pose


def image_matrix(view: BeadView, image: PlaneImage) -> np.ndarray:
    """Return the matrix (4, 4) of IMAGE for an image resampled to a view's plane: steps, CFCS, and its centre."""
    height, width = image.pixels.shape
    steps = image.spacing_mm * view.plane.axes
    middle = image.origin_mm + image.spacing_mm * np.array([width - 1, height - 1]) / 2
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([*steps, view.plane.normal, view.plane.origin_mm + middle @ view.plane.axes])
    return matrix
