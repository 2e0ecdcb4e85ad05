"""The optional bone in the app: files that are taken and refused, landmarks clicked in both images, a pose accepted,
discarded, restored, and in the verdict."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.registration import balls

from sightline.app.plan.decisions import Mark
from sightline.app.plan.found_bone import FoundBone
from sightline.app.plan.planner import request_of
from sightline.app.session.bone import MAX_POINTS
from sightline.app.session.session import Session
from sightline.app.tab.placing import Placing, ProcedureStep
from sightline.case.journal import Actor, Kind
from sightline.case.views import NAMES
from sightline.common.checks import Check, CheckCode, failed
from sightline.errors import SightlineError, UnusableInputError
from sightline.imaging.volumes.ct import write_ct
from sightline.planning.bone.registered import BoneView, RegisteredBone

AT = {"shaft": balls.CENTRES_MM[4], "head": balls.CENTRES_MM[0], "side": balls.CENTRES_MM[1]}
OFF_PX = np.array([2.0, -1.5])  # of a click: 1 mm at the bone
OPEN_MESH = b"v 0 0 0\nv 30 0 0\nv 0 30 0\nv 0 0 30\nf 1 3 2\nf 1 2 4\nf 1 4 3\n"
EDGE_PX = 3.0  # of a silhouette of 1 mm voxels, pooled


class AtHand:
    """Does the worker's work at once."""

    async def do(self, work: Callable[..., Any], *given: Any) -> Any:
        return work(*given)


def table(**points: np.ndarray) -> bytes:
    rows = [f"{name},LPS,{x},{y},{z}" for name, (x, y, z) in points.items()]
    return "\n".join(["name,coordinates,x_mm,y_mm,z_mm", *rows]).encode()


def opened(folder: Path, scene: balls.Scene) -> Session:
    """A session on a case whose images, with their views, are those of a scene."""
    worker: Any = AtHand()
    made = Session.open(folder, "gamma", None, worker)
    planning: Any = made.planning
    images = dict(zip(NAMES, zip(scene.images(), scene.views, strict=True), strict=True))
    planning.views = lambda names=NAMES: scene.views if names == NAMES else None
    entry = SimpleNamespace(at=datetime.now(UTC), by=Actor.DEMO)

    def seen(name: str) -> Any:
        image, view = images.get(name, (None, None))
        return None if image is None else SimpleNamespace(image=image, view=view, acquired=entry, taken_at=None)

    planning.seen = seen
    planning._reopen = planning.jobs.notify  # the images above are in no journal
    return made


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    scan = balls.scan(voxel_mm=2.0)
    in_fat = replace(scan, hu=np.where(scan.hu > balls.TISSUE_HU, scan.hu, np.int16(-110)))
    return write_ct(in_fat, tmp_path_factory.mktemp("ct") / "ct.nrrd").read_bytes()


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    made = opened(tmp_path / "case", balls.Scene())
    made.planning.decide(images={"pa": 11, "lateral": 12})
    yield made
    made.planning.case.close()


def click(session: Session, *names: str, off_px: Sequence[np.ndarray]) -> None:
    """Click landmarks in both images, the first off its place by pixels (2,) for each image."""
    for k, name in enumerate(names):
        at, seen = balls.POSE.apply(AT[name])[None], zip(balls.Scene().views, off_px, strict=True)
        places = {view.name: tuple((view.project(at)[0] + (OFF_PX if k else off)).tolist()) for view, off in seen}
        session.planning.edit(session.planning.decisions.with_mark(f"bone-{name}", Mark(places)))


def run(work: Awaitable[Any]) -> Any:
    async def done() -> Any:
        return await work

    return asyncio.run(done())


def test_a_bone_is_registered_accepted_kept_and_undone(session: Session, ct: bytes) -> None:
    bone, planning = session.bone, session.planning
    run(bone.take(ct, ".nrrd"))
    assert bone.ready, "without landmarks no start is needed"
    run(bone.take(table(**AT), ".csv"))
    asked = []
    while (goal := Placing(session).goal(ProcedureStep.CALIBRATE)) is not None:
        asked.append((goal.spec.label, goal.image))
        mark = planning.decisions.mark(goal.spec.name)
        at = balls.Scene().views[NAMES.index(goal.image)].project(balls.POSE.apply(AT[goal.spec.label])[None])[0]
        planning.edit(planning.decisions.with_mark(goal.spec.name, mark.placed(goal.image, tuple(at + OFF_PX))))
        assert bone.ready == (len(asked) >= 4)
    assert asked == [(name, image) for name in AT for image in NAMES]
    run(bone.register())
    found = bone.found
    assert found is not None and not bone.asked
    matrix = np.array(found.pose["matrix"])
    off = balls.CENTRES_MM @ matrix[:3, :3].T + matrix[:3, 3] - balls.POSE.apply(balls.CENTRES_MM)
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert found.error.startswith("95 % error 0.") and not failed(found.judged)
    assert {CheckCode.BONE_FIT, CheckCode.BONE_MOVEMENT} <= {check.code for check in found.judged}
    _edges_are_silhouettes(found)
    bone.accept()
    assert bone.accepted is not None and bone.found is None
    again = opened(planning.case.folder, balls.Scene())  # as after a killed server
    assert again.bone.accepted == bone.accepted and again.bone.volume == bone.volume
    assert list(again.bone.points) == list(AT)
    again.planning.case.close()
    planning.undo()
    assert bone.accepted is None and bone.ready
    planning.redo()
    assert bone.accepted is not None
    bone.discard()
    assert bone.accepted is None


def _edges_are_silhouettes(found: FoundBone) -> None:
    """Every ball's outline that no other ball covers has edges along it, and few edges lie elsewhere."""
    for view in balls.Scene().views:
        drawn = np.concatenate([np.array(line) for line in found.edges[view.name]])
        at = balls.POSE.apply(balls.HEAD_MM)
        head, beside = view.project(np.concatenate([at, at + np.array([0.0, balls.RADII_MM[0], 0.0])]))
        radius = np.linalg.norm(beside - head)
        on = np.abs(np.linalg.norm(drawn - head, axis=1) - radius) < EDGE_PX
        angles = np.sort(np.arctan2(*(drawn[on] - head).T))
        assert on.sum() > 10 and np.ptp(angles) > np.pi


def test_its_checks_are_of_the_plan_while_its_images_are_there(session: Session) -> None:
    """Of the plan and of what the case records of it, not only of what the page shows."""
    planning, moved = session.planning, Check("bone movement", False, 7.1, 5.3, "s.d.", "Moved.")
    views = tuple(BoneView(view.name, view.focal_point_mm, "0" * 64, np.eye(4), 1.5) for view in balls.Scene().views)
    pose = RegisteredBone(balls.POSE.as_matrix(), np.zeros(3), np.eye(6), (moved,), views, "1" * 64)
    session.bone._found = FoundBone({"pa": 11, "lateral": 12}, pose.document(), "95 % error 0.4 mm", (vars(moved),), {})
    for name, at in {"entry": AT["shaft"], "end": AT["head"]}.items():
        places = {
            view.name: tuple(view.project(balls.POSE.apply(at)[None])[0].tolist()) for view in balls.Scene().views
        }
        planning.edit(planning.decisions.with_mark(name, Mark(places)))
    assert _movements(session) == []
    session.bone.accept()
    assert _movements(session) == [moved]
    known = planning.planned
    assert known is not None and known.verdict is not None and known.verdict.state == "no-go"
    kept = request_of(known.decisions, 2, known.bone).bone
    assert kept is not None and kept.checks == (moved,)
    assert known.plan is not None
    sent = {"decisions": known.decisions.document(), "trajectory": known.plan.trajectory.document()}
    planning.case.record(Kind.SENT, sent, by=Actor.SURGEON)
    asyncio.run(planning._restore_sent())  # as after a restart
    (restored,) = planning.all_sent.values()
    assert [check for check in restored.plan.verdict.checks if check.code is CheckCode.BONE_MOVEMENT] == [moved]
    planning.decide(images={"pa": 11, "lateral": 13})
    assert session.bone.accepted is None and _movements(session) == []
    planning.undo()
    assert _movements(session) == [moved]


def _movements(session: Session) -> list[Check]:
    verdict = session.readiness.verdict
    assert verdict is not None, session.planning.planned
    return [check for check in verdict.checks if check.code is CheckCode.BONE_MOVEMENT]


@pytest.mark.parametrize(
    ("data", "suffix", "words"),
    [
        (OPEN_MESH, ".obj", "^the mesh is not closed: 3 of its edges"),
        (b"NRRD0005\njunk", ".nrrd", "."),
        (b"solid", ".stl", "not a STL mesh|no triangles|damaged"),
        (table(head=AT["head"]), ".csv", "it holds 1 points; give 2 to 12"),
        (table(**{f"p{k}": AT["head"] for k in range(MAX_POINTS + 1)}), ".csv", "it holds 13 points"),
        (table(**{"a" * 41: AT["head"], "b": AT["side"]}), ".csv", "at most 40 printable"),
        (b'{"markups": []}', ".mrk.json", "one list of points"),
        (b"\xff\xfe", ".json", "."),
    ],
)
def test_a_file_that_cannot_be_used_says_why_and_leaves_the_one_before(
    session: Session, ct: bytes, data: bytes, suffix: str, words: str
) -> None:
    run(session.bone.take(ct, ".nrrd"))
    run(session.bone.take(table(**AT), ".csv"))
    volume = session.bone.volume
    with pytest.raises(UnusableInputError, match=words) as refused:
        run(session.bone.take(data, suffix))
    assert "points." not in str(refused.value) and "volume." not in str(refused.value)
    assert session.bone.volume == volume and volume is not None and volume.read_bytes() == ct
    assert list(session.bone.points) == list(AT)
    assert sorted(file.name for file in volume.parent.iterdir()) == ["points.csv", "volume.nrrd"]


def test_another_ct_takes_the_place_of_the_one_before(session: Session, ct: bytes) -> None:
    cube = b"v 0 0 0\nv 30 0 0\nv 0 30 0\nv 0 0 30\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    for data, suffix in ((ct, ".nrrd"), (cube, ".obj")):
        run(session.bone.take(data, suffix))
    assert session.bone.volume is not None
    assert [file.name for file in session.bone.volume.parent.iterdir()] == ["volume.obj"]


@pytest.mark.parametrize(
    ("names", "off_px", "words"),
    [
        (("head",), (OFF_PX, OFF_PX), "click 2 of its landmarks or more in both"),
        (("head", "shaft"), ([0.0, 0.0], [60.0, 0.0]), "is clicked .. mm from its place"),
        (("head", "shaft"), (OFF_PX, [9000.0, 0.0]), "."),
    ],
)
def test_a_registration_that_fails_says_why_and_loses_nothing(
    session: Session, ct: bytes, names: tuple[str, ...], off_px: Any, words: str
) -> None:
    run(session.bone.take(ct, ".nrrd"))
    run(session.bone.take(table(**AT), ".csv"))
    click(session, *names, off_px=off_px)
    before = session.planning.decisions
    with pytest.raises(SightlineError, match=words) as refused:
        run(session.bone.register())
    assert session.bone.refused[1:] == str(refused.value)[1:] or len(names) < 2
    assert session.planning.decisions is before and not session.jobs.working
    assert session.bone.volume is not None and session.bone.points and session.bone.found is None
