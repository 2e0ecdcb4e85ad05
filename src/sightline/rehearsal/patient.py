"""A rehearsed patient of any procedure: set-up and bone drawn from one seed, its images, and the truth of every click.

Each part has its own generator, so it does not depend on the parts drawn before it: it is the same after a restart and
in the robot's separate process.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.case.contents import PlanRequest
from sightline.case.views import NAMES as VIEWS
from sightline.common.threads import at_once
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.from_images.interlocking import NailDrawn
from sightline.imaging import Radiograph
from sightline.planning import Aids, Nail, Plan, Procedure, WirePicks
from sightline.planning.points.picks import stack
from sightline.planning.procedures.document import ProcedureDocument
from sightline.planning.procedures.procedure import document_of
from sightline.robot.kinematics.calibrated import REMOUNT_SD
from sightline.twin import BoneScene, HipScene, Scene, SetUp, Variation, draw_setup, render, truth_document
from sightline.twin.anatomy.bone_model import Aid, BoneModel, LineAid, SphereAid, drawn_aids, hip_aids, key_of
from sightline.twin.anatomy.femur import Femur, draw_femur, to_cfcs
from sightline.twin.anatomy.nailed_femur import SPACING_MM, NailedFemur
from sightline.twin.objects.things import guide_wire, moved
from sightline.twin.scenes.bone_scene import BONES, bone_document, shown_bone_scene
from sightline.twin.scenes.hip_scene import placed_hip, shown_setup
from sightline.twin.scenes.specimens import tagged
from sightline.twin.xray.distributions import beam_at
from sightline.twin.xray.render import render_views

ATTEMPTS = 200
MARGIN_PX = 20.0  # minimum distance of wire and landmarks from the edge of the field
# Each has its own generator; add new parts at the end.
PARTS = (*VIEWS, "robot", "check", "picks", "ALIGNED", "PAUSED", "oblique", "aids")
LANDMARK_MARGIN_PX = 30.0  # [ours] landmarks nearer to the edge of a field are not picked, since it may hide a part
RIM_ANGLES_RAD = np.array([0.3, 2.4, 4.5])  # about a third of the outline apart
# Where a person draws [ours]: on the round rim of a cap that a plane cuts off, from its top; along the part of a hip's
# shaft that both images show, from the neck's base.
CAP_ANGLES_RAD = np.deg2rad([-65.0, 0.0, 65.0])
SHAFT_MM = np.array([[0.0, 0.0, 0.0], [0.0, 20.0, 0.0]])
CANNULATED = "cannulated-hip-screws"
AT_HIP = ("hip-screw", CANNULATED, "free-wire")
# Screws of 7.3 mm, and 0.5 mm to each side: a plan that is right up to the limit of "wire in neck" fails by its error.
WIDER_SCREW_MM = 8.3
# Beams of check images beside a solid: they show the three wires 5 mm apart, the views of the plan 2 mm [calc].
CANNULATED_BEAMS = {"pa": beam_at(np.deg2rad(-20.0)), "lateral": beam_at(np.deg2rad(100.0))}
AidClicks: TypeAlias = Mapping[str, Sequence[np.ndarray | None]]
NAILED = "distal-interlocking"
# Pairs of check images until one is not refused, as a person takes others: a bead may hide the tip [ours].
MAX_TAKES = 3
NAIL_CLICK_PX = 2.0  # [ours] s.d. of a click on a nail's edge or in its hole, per axis: twice that of an ordinary click
BONE_OF = {"slipped-epiphysis-pin": "growing-femur", "iliosacral-screw": "pelvis", "pedicle-screw": "vertebra"}
BONES_OF = {**BONE_OF, NAILED: "nailed-femur"}


@dataclass(frozen=True, eq=False)
class CheckImages:
    """Both radiographs of a check shot, and the true set-up and landmarks (3,) that they show.

    `picked_mm` (M, 3): where a person picks the wire in both, the tip last, CFCS of these images.
    """

    setup: SetUp
    landmarks_mm: dict[str, np.ndarray]
    images: dict[str, Radiograph]
    picked_mm: np.ndarray | None = None

    @staticmethod
    def take(
        planned: SetUp,
        bone: HipScene | BoneScene,
        wires: Sequence[tuple[np.ndarray, float]],
        motion: RigidTransform,
        drawn: tuple[np.random.Generator, Callable[[np.random.Generator], SetUp]],
        *,
        landmarks_mm: Mapping[str, np.ndarray],
        shown_mm: np.ndarray,
    ) -> "CheckImages":
        """Render the check images of a bone that has moved against the frame by `motion`.

        `wires`: all in the bone, each its axis to the tip (2, 3), planning CFCS, and its diameter. `drawn`: the
        generator, and the function that draws another set-up of the C-arm. `landmarks_mm`: points of the bone,
        `shown_mm` (N, 3) of the newest wire, before both moved. Raises SetUpError if no set-up shows these.
        """
        rng, draw = drawn
        in_bone = sum((guide_wire(*wire) for wire in wires), bone.bone)
        then = bone.still + moved(in_bone, motion)
        landmarks = {name: motion.apply(at) for name, at in landmarks_mm.items()}
        points = np.concatenate([motion.apply(shown_mm), np.stack(list(landmarks.values()))])
        for _ in range(ATTEMPTS):
            setup = replace(draw(rng), true_frame=planned.true_frame)
            if all(view.in_field(view.project(points), MARGIN_PX).all() for view in setup.views.values()):
                made = render_views(setup, VIEWS, then, rng)
                images = {name: tagged(setup, name, image) for name, image in made.items()}
                return CheckImages(setup, landmarks, images)
        raise SetUpError(f"none of {ATTEMPTS} set-ups shows wire and landmarks in both check images")

    def landmarks_px(self, names: Sequence[str], sd_px: float, rng: np.random.Generator) -> np.ndarray:
        """Draw a person's picks (2, L, 2) of the named landmarks in both images."""
        return self.pixels(np.stack([self.landmarks_mm[name] for name in names]), sd_px, rng)

    def pixels(self, xyz: np.ndarray, sd_px: float, rng: np.random.Generator) -> np.ndarray:
        """Draw a person's picks (2, N, 2) of points (N, 3), CFCS of these images, in both images."""
        true = np.stack([self.setup.views[name].project(xyz) for name in VIEWS])
        return true + sd_px * rng.standard_normal(true.shape)


def frame_of(procedure: str) -> str:
    """Return the name of the frame that shows a procedure's views, those of its check shot too: Γ, or a block."""
    bone = BONES.get(BONES_OF.get(procedure, ""))
    return "block60" if bone is not None and (bone.beams or bone.check_beams) else "gamma"


@dataclass(frozen=True, eq=False)
class RehearsedPatient:
    """A patient in or beside a frame in front of a C-arm, for a `procedure` by its key: the true `setup` and `bone`."""

    seed: int
    setup: SetUp
    bone: HipScene | BoneScene
    procedure: str = "hip-screw"

    def generator(self, part: str, repeat: int = 0) -> np.random.Generator:
        """Return the generator of one of PARTS in its initial state; `repeat`: for how often it was made before."""
        key = (PARTS.index(part), *([repeat] if repeat else []))
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    @property
    def side(self) -> str:
        """The patient's side."""
        return self.setup.side

    @property
    def anatomy(self) -> Femur | BoneModel:
        """The bone's shape, in anatomical coordinates."""
        return self.bone.femur if isinstance(self.bone, HipScene) else self.bone.truth

    def in_cfcs(self, anatomical_mm: np.ndarray) -> np.ndarray:
        """Convert anatomical points (..., 3) of the bone to CFCS."""
        origin = self.bone.head_mm if isinstance(self.bone, HipScene) else self.bone.origin_mm
        return to_cfcs(anatomical_mm, self.side, origin)

    def moved(self, by_mm: np.ndarray) -> "RehearsedPatient":
        """Return the patient with the bone moved against the frame by (3,), CFCS; for studies of points."""
        bone = self.bone
        if isinstance(bone, HipScene):
            return replace(self, bone=HipScene.of(Scene(), Scene(), bone.femur, self.side, bone.head_mm + by_mm))
        return replace(self, bone=replace(bone, origin_mm=bone.origin_mm + by_mm))

    def seen_along(self, beams: Mapping[str, np.ndarray], rng: np.random.Generator) -> "RehearsedPatient":
        """Return the patient beside a solid in another set-up of the same C-arm, with two nominal beams (3,),
        anatomical, by name. Raises SetUpError."""
        views = {name: to_cfcs(beam, self.side, np.zeros(3)) for name, beam in beams.items()}
        return replace(self, setup=self._set_up_again(rng, views).renamed(VIEWS))

    @property
    def document(self) -> ProcedureDocument:
        """The procedure's file."""
        return document_of(self.procedure)

    @property
    def wires_mm(self) -> np.ndarray:
        """Entry and end (n, 2, 3) of the ideal wires, CFCS, in the order of the procedure's file."""
        if isinstance(self.bone, BoneScene):
            return self.bone.wires_mm
        return self.in_cfcs(anatomical_wires(self.bone.femur, self.procedure))

    @property
    def ideal_mm(self) -> dict[str, np.ndarray]:
        """Entry and end (2, 3) of each ideal wire, CFCS, by key."""
        return {wire.key: mm for wire, mm in zip(self.document.wires, self.wires_mm, strict=True)}

    @property
    def nail(self) -> Nail | None:
        """The nail in the bone, as its maker states it; None for a bone without one."""
        if not isinstance(self.bone, BoneScene) or not isinstance(self.bone.dimensions, NailedFemur):
            return None
        nail = self.bone.dimensions.nail
        return Nail(nail.diameter_mm, nail.hole_diameter_mm, nail.bore_mm, nail.material, spacing_mm=SPACING_MM)

    @property
    def scene(self) -> Scene:
        """Everything in the beam at the planning images."""
        return self.bone.scene

    @cached_property
    def images(self) -> dict[str, Radiograph]:
        """The radiograph of each view."""
        scene = self.scene
        jobs = [partial(render, self.setup, name, scene, self.generator(name)) for name in VIEWS]
        made = zip(VIEWS, at_once(*jobs), strict=True)
        return {name: tagged(self.setup, name, image) for name, image in made}

    def pixels(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the true pixels (2, N, 2) of points (N, 3), CFCS, in both images."""
        return np.stack([self.setup.views[name].project(xyz_mm) for name in VIEWS])

    def picked_mm(self, plan: Plan) -> np.ndarray:
        """Return the points (2, 3), CFCS, that a plan's picks show in the true geometry of both images.

        A check shot measures a wire against these: errors of the plan's calibration are not in its figures.
        """
        from scipy.optimize import least_squares

        picks = stack(plan.picks)
        whitening = np.linalg.inv(np.linalg.cholesky(picks.unbound()))

        def residuals(xyz_mm: np.ndarray) -> np.ndarray:
            off_px = self.pixels(xyz_mm.reshape(2, 3)) - picks.uv_px
            return (whitening @ off_px[..., None]).ravel()

        return least_squares(residuals, plan.trajectory.points.xyz_mm.ravel()).x.reshape(2, 3)

    @cached_property
    def landmarks(self) -> dict[str, np.ndarray]:
        """Pixels (2, 2) in both images of each landmark that is picked, by its name in the twin: those that the
        procedure names, or of a procedure for any bone the first ones, as far as they lie well inside both fields."""
        known = self.bone.landmarks_mm
        asked = [landmark.key for landmark in self.document.landmarks]
        named = [name for name in known if key_of(name) in asked]
        uv = self.pixels(np.stack(list(known.values())))
        shown = [self.setup.views[name].in_field(uv[k], LANDMARK_MARGIN_PX) for k, name in enumerate(VIEWS)]
        seen = {name: uv[:, k] for k, name in enumerate(known) if shown[0][k] and shown[1][k]}
        picked = [name for name in seen if name in named] if named else list(seen)[: len(asked)]
        return {name: seen[name] for name in picked}

    @property
    def landmark_keys(self) -> tuple[str, ...]:
        """The keys of `landmarks` in the procedure's file."""
        asked = [landmark.key for landmark in self.document.landmarks]
        keys = tuple(key_of(name) for name in self.landmarks)
        return keys if set(keys) <= set(asked) else tuple(asked[: len(keys)])

    @cached_property
    def aids_px(self) -> AidClicks:
        """True clicks (M, 2) in each image on the aids that are drawn, by their keys in the procedure's file: all whose
        clicks lie in the fields. None in an image in which the aid is not drawn."""
        views = [view.name for view in self.document.views]
        asked = {aid.key: [view in aid.views for view in views] for aid in self.document.aids}
        known = {name: aid for name, aid in self._aids.items() if key_of(name) in asked}
        clicks = {key: [uv[view] for view in VIEWS] for key, uv in drawn_aids(known, self.setup.views).items()}
        for name, aid in known.items():
            if isinstance(aid, SphereAid) and "growth plate" in known:  # which cuts the sphere off
                clicks[name] = list(self.rim_px(aid.centre_mm, aid.radius_mm, np.diff(self.wires_mm[0], axis=0)[0]))
        return {
            key: [uv if drawn else None for uv, drawn in zip(each, asked[key], strict=False)]
            for key, each in clicks.items()
            if all(self.setup.views[view].in_field(uv).all() for view, uv in zip(VIEWS, each, strict=True))
        }

    @property
    def drawn_apart(self) -> tuple[str, ...]:
        """Keys of the aids whose noise has a generator of its own."""
        return ()

    @property
    def _aids(self) -> Mapping[str, Aid]:
        bone = self.bone
        if isinstance(bone, BoneScene):
            return bone.aids
        shaft = bone.femur.base_mm + SHAFT_MM
        near = LineAid(self.in_cfcs(shaft))
        return {**hip_aids(bone.femur, self.side, bone.head_mm), "shaft": near, "cortex": self._cortex(shaft.mean(0))}

    def _cortex(self, on_mm: np.ndarray) -> LineAid:
        """Return the lateral edge of the shaft in the first image, beside a point (3,) of its axis, anatomical.

        A click is a line without length.
        """
        assert isinstance(self.bone, HipScene)  # noqa: S101 - asked of hips only
        source = to_cfcs(self.setup.views[VIEWS[0]].focal_point_mm - self.bone.head_mm, self.side, np.zeros(3))
        sideways = np.cross(on_mm - source, [0.0, 1.0, 0.0])
        edge = self.bone.femur.surface_mm(on_mm, sideways * np.sign(sideways[0]) / np.linalg.norm(sideways))
        return LineAid(self.in_cfcs(edge)[None])

    def asked(self, rng: np.random.Generator, sd_px: float) -> tuple[PlanRequest, AidClicks]:
        """Return the plan that a person asks for, its clicks with normal noise, and the clicks on each aid by its key.

        Second picks of the wires are snapped to their curves; landmarks are free. Of several wires the request is that
        of the first, with the others' picks.
        """
        document, wires = self.document, self.wires_mm
        picks = self.pixels(wires[0]) + sd_px * rng.standard_normal((2, 2, 2))
        landmarks_px = np.stack(list(self.landmarks.values()), axis=1)
        landmarks_px = landmarks_px + sd_px * rng.standard_normal(landmarks_px.shape)
        own = self.generator("aids")
        drawn_px = {
            key: [
                None if uv is None else uv + sd_px * (own if key in self.drawn_apart else rng).standard_normal(uv.shape)
                for uv in each
            ]
            for key, each in self.aids_px.items()
        }
        others = {}
        for wire, line in zip(document.wires[1:], wires[1:], strict=True):
            uv = self.pixels(line) + sd_px * rng.standard_normal((2, 2, 2))
            others[wire.key] = WirePicks(uv[:, 0], uv[:, 1], snapped=True)
        request = PlanRequest(
            picks[:, 0],
            picks[:, 1],
            sd_px,
            snapped=True,
            landmarks_uv_px=landmarks_px,
            landmark_names=self.landmark_keys,
            kind=Procedure.of(document, document.wires[0].key).key,
            side=self.side,
            aids=Aids.clicked({aid.key: aid.type for aid in document.aids}, drawn_px, sd_px) if drawn_px else None,
            others=others or None,
        )
        return request if self.procedure != NAILED else self._asked_of_nail(request, rng), drawn_px

    def _asked_of_nail(self, request: PlanRequest, rng: np.random.Generator) -> PlanRequest:
        """Return the request with strokes along the nail and a click on each hole in place of picked points."""
        nail = self.nail
        assert isinstance(self.bone, BoneScene) and nail is not None  # noqa: S101
        drawn = drawn_aids(self.bone.aids, self.setup.views)["nail"]
        strokes = np.stack([drawn[name].reshape(2, 2, 2) for name in VIEWS])
        middles = self.pixels(self.wires_mm.mean(axis=1)).swapaxes(0, 1)
        noise = NAIL_CLICK_PX * rng.standard_normal((8 + 2 * len(middles), 2))
        clicks = middles + noise[8:].reshape(middles.shape)
        by_key = dict(zip((wire.key for wire in self.document.wires), clicks, strict=True))
        given = NailDrawn(nail, strokes + noise[:8].reshape(strokes.shape), by_key)
        first, *rest = (WirePicks(uv, uv, snapped=True) for uv in by_key.values())
        others = dict(zip(list(by_key)[1:], rest, strict=True))
        return replace(request, entry_uv_px=first.entry_uv_px, end_uv_px=first.end_uv_px, others=others, nail=given)

    def rim_px(self, centre_mm: np.ndarray, radius_mm: float, top: np.ndarray | None = None) -> np.ndarray:
        """Return the pixels (2, 3, 2) in both images of three points around the outline of a sphere: at RIM_ANGLES_RAD,
        or on its cap in the direction `top` (3,) at CAP_ANGLES_RAD."""
        pixels = np.zeros((2, len(RIM_ANGLES_RAD), 2))
        for k, name in enumerate(VIEWS):
            view = self.setup.views[name]
            ray = centre_mm - view.focal_point_mm
            distance = np.linalg.norm(ray)
            across, angles = np.linalg.svd(ray[None] / distance)[2][1:], RIM_ANGLES_RAD
            if top is not None:
                angles = CAP_ANGLES_RAD + np.arctan2(*(across @ top)[::-1])
            # Tangent rays touch the sphere on a circle that is nearer to the source and smaller than the sphere.
            nearer = centre_mm - ray * (radius_mm / distance) ** 2
            touching = radius_mm * np.sqrt(1.0 - (radius_mm / distance) ** 2)
            around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            pixels[k] = view.project(nearer + touching * around @ across)
        return pixels

    def shown_again(self, wires_mm: Mapping[str, np.ndarray], *, retake: int = 0) -> CheckImages:
        """Render two more images with wires (2, 3) in the bone, by key, the newest last; CFCS of the planning images.

        The C-arm is set up again and the frame put back as repeatably as a block on its mount. `retake`: how often
        these images were taken before. Raises SetUpError.
        """
        rng = retaken(self.generator("check", len(wires_mm) - 1), retake)
        motion = RigidTransform.from_exp_coords(REMOUNT_SD * rng.standard_normal(6))
        return self._check_images(wires_mm, motion, rng)

    @property
    def truth(self) -> dict[str, Any]:
        """The truth of the images as JSON types."""
        if isinstance(self.bone, HipScene):
            return truth_document(self.setup, self.bone)
        return bone_document(self.setup, self.bone)

    def _check_images(
        self,
        wires_mm: Mapping[str, np.ndarray],
        motion: RigidTransform,
        rng: np.random.Generator,
        shown_mm: np.ndarray | None = None,
    ) -> CheckImages:
        """Render two more images with wires in the bone, and with the bone moved against the frame."""
        landmarks, diameters = self.bone.landmarks_mm, {wire.key: wire.diameter_mm for wire in self.document.wires}
        if isinstance(self.bone, BoneScene):  # whose images do not show all of them
            landmarks = {name: landmarks[name] for name in self.landmarks}
        return CheckImages.take(
            self.setup,
            self.bone,
            [(mm, diameters[key]) for key, mm in wires_mm.items()],
            motion,
            (rng, self._set_up_again),
            landmarks_mm=landmarks,
            shown_mm=list(wires_mm.values())[-1] if shown_mm is None else shown_mm,
        )

    def _set_up_again(self, rng: np.random.Generator, views: Mapping[str, np.ndarray] | None = None) -> SetUp:
        """Draw another set-up of the same C-arm; `views`: nominal beams (3,) of other images of a block, by name."""
        frame, chain, side = self.setup.frame, self.setup.views[VIEWS[0]].chain.name, self.side
        if self.procedure in BONES_OF and views is None:
            again = BONES[BONES_OF[self.procedure]].setup(rng, frame, side, self.setup.tube, check=True, chain=chain)
            return again.renamed(VIEWS)
        beams = CANNULATED_BEAMS if self.procedure == CANNULATED and frame.solid is not None else None
        place = BONES[BONES_OF[self.procedure]].place if self.procedure in BONES_OF else None
        variation = Variation(place=place, tube=self.setup.tube)
        return draw_setup(rng, frame, side=side, chain=chain, variation=variation, views=views or beams)


def retaken(rng: np.random.Generator, times: int) -> np.random.Generator:
    """Return the generator of images that were taken so many times before."""
    return rng.spawn(times)[-1] if times else rng


def draw_patient(
    procedure: str, seed: int, frame: Frame, side: str = "right", *, imaged: bool = True
) -> RehearsedPatient:
    """Draw a patient without a robot; both views show all wires. `imaged`: False leaves out what absorbs, for
    studies of points.

    Raises SetUpError, also for plates whose beams are not those of the procedure.
    """
    rng = np.random.default_rng(seed)
    if procedure in BONES_OF:
        setup, bone = shown_bone_scene(rng, frame, BONES_OF[procedure], side, imaged=imaged)
        return RehearsedPatient(seed, setup.renamed(VIEWS), bone, procedure)
    femur = draw_femur(rng)
    setup, head = shown_setup(rng, frame, side, femur, wires_mm=anatomical_wires(femur, procedure))
    hip = placed_hip(setup, femur, head, rng) if imaged else HipScene.of(Scene(), Scene(), femur, side, head)
    return RehearsedPatient(seed, setup, hip, procedure)


def anatomical_wires(femur: Femur, procedure: str) -> np.ndarray:
    """Return entry and end (n, 2, 3) of the wires of a hip's procedure, anatomical, in the order of its file."""
    if procedure == CANNULATED:
        return femur.cannulated_wires_mm(WIDER_SCREW_MM)[[0, 2, 1]]  # inferior, anterior, posterior
    return np.stack(femur.wire_mm())[None]
