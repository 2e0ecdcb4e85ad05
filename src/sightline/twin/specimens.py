"""The specimens of `sightline simulate`: a hip, other bones, the paper's objects, a mesh or a CT scan."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.imaging import GeometryTags, Radiograph
from sightline.twin.bone_scene import BONES, BoneKind, bone_document, draw_origin, placed_bone
from sightline.twin.carm import BEAMS, SetUp, ViewTruth, draw_setup
from sightline.twin.ct import ct_volumes, read_ct
from sightline.twin.femur import Femur, draw_femur, to_cfcs
from sightline.twin.meshes import KINDS, read_mesh
from sightline.twin.motion import moved
from sightline.twin.phantoms import PIG, perspex_object, plastic_hip, porcine_hip
from sightline.twin.scene import TEST_BALLS_MM, HipScene, draw_head, placed_hip
from sightline.twin.things import Scene, SoftTissue, frame_scene
from sightline.twin.truth import points_document, truth_document

ATTEMPTS = 100
MARGIN_PX = 30.0  # minimum distance of points of interest from the edge of both fields, where possible [ours]


@dataclass(frozen=True, eq=False)
class Specimen:
    """A set-up, everything in its beams, and the truth (JSON types). `shown`: every view shows every point of interest;
    a small field cannot show a whole wire. `wire_mm` (2, 3): entry and end of the wire, CFCS; None without one."""

    setup: SetUp
    scene: Scene
    truth: dict[str, Any]
    shown: bool
    wire_mm: np.ndarray | None = None


@dataclass(frozen=True)
class SetUpSpec:
    """Specification of the set-ups to draw: `frame`, `side` of the hip, name of the image chain (default:
    `chain_for(frame)`).

    `made`: the frame as manufactured, whose beads deviate from those of `frame`; None: drawn for each set-up.
    `bone`: the bone whose views are taken; None: those of a hip. `oblique`: with a third image of a solid, midway
    between PA and lateral of a hip.
    """

    frame: Frame
    side: str = "right"
    chain: str | None = None
    made: Frame | None = None
    bone: BoneKind | None = None
    oblique: bool = False

    def draw(self, rng: np.random.Generator, points_mm: np.ndarray) -> tuple[SetUp, bool]:
        """Draw up to ATTEMPTS set-ups; return the first that shows all points (N, 3), from `SetUp.hip_mm`, in all
        views, and True; or the last, and False. Raises SetUpError if no pose has the frame in the beam.
        """
        left = ATTEMPTS
        while True:
            left -= 1
            setup = self._drawn(rng)
            points = setup.hip_mm + points_mm
            shown = all(view.in_field(view.project(points), MARGIN_PX).all() for view in setup.views.values())
            if shown or not left:
                return setup, shown

    def _drawn(self, rng: np.random.Generator) -> SetUp:
        if self.bone is not None and self.oblique:
            raise UnusableInputError("the third image lies between the PA and the lateral view of a hip; leave it out")
        draw = draw_setup if self.bone is None else self.bone.setup
        views: dict[str, Any] = {"views": BEAMS} if self.oblique else {}
        if self.made is None:
            return draw(rng, self.frame, side=self.side, chain=self.chain, **views)
        setup = draw(rng, self.made, side=self.side, chain=self.chain, frame_errors=False, **views)
        return replace(setup, frame=self.frame)


def specimen(what: str, rng: np.random.Generator, spec: SetUpSpec, at_mm: np.ndarray | None = None) -> Specimen:
    """Return a specimen by its name in SPECIMENS, or from a mesh file, a NIfTI file or a folder with one CT series.

    `at_mm` (3,): the point of a file, in its own coordinates, that is moved to `SetUp.hip_mm`; default: its middle.
    Raises UnusableInputError, SetUpError.
    """
    if what in SPECIMENS:
        if at_mm is not None:
            raise UnusableInputError(f"{what!r} has a fixed position; give a position only for meshes and CT scans")
        return SPECIMENS[what](rng, spec)
    path = Path(what)
    if not path.exists():
        raise UnusableInputError(
            f"there is no specimen {path.name!r}; name one of {', '.join(SPECIMENS)}, or the path of a mesh "
            f"({', '.join(KINDS)}), a NIfTI file or a folder of CT slices"
        )
    setup, shown = spec.draw(rng, np.zeros((1, 3)))
    scene, middle = (_mesh if path.suffix.lower().removeprefix(".") in KINDS else _ct)(path, setup, at_mm)
    truth = points_document(setup, {"origin": setup.hip_mm})
    return Specimen(setup, frame_scene(setup.true_frame) + scene, truth | {"origin_in_file_mm": middle.tolist()}, shown)


def nominal_tags(view: ViewTruth, side: str) -> GeometryTags:
    """Return the geometry that a C-arm would write into its headers: nominal distances, angles to a whole degree.

    Primary angle: of the detector from the patient's front to the left; secondary angle: to the head.
    """
    chain = view.chain
    x, y, z = view.detector.normal
    to_left, to_head = (-x, -y) if side == "right" else (x, y)
    return GeometryTags(
        source_detector_mm=chain.sdd_mm,
        imager_pixel_spacing_mm=(chain.pitch_mm, chain.pitch_mm),
        intensifier_size_mm=chain.tube_mm,
        primary_angle_deg=float(np.rint(np.rad2deg(np.arctan2(to_left, z)))),
        secondary_angle_deg=float(np.rint(np.rad2deg(np.arcsin(to_head)))),
    )


def tagged(setup: SetUp, view: str, image: Radiograph) -> Radiograph:
    """Return a view's image of a solid with the tags that a flat panel writes; one of plates as it is."""
    if setup.frame.solid is None:
        return image
    return replace(image, tags=nominal_tags(setup.views[view], setup.side))


def _hip(rng: np.random.Generator, spec: SetUpSpec) -> Specimen:
    femur = draw_femur(rng)
    head = draw_head(spec.side, femur, rng)
    return _of_hip(rng, spec, femur, head, lambda setup: placed_hip(setup, femur, setup.hip_mm + head, rng))


def _plastic(rng: np.random.Generator, spec: SetUpSpec) -> Specimen:
    return _of_hip(rng, spec, Femur(), None, plastic_hip)


def _porcine(rng: np.random.Generator, spec: SetUpSpec) -> Specimen:
    return _of_hip(rng, spec, PIG, None, lambda setup: porcine_hip(setup, rng))


def _object(rng: np.random.Generator, spec: SetUpSpec) -> Specimen:
    setup, shown = spec.draw(rng, TEST_BALLS_MM)
    block, balls_mm = perspex_object(setup.hip_mm)
    truth = points_document(setup, {f"ball {k + 1}": xyz for k, xyz in enumerate(balls_mm)})
    return Specimen(setup, frame_scene(setup.true_frame) + block, truth, shown)


def _of_hip(
    rng: np.random.Generator,
    spec: SetUpSpec,
    femur: Femur,
    head_mm: np.ndarray | None,
    build: Callable[[SetUp], HipScene],
) -> Specimen:
    """Return a hip whose whole wire is shown, if possible. `head_mm` (3,), from `SetUp.hip_mm`; default: the wire's
    middle there."""
    wire = to_cfcs(np.stack(femur.wire_mm()), spec.side, np.zeros(3))
    setup, shown = spec.draw(rng, wire - wire.mean(axis=0) if head_mm is None else wire + head_mm)
    hip = build(setup)
    return Specimen(setup, hip.scene, truth_document(setup, hip), shown, hip.wire_mm)


def _bone(name: str, rng: np.random.Generator, spec: SetUpSpec) -> Specimen:
    """Return a bone of BONES whose wires are shown, if possible."""
    dimensions = BONES[name].draw(rng)
    bone = dimensions.bone()
    origin = draw_origin(bone, spec.side, rng)
    wires = to_cfcs(bone.wires_mm, spec.side, origin).reshape(-1, 3)
    setup, shown = replace(spec, bone=BONES[name]).draw(rng, wires)
    scene = placed_bone(setup, name, dimensions, setup.hip_mm + origin, rng)
    return Specimen(setup, scene.scene, bone_document(setup, scene), shown, scene.wires_mm[0])


def _mesh(file: Path, setup: SetUp, at_mm: np.ndarray | None) -> tuple[Scene, np.ndarray]:
    """Return solid bone in a body, and the point of the file that is moved to the hip's place."""
    bone = read_mesh(file)
    corners = bone.vertices_mm
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2 if at_mm is None else at_mm
    placed = moved(bone, RigidTransform.from_translation(setup.hip_mm - middle))
    return Scene(meshes=(placed,), tissue=SoftTissue().around(setup.hip_mm)), middle


def _ct(path: Path, setup: SetUp, at_mm: np.ndarray | None) -> tuple[Scene, np.ndarray]:
    """Return tissue and bone of a scan, and its point, patient coordinates, that is moved to the hip's place."""
    scan = read_ct(path)
    half = scan.voxel_mm * (np.array(scan.hu.shape) - 1) / 2
    middle = scan.origin_mm + half @ scan.axes if at_mm is None else at_mm
    return Scene(volumes=ct_volumes(scan, setup.side, middle, setup.hip_mm)), middle


SPECIMENS: dict[str, Callable[[np.random.Generator, SetUpSpec], Specimen]] = {
    "hip": _hip,
    "object": _object,
    "plastic": _plastic,
    "porcine": _porcine,
    **{name: partial(_bone, name) for name in BONES},
}
