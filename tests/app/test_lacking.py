"""What a rehearsed patient does not have: said before anything is drawn, and never sent to the robot."""

import asyncio
import json
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.planning.bone import views

from sightline.app import texts
from sightline.app.panels.steps import StepStatus, steps
from sightline.app.session.rehearsing import HIP, NAIL, Patient, lacking_in
from sightline.app.session.session import Session
from sightline.app.tab.placing import Placing, ProcedureStep
from sightline.errors import RobotRefusedError
from sightline.planning import PROCEDURES
from sightline.planning.procedures.procedure import FOLDER
from sightline.rehearsal.patient import AT_HIP, CANNULATED, NAILED

VIEWS: Any = tuple(views())
FREE = "free-wire"  # for any bone


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Session]:
    """Of a patient with a hip, whose images are calibrated."""
    nobody: Any = None
    made = Session.open(tmp_path / "case", "gamma", None, nobody)
    made.planning.lacking_in = lacking_in(Patient(1))
    monkeypatch.setattr(made.planning, "views", lambda names=None: VIEWS)
    yield made
    made.planning.case.close()


@pytest.mark.parametrize("procedure", [*AT_HIP, NAILED])
def test_a_patient_lacks_the_bones_of_other_procedures(procedure: str) -> None:
    """Fails for a patient who is said to lack what it has, and for a shipped procedure that is forgotten."""
    lacking = lacking_in(Patient(1, procedure=procedure))
    documents = {one.document.key for one in PROCEDURES.values()}
    have = {"hip-screw", CANNULATED} if procedure in AT_HIP else {NAILED}
    assert set(lacking) == documents - have - {FREE}
    assert set(lacking.values()) <= set(texts.LACKS)
    assert lacking.get(NAILED, NAIL) == NAIL and lacking.get("hip-screw", HIP) == HIP


@pytest.mark.parametrize("key", sorted(PROCEDURES))
def test_the_step_plan_says_so_before_it_asks_for_a_point(session: Session, key: str) -> None:
    planning, document = session.planning, PROCEDURES[key].document.key
    planning.edit(planning.decisions.with_kind(key))
    goal = Placing(session).goal(ProcedureStep.PLAN)
    if document in (*AT_HIP, FREE):
        assert not planning.lacking and goal is not None
        return
    assert goal is None
    told = " ".join(texts.LACKS[planning.lacking])
    assert told.startswith("The simulated patient has no ") and f"--procedure {document}" in told
    (plan,) = [one for one in steps(session) if one.step is ProcedureStep.PLAN]
    assert (plan.status, plan.reason) == (StepStatus.ATTENTION, told)


def test_a_plan_of_what_the_patient_lacks_is_not_sent(session: Session) -> None:
    robot: Any = SimpleNamespace(now=SimpleNamespace(lost=False))
    session.planning.edit(session.planning.decisions.with_kind(f"{NAILED}:distal"))
    session.drilling.session = robot
    known = session.planning.planned
    assert known is not None
    with pytest.raises(RobotRefusedError, match="The simulated patient has no nail"):
        asyncio.run(session.drilling.send(known))


def test_a_nail_s_procedure_of_the_user_s_own_needs_a_nail_too(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = json.loads((files("sightline.planning.procedures") / "shipped" / f"{NAILED}.json").read_text("utf-8"))
    (tmp_path / "my-nail.json").write_text(json.dumps({**shipped, "key": "my-nail"}), "utf-8")
    monkeypatch.setenv(FOLDER, str(tmp_path))
    planning = session.planning
    planning.edit(planning.decisions.with_kind("my-nail:distal"))
    assert planning.lacking == NAIL
    planning.lacking_in = lacking_in(Patient(1, procedure=NAILED))
    assert not planning.lacking
    planning.lacking_in = {}  # images of a C-arm, or of a patient who is not known yet
    assert not planning.lacking
