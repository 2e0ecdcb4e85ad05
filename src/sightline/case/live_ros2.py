"""What ROS 2 is shown of a procedure in progress: the messages of `live`, in metres, by topic (docs/live.md)."""

import re
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.case.interop.bone import CT
from sightline.case.live import NO_PLAN, LiveMessages, LiveState, ShownImage
from sightline.common.checks import Check, failed
from sightline.common.closing import Closing
from sightline.errors import SetUpError, UnusableInputError
from sightline.robot.contract import Code
from sightline.robot.igtl import Image, Message, Status, Transform
from sightline.robot.ros2_values import ERROR, OK, WARN, Diagnosis, FramePose, ImageCamera, Picture, Value

SCHEME = "ros2:"
_NAMESPACE = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)  # [src: rclpy.validate_namespace]
PATIENT = "patient_ras"  # x right, y anterior, z superior
_POSES = {"wire": "target", "tool": "tool"}  # topics of poses, by frame


def broadcast(address: str, state: Callable[[], LiveState]) -> Closing:
    """Publish `state` for ROS 2 at `address`, ros2:/NAMESPACE, until it is closed.

    Raises UnusableInputError for another address, SetUpError without ROS 2.
    """
    namespace = address.removeprefix(SCHEME)
    if not _NAMESPACE.fullmatch(namespace):
        raise UnusableInputError(
            f"{namespace!r} is not a namespace of ROS 2: give / and a name of letters, digits and underscores, "
            f"such as {SCHEME}/sightline"
        )
    try:
        for messages in ("diagnostic_msgs.msg", "tf2_msgs.msg"):  # the wheels of the extra have no tf2_msgs
            import_module(messages)
        from sightline.robot.transport.ros2 import Ros2Broadcast
    except ImportError as error:
        raise SetUpError(
            f"--serve {SCHEME} needs ROS 2 with rclpy, tf2_msgs and diagnostic_msgs ({error}): source its setup.bash, "
            "or see docs/live.md for what to install"
        ) from error
    return Ros2Broadcast(namespace, LiveTopics(state), "sightline")


class LiveTopics:
    """Makes the values of `state`, which is called for each set of them, by topic. An image's value is made once."""

    def __init__(self, state: Callable[[], LiveState]) -> None:
        self._state, self._messages = state, LiveMessages(state)
        self._images: dict[str, tuple[Message, Picture]] = {}

    def __call__(self) -> dict[str, Value]:
        """Return the values of now."""
        state = self._state()
        messages = {message.device_name: message for message in self._messages.of(state)}
        placed = {
            name: message.body.matrix for name, message in messages.items() if isinstance(message.body, Transform)
        }
        poses = tuple(_pose(name, matrix, state) for name, matrix in placed.items())
        topics: dict[str, Value] = {_POSES[pose.frame]: pose for pose in poses if pose.frame in _POSES}
        for name, shown in state.images.items():
            message, at = messages[name], _token(name)
            if isinstance(message.body, Image):
                known = self._images.get(name)
                if known is None or known[0] is not message:
                    known = message, picture_of(name, shown, message.body, placed[f"{name}-to-cfcs"])
                    self._images[name] = known
                topics |= {f"{at}/image/compressed": known[1], f"{at}/camera_info": known[1].camera}
        topics["/diagnostics"] = diagnoses_of(state, messages)
        return topics | ({"/tf": poses} if poses else {})


def picture_of(name: str, shown: ShownImage, image: Image, pose: np.ndarray) -> Picture:
    """Return the resampled image of a view as that of a pinhole, from its IMAGE and the pose (4, 4) of the view."""
    pixels, to_camera, white = image.pixels[0], pose[:3, :3].T, shown.image.white
    if pixels.dtype == np.float32:
        pixels = np.rint(np.clip(pixels / white, 0.0, 1.0) * 65535).astype(np.uint16)
    step_mm = np.diagonal(to_camera @ image.matrix[:3, :2])  # along columns and rows, which are the camera's x and y
    if step_mm[1] < 0:  # the plate's normal points against the beam: rows would run upwards
        pixels = np.ascontiguousarray(pixels[::-1])
    middle_mm = to_camera @ (image.matrix[:3, 3] - pose[:3, 3])
    matrix = np.eye(3)
    matrix[[0, 1], [0, 1]] = middle_mm[2] / np.abs(step_mm)
    matrix[:2, 2] = (np.array(pixels.shape[::-1]) - 1) / 2 - middle_mm[:2] / np.abs(step_mm)
    camera = ImageCamera(_optical(name), shown.stamped_s or 0.0, matrix, (pixels.shape[0], pixels.shape[1]))
    _, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])  # 1: fast
    return Picture(camera, f"mono{8 * pixels.itemsize}", png.tobytes())


def diagnoses_of(state: LiveState, messages: Mapping[str, Message]) -> tuple[Diagnosis, ...]:
    """Return the verdict, each STATUS of `messages`, and the checks of views and bone."""
    level = WARN if state.verdict is None else ERROR if state.wire_mm is None else OK
    parts = [Diagnosis("sightline: plan", level, state.verdict or NO_PLAN)]
    for name, message in messages.items():
        if isinstance(status := message.body, Status):
            text = ": ".join(filter(None, (status.error_name, status.text)))
            parts.append(Diagnosis(f"sightline: {name}", OK if status.code == Code.OK else ERROR, text))
    parts += [_checked(f"view {name}", shown.view.checks) for name, shown in state.images.items()]
    return (*parts, *([] if state.bone is None else [_checked(CT, state.bone.checks)]))


def _checked(name: str, checks: Sequence[Check]) -> Diagnosis:
    failing = failed(checks)
    text = " ".join(check.sentence for check in failing) or f"{len(checks)} checks passed"
    values = {
        check.name: " ".join(filter(None, ("" if check.passed else "failed", check.value_text, check.limit_text)))
        for check in (*checks, *failing)  # of checks of one name, that which failed
    }
    return Diagnosis(f"sightline: {name}", ERROR if failing else OK, text, values)


def _pose(name: str, matrix: np.ndarray, state: LiveState) -> FramePose:
    """Return the place by the TRANSFORM `name`, such as live-to-cfcs."""
    frame, _, parent = name.rpartition("-to-")
    if frame in state.images:
        frame = _optical(frame)
    return FramePose.of(PATIENT if parent == "ras" else parent, frame, RigidTransform.from_matrix(matrix))


def _optical(view: str) -> str:
    """Return the frame of a view: x along the image's columns, y along its rows, z along the beam [src: REP-103]."""
    return f"{_token(view)}_optical_frame"


def _token(view: str) -> str:
    """Return the name of a view as ROS 2 takes it in topics."""
    return re.sub(r"[^A-Za-z0-9]+|^(?=[0-9])", "_", view)
