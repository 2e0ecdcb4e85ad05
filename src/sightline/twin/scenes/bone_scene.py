"""Scenes of procedures other than the hip screw: a drawn bone in or beside the frame, its views, its wires' truth."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from math import cos, radians, sin
from typing import Any, TypeAlias

import numpy as np

from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.twin.anatomy.bone_model import Aid, BoneModel
from sightline.twin.anatomy.bones import GrowingFemur, Pelvis, Vertebra, draw
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.anatomy.nailed_femur import THIGH_MM, NailedFemur, draw_nailed_femur
from sightline.twin.objects.things import Scene, SoftTissue, frame_scene
from sightline.twin.scenes.hip_scene import first_shown, points_document
from sightline.twin.xray.distributions import HipPlace, SolidPlace
from sightline.twin.xray.setup import SetUp, Variation, draw_setup
from sightline.twin.xray.tubes import FlatPanel, Tube

Dimensions: TypeAlias = Pelvis | Vertebra | GrowingFemur | NailedFemur  # which a bone is built of


@dataclass(frozen=True)
class BoneKind:
    """A bone of a procedure, and how it is imaged.

    `draw`: draws its dimensions. `body`: around the middle of its first wire. `beams`: of its views, by name, in
    anatomical coordinates for a solid (default: PA and lateral, those of plates too). `check_beams`: of a check shot
    beside a solid, where a view of the plan shows the wire nearly end on. `place`: of a solid.
    """

    draw: Callable[[np.random.Generator], Any]
    body: SoftTissue
    beams: Mapping[str, tuple[float, float, float]] | None = None
    place: SolidPlace = field(default_factory=SolidPlace)
    check_beams: Mapping[str, tuple[float, float, float]] | None = None

    def setup(
        self,
        rng: np.random.Generator,
        frame: Frame,
        side: str = "right",
        tube: Tube | FlatPanel | None = None,
        check: bool = False,
        **drawn: Any,
    ) -> SetUp:
        """Draw a set-up with the views of this bone.

        `tube`: a given detector instead of a drawn one. `check`: for a check shot. `drawn`: arguments of `draw_setup`,
        besides views and variation.

        Raises SetUpError for plates, if their beams are not those of this bone.
        """
        chosen = self.check_beams if check and self.check_beams and frame.solid is not None else self.beams
        if chosen is None:
            beams = None
        elif frame.solid is None:
            raise SetUpError(
                f"the plates of frame {frame.name!r} do not show the views {', '.join(chosen)}; use a solid frame, "
                "for example block60"
            )
        else:
            beams = {name: to_cfcs(np.array(beam), side, np.zeros(3)) for name, beam in chosen.items()}
        variation = Variation(place=self.place, tube=tube)
        return draw_setup(rng, frame, side=side, views=beams, variation=variation, **drawn)


# The detector tilts towards the head for the inlet view, by 24.9° on average, and towards the feet for the outlet view,
# by 42.4° [src Eastman 2015]. The solid lies as far from the wire as beside a hip, where both views show it beside it.
INLET, OUTLET = radians(24.9), radians(42.4)
PELVIC_VIEWS = {"inlet": (0.0, -sin(INLET), cos(INLET)), "outlet": (0.0, sin(OUTLET), cos(OUTLET))}
# The PA view shows a pedicle's wire nearly end on: turned by 30° towards the operated side it is 38° to 46° off [ours].
OBLIQUE, LATERAL = (sin(radians(30.0)), 0.0, cos(radians(30.0))), (1.0, 0.0, 0.0)
# Both views look through the holes of a nail, from 14° to either side. The drill through them is seen from 40°, with
# the C-arm tilted by 20° too: otherwise both beams and the drill lie in one plane, which hides its place [ours].
NAIL_VIEWS, DRILL_VIEWS = (
    {
        name: (-cos(turn) * cos(tilt), sin(tilt), sin(turn) * cos(tilt))
        for name, turn in (("posterior oblique", -off), ("anterior oblique", off))
    }
    for off, tilt in ((radians(14.0), 0.0), (radians(40.0), radians(-20.0)))
)
BONES: dict[str, BoneKind] = {
    "pelvis": BoneKind(
        partial(draw, bone=Pelvis),
        SoftTissue((-36.0, 40.0), (175.0, 115.0)),
        PELVIC_VIEWS,
        SolidPlace((0.0, 79.0, -12.0)),
    ),
    "vertebra": BoneKind(
        partial(draw, bone=Vertebra),
        SoftTissue((-16.0, 25.0), (150.0, 105.0)),
        check_beams={"oblique": OBLIQUE, "lateral": LATERAL},
    ),
    "growing-femur": BoneKind(partial(draw, bone=GrowingFemur), SoftTissue((-35.0, -5.0), (125.0, 90.0))),
    "nailed-femur": BoneKind(draw_nailed_femur, SoftTissue((0.0, 0.0), THIGH_MM), NAIL_VIEWS, check_beams=DRILL_VIEWS),
}


@dataclass(frozen=True, eq=False)
class BoneScene:
    """A bone in or beside the frame, with the truth of its procedure in CFCS.

    `still`: frame and body; `bone`: the bone as a scene; `truth`: the same in anatomical coordinates, whose origin is
    at `origin_mm` (3,); `dimensions`: the numbers that it was built of.
    """

    still: Scene
    bone: Scene
    truth: BoneModel
    side: str
    origin_mm: np.ndarray
    dimensions: Dimensions

    @property
    def scene(self) -> Scene:
        """Everything in the beam, with the frame's beads first."""
        return self.still + self.bone

    @property
    def wires_mm(self) -> np.ndarray:
        """Entry and end (n, 2, 3) of the standard wires."""
        return self._to_cfcs(self.truth.wires_mm)

    @property
    def landmarks_mm(self) -> dict[str, np.ndarray]:
        """Points (3,) that a person can find in both views, by name."""
        return {name: self._to_cfcs(at) for name, at in self.truth.landmarks_mm.items()}

    @property
    def aids(self) -> dict[str, Aid]:
        """Spheres, lines and planes that a person draws on the images, by name."""
        return {name: aid.mapped(self._to_cfcs) for name, aid in self.truth.aids.items()}

    def distance_mm(self, xyz_mm: np.ndarray, of: str = "surface") -> np.ndarray:
        """Return the signed distances (...) of points (..., 3), CFCS; see `BoneModel.distance_mm`."""
        return self.truth.distance_mm(self.anatomical(xyz_mm), of)

    def anatomical(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Convert points (..., 3), CFCS, to the bone's anatomical coordinates."""
        return to_cfcs(np.asarray(xyz_mm) - self.origin_mm, self.side, np.zeros(3))

    def in_nail(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return whether points (N, 3), CFCS, lie in the metal of a nail; False for a bone without one."""
        if not isinstance(self.dimensions, NailedFemur):
            return np.zeros(len(xyz_mm), dtype=bool)
        return self.dimensions.nail.inside(self.anatomical(xyz_mm))

    def _to_cfcs(self, anatomical_mm: np.ndarray) -> np.ndarray:
        return to_cfcs(anatomical_mm, self.side, self.origin_mm)


def shown_bone_scene(
    rng: np.random.Generator,
    frame: Frame,
    name: str,
    side: str = "right",
    *,
    imaged: bool = True,
    also_mm: np.ndarray | None = None,
    **drawn: Any,
) -> tuple[SetUp, BoneScene]:
    """Draw a set-up and a bone of BONES so that all views show its wires, and the points `also_mm` (N, 3), CFCS.

    `drawn`: arguments of `draw_setup`, besides views and variation. `imaged`: False leaves out what absorbs, for
    studies of points.

    Raises SetUpError if none is found.
    """
    kind = BONES[name]
    dimensions = kind.draw(rng)
    bone = dimensions.bone()

    def drawn_once() -> tuple[SetUp, np.ndarray]:
        setup = kind.setup(rng, frame, side, **drawn)
        return setup, setup.hip_mm + draw_origin(bone, side, rng)

    setup, origin = first_shown(drawn_once, bone.wires_mm, also_mm)
    if not imaged:
        return setup, BoneScene(Scene(), Scene(), bone, side, origin, dimensions)
    return setup, placed_bone(setup, name, dimensions, origin, rng)


def draw_origin(bone: BoneModel, side: str, rng: np.random.Generator) -> np.ndarray:
    """Draw the origin (3,) of a bone whose wires are centred as a radiographer would: from `SetUp.hip_mm`, CFCS."""
    middle = to_cfcs(bone.wires_mm.mean(axis=(0, 1)), side, np.zeros(3))
    return rng.normal(0.0, HipPlace().off_centre_sd_mm, 3) - middle


def placed_bone(
    setup: SetUp, name: str, dimensions: Dimensions, origin_mm: np.ndarray, rng: np.random.Generator
) -> BoneScene:
    """Return the set-up's true frame and a bone of BONES with its origin at a given point (3,)."""
    bone = dimensions.bone()
    still = frame_scene(setup.true_frame) + Scene(tissue=BONES[name].body.around(setup.hip_mm))
    volume = bone.volume(setup.side, origin_mm, rng)
    metal = tuple(replace(mesh, vertices_mm=to_cfcs(mesh.vertices_mm, setup.side, origin_mm)) for mesh in bone.metal)
    placed = Scene(volumes=(volume,), meshes=metal)
    return BoneScene(still, placed, bone, setup.side, origin_mm, dimensions)


def bone_document(setup: SetUp, scene: BoneScene) -> dict[str, Any]:
    """Return the truth of the images of a bone: dimensions, wires, landmarks, aids, views, beads. CFCS, mm, and px."""
    document = points_document(setup, scene.landmarks_mm)
    for name, view in setup.views.items():
        document["views"][name]["wires_uv_px"] = view.project(scene.wires_mm).tolist()
    aids = {
        name: {"kind": type(aid).__name__.removesuffix("Aid").lower()}
        | {each.name: np.asarray(getattr(aid, each.name)).tolist() for each in fields(aid)}
        for name, aid in scene.aids.items()
    }
    return document | {
        "dimensions": asdict(scene.dimensions),
        "wires_mm": scene.wires_mm.tolist(),
        "aids": aids,
    }
