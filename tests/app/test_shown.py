"""What the app shows to other programs: images and plan of the open session, the arm as it stands, the live image."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.app.test_mirrored import _table

from sightline.app.session.jobs import WorkerProcess
from sightline.app.session.robot_session import RobotNow
from sightline.app.session.seen import SeenImage
from sightline.app.session.session import Session
from sightline.app.session.shown import ShownSession
from sightline.case import stages
from sightline.case.journal import Actor
from sightline.case.live import LiveMessages
from sightline.case.views import NAMES, calibrated, see_pair
from sightline.common.checks import Check
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning.points.results import Verdict
from sightline.robot.kinematics.designs import DESIGNS
from sightline.twin import SetUp

IMAGE = Radiograph(np.full((1024, 1024), 2000, np.uint16), 4095)
WIRE_MM = np.array([[-20.3, 11.2, -9.7], [22.1, -14.6, 13.4]])
FAILED = Check("gap", False, 5.0, 3.5, "σ", "The lines of sight pass 2 mm apart.")


@pytest.fixture
def opened(setup: SetUp, frame: Frame, worker: WorkerProcess, tmp_path: Path) -> Iterator[Session]:
    """A session with both images calibrated."""
    session = Session.open(tmp_path / "case", "gamma", None, worker)
    tables = [_table(setup, name, tmp_path, mirrored=False) for name in NAMES]
    for table, seen in zip(tables, see_pair(tables[0], tables[1], frame), strict=True):
        image = calibrated(seen, frame)
        made = stages.record_view(session.planning.case, table, image, frame_ref="gamma", by=Actor.RECEIVER)
        acquired = stages.acquired_of(session.planning.case, made)
        one = SeenImage(acquired, IMAGE, observations=seen.observations, view=image.view)
        session.planning.lightbox._images[acquired.number] = one
        session.planning.edit(session.planning.decisions.with_image(image.name, acquired.number, same_pixels=False))
    yield session
    session.planning.case.close()


def names(shown: ShownSession) -> set[str]:
    return {message.device_name for message in LiveMessages(shown)()}


ALWAYS = {"status", "verdict", "plan"}
VIEWS = {"pa", "pa-to-cfcs", "lateral", "lateral-to-cfcs"}


def test_images_and_side_are_those_of_the_last_change(opened: Session) -> None:
    shown = ShownSession()
    assert names(shown) == {"verdict", "plan"}
    shown.follow(opened)
    assert names(shown) == ALWAYS | VIEWS
    assert shown().verdict == "no plan"
    opened.planning.decide(side="left")
    assert shown().side == "left"
    assert names(shown) == ALWAYS | VIEWS | {"cfcs-to-ras"}


@pytest.mark.parametrize(("checks", "said"), [((), "GO"), ((FAILED, FAILED), "NO-GO (gap)")])
def test_only_a_plan_that_is_go_is_shown(
    opened: Session, monkeypatch: pytest.MonkeyPatch, checks: tuple[Check, ...], said: str
) -> None:
    points = SimpleNamespace(points=SimpleNamespace(xyz_mm=WIRE_MM))
    plan = SimpleNamespace(verdict=Verdict(checks), trajectory=points)
    monkeypatch.setattr(type(opened.planning), "planned", SimpleNamespace(plan=plan))
    shown = ShownSession()
    shown.follow(opened)
    assert shown().verdict == said
    assert (shown().wire_mm is WIRE_MM) == (said == "GO")


def test_the_tool_is_where_the_arm_holds_it(opened: Session) -> None:
    """The frame is on the patient, as imaged; the arm moves its tool by 12 mm along itself."""
    arm = DESIGNS["manipulator"]("right")
    q = np.zeros(len(arm.joints))
    moved = arm.fed(q, 12.0)
    now = RobotNow(state="ALIGNED", text="waits", joints=moved)
    robot: Any = SimpleNamespace(now=now, robot=SimpleNamespace(manipulator=arm), imaged_q=q)
    opened.drilling.session = robot
    shown = ShownSession()
    shown.follow(opened)
    state = shown()
    before = (arm.T_mcs_cfcs(q).inv() * arm.T_mcs_tool(q)).apply([[0.0, 0.0, 0.0], [0.0, 0.0, 12.0]])
    np.testing.assert_allclose(state.T_cfcs_tool[:3, 3], before[1], atol=1e-6)
    assert (state.statuses["robot"].code, state.statuses["robot"].error_name) == (1, "ALIGNED")
    robot.now = replace(now, fault=7)
    assert (shown().statuses["robot"].code, shown().statuses["robot"].subcode) == (18, 7)
    robot.now = replace(now, lost=True)
    assert shown().T_cfcs_tool is None
    assert shown().statuses["robot"].error_name == "LOST"


def test_the_live_image_is_shown_beside_the_planning_images(opened: Session) -> None:
    shown = ShownSession()
    shown.follow(opened)
    view = opened.planning.views()[0]
    watched = SimpleNamespace(
        image=IMAGE, view=view, stamped_s=1.0, stale=False, moved=False, movement=None, note="at rest"
    )
    opened.live.watch = SimpleNamespace(latest=lambda: watched)
    assert names(shown) == ALWAYS | VIEWS | {"live", "live-to-cfcs"}
    assert shown().statuses["status"].text == "at rest"
    opened.live.watch = SimpleNamespace(latest=lambda: None)
    assert names(shown) == ALWAYS | VIEWS
    assert shown().statuses["status"].error_name == "WAITING"
