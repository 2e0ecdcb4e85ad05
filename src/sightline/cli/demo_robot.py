"""The demo's second half: the planned wire drilled by the simulated robot over its link, and a check shot."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from sightline.calibration import BeadView
    from sightline.case.drilled import Drilled
    from sightline.cli.output import Output
    from sightline.planning import Plan
    from sightline.twin import HipScene, SetUp


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan on the twin and what it was made on; `landmarks_px` (2, L, 2): the bone's by `landmarks`, their names, as
    picked with `pick_sd_px`."""

    setup: "SetUp"
    hip: "HipScene"
    plan: "Plan"
    views: "list[BeadView]"
    landmarks: tuple[str, ...]
    landmarks_px: "np.ndarray"
    pick_sd_px: float


def drill(output: "Output", planned: Planned, rng: "np.random.Generator") -> "Drilled | None":
    """What robot and check shot come to; None, with the reason said, where there is no robot or it refuses."""
    from sightline.errors import RefusedError

    if find_spec("mujoco") is None:
        output.note("the robot's part is left out: it needs MuJoCo, pip install 'sightline[robot]'")
        return None
    try:
        return _drill(output, planned, rng)
    except RefusedError as error:
        output.say(f"not drilled: {error}")
        return None


def _drill(output: "Output", planned: Planned, rng: "np.random.Generator") -> "Drilled":
    import numpy as np

    from sightline.case.drilled import Deviation, Drilled
    from sightline.errors import RefusedError
    from sightline.planning.check_shot import Landmarks
    from sightline.rehearsal.check_images import CheckImages
    from sightline.rehearsal.operation import Outcome, Theatre
    from sightline.rehearsal.robots import calibrated_robot
    from sightline.robot.supervision import depth_limit

    setup, hip, sd_px = planned.setup, planned.hip, planned.pick_sd_px
    with output.step("6/8 the robot: carrying the plan over, aligning, drilling under force supervision"):
        theatre = Theatre.draw(calibrated_robot(setup.side), hip, rng, setup.frame.serial or "none", setup.side)
        target = theatre.target(planned.plan, "demo")
        record = theatre.drill(target, depth_limit(_surface_mm(planned, rng), target.end_error_95_mm))
    with output.step("7/8 the check shot: two more images, the wire found in both"):
        wire = theatre.wire_mm()
        shot = CheckImages.take(setup, hip, wire, theatre.back_at_images(rng), rng)
        found = shot.landmarks_px(planned.landmarks, sd_px, rng)
        try:
            check = shot.compare(planned.plan, planned.views, Landmarks(planned.landmarks_px, found, sd_px))
        except RefusedError as error:
            check = str(error)
    physics = []
    for name, line in (("the plan", planned.plan.trajectory.points.xyz_mm), ("the ideal wire", hip.wire_mm)):
        one = Outcome.of(wire, line)
        physics.append(Deviation(name, one.entry_mm, one.end_mm, float(np.rad2deg(one.angle_rad))))
    return Drilled(target, record, check, tuple(physics))


def _surface_mm(planned: Planned, rng: "np.random.Generator") -> float:
    """How far the head's surface lies beyond the planned entry, along the wire: picked in both views like the rest."""
    import numpy as np

    from sightline.planning import reconstruct
    from sightline.twin.femur import SHORT_MM

    entry, end = planned.hip.wire_mm
    surface = end + SHORT_MM * (end - entry) / np.linalg.norm(end - entry)
    uv = np.stack([planned.setup.views[view.name].project(surface[None]) for view in planned.views])
    uv = uv + planned.pick_sd_px * rng.standard_normal(uv.shape)
    spread = np.broadcast_to(planned.pick_sd_px**2 * np.eye(2), (2, 1, 2, 2))
    found = reconstruct(planned.views, uv, spread).xyz_mm[0]
    trajectory = planned.plan.trajectory
    return float((found - trajectory.entry_mm) @ trajectory.direction)
