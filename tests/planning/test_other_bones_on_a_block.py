"""Plans of screws in pedicle, sacrum and slipped epiphysis on the twin's set-ups with a block: beads to verdict."""

from dataclasses import replace

import numpy as np
import pytest

import sightline as sl
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.planning import Aids, Plan, kind, plan
from sightline.studies.scenes import measure
from sightline.twin import drawn_aids
from sightline.twin.anatomy.bone_model import key_of, wrong_wires
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.scenes.bone_scene import BoneScene, shown_bone_scene
from sightline.twin.xray.setup import SetUp

from .other_bones import PROCEDURES

BLOCK = sl.Frame.load("block60")
BALL_PX, CLICK_PX = 0.1, 0.5


def _views(setup: SetUp, rng: np.random.Generator):
    seen = measure(rng, setup, BALL_PX)
    chain = next(iter(setup.views.values())).chain
    c_arm = sl.CArm(chain.sdd_mm, chain.field_mm / chain.shape[1])
    given = [replace(seen[name], image_shape=chain.shape) for name in setup.views]
    return calibrate_together(given, BLOCK, [c_arm] * len(given))


def _planned(setup: SetUp, scene: BoneScene, views, wire_mm: np.ndarray, key: str, rng: np.random.Generator) -> Plan:
    """A plan with picks, landmarks and aids that are clicked with an error."""
    known, true = kind(key), drawn_aids(scene.aids, setup.views)

    def clicked(uv: np.ndarray) -> np.ndarray:
        return uv + rng.normal(0.0, CLICK_PX, uv.shape)

    order = [one.name for one in known.document.views]
    uv = {
        aid.key: [
            clicked(true[aid.key][name]) if wanted in aid.views else None
            for name, wanted in zip(setup.views, order, strict=False)
        ]
        for aid in known.aids
        if aid.key in true
    }
    marks = {key_of(name): at for name, at in scene.landmarks_mm.items()}
    points = np.concatenate([wire_mm, [marks[one.key] for one in known.landmarks]])
    picks = clicked(np.array([view.project(points) for view in setup.views.values()]))
    return plan(
        views,
        picks[:, 0],
        picks[:, 1],
        landmarks_uv_px=picks[:, 2:],
        landmark_names=[one.key for one in known.landmarks],
        kind=known,
        side=setup.side,
        aids=Aids.clicked({aid.key: aid.type for aid in known.aids}, uv),
    )


@pytest.mark.parametrize("name", ["vertebra", "growing-femur", pytest.param("pelvis", marks=pytest.mark.slow)])
def test_right_wires_are_go_and_wires_that_leave_the_bone_are_not(name: str):
    """Two set-ups. Wrong wires leave the bone, or enter canal or foramen, by 1 mm: in one of the set-ups."""
    for seed in (0, 3):
        rng = np.random.default_rng(1100 + seed)
        setup, scene = shown_bone_scene(rng, BLOCK, name, ("right", "left")[seed % 2], imaged=False)
        views = _views(setup, rng)
        made = _planned(setup, scene, views, scene.wires_mm[0], PROCEDURES[name], rng)
        assert made.verdict.go, made.verdict.summary()
        for kind_of_wrong, wire in wrong_wires(scene.truth, 1.0, rng).items() if seed == 3 else ():
            wrong = _planned(setup, scene, views, to_cfcs(wire, setup.side, scene.origin_mm), PROCEDURES[name], rng)
            assert wrong.verdict.state == "no-go", (seed, kind_of_wrong)
