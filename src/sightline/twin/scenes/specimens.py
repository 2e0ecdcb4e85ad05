"""The specimens of `sightline simulate`, the phantoms among them, and the accessories that it adds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from sightline.common.names import named
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.imaging import GeometryTags, Radiograph
from sightline.imaging.volumes.ct import ct_volumes, read_ct
from sightline.imaging.volumes.meshes import FILE_TYPES, read_mesh
from sightline.imaging.volumes.volume import bored, fractured
from sightline.twin.anatomy.femur import BONE_PER_HU, Femur, draw_femur, to_cfcs, voxelise
from sightline.twin.objects.things import (
    Ball,
    Box,
    Scene,
    SoftTissue,
    angled_plate,
    drape,
    drill_guide,
    frame_scene,
    guide_wire,
    lag_screw,
    moved,
    table_rail,
)
from sightline.twin.scenes.bone_scene import BONES, BoneKind, bone_document, draw_origin, placed_bone
from sightline.twin.scenes.hip_scene import (
    TEST_BALL_RADIUS_MM,
    TEST_BALLS_MM,
    HipScene,
    draw_head,
    placed_hip,
    points_document,
    truth_document,
)
from sightline.twin.xray.setup import BEAMS, SetUp, ViewTruth, draw_setup

ATTEMPTS = 100
# Sizes and places without a source are [ours, typical].
MARGIN_PX = 30.0  # minimum distance of points of interest from the edge of both fields, where possible
PERSPEX_MM = np.array([60.0, 60.0, 50.0])  # size of the block with the four balls
PLASTIC_BORE_MM = 8.0  # diameter [paper]
FOAM_SHARE = 0.14  # polyurethane foam of 0.27 g/cm³ over glass-filled epoxy of 1.64, at 60 keV [calc]
# A pig of 100 kg: head of 34 mm, short neck, stout shaft.
PIG = Femur(
    head_radius_mm=17.0,
    neck_radius_mm=13.0,
    neck_length_mm=36.0,
    neck_shaft_deg=132.0,
    shaft_radius_mm=13.0,
    canal_radius_mm=6.5,
    socket=False,
)
PIG_FLESH = SoftTissue(centre_mm=(20.0, 0.0), half_mm=(80.0, 65.0))
FRACTURE_SITE = 0.25  # share of the neck's length from the shaft's axis: trochanteric, the most common site [paper]
DRAPE_GAP_MM = 2.0  # from the skin to a drape
RAIL_CENTRE_MM = (130.0, 0.0, -80.0)  # from the hip: beside the patient, at the lower edge of a lateral image


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
        setup, attempts = self._drawn(rng), 1
        while not (shown := setup.shows(setup.hip_mm + points_mm, MARGIN_PX)) and attempts < ATTEMPTS:
            setup, attempts = self._drawn(rng), attempts + 1
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
    """Return a specimen by its name in SPECIMENS, or from a file: a mesh, or a CT scan (a folder if DICOM).

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
            f"({', '.join(FILE_TYPES)}), a NIfTI or NRRD file or a folder of CT slices"
        )
    setup, shown = spec.draw(rng, np.zeros((1, 3)))
    scene, middle = (_mesh if path.suffix.lower().removeprefix(".") in FILE_TYPES else _ct)(path, setup, at_mm)
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
    "plastic": lambda rng, spec: _of_hip(rng, spec, Femur(), None, plastic_hip),
    "porcine": lambda rng, spec: _of_hip(rng, spec, PIG, None, lambda setup: porcine_hip(setup, rng)),
    **{name: partial(_bone, name) for name in BONES},
}


def perspex_object(at_mm: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[Scene, np.ndarray]:
    """Return the paper's calibration object at a point (3,), CFCS, four independent balls in a Perspex block, and their
    centres (4, 3) mm."""
    balls_mm = np.asarray(at_mm) + TEST_BALLS_MM
    block = Box(balls_mm.mean(axis=0), np.eye(3), PERSPEX_MM / 2)
    balls = tuple(Ball((float(x), float(y), float(z)), TEST_BALL_RADIUS_MM) for x, y, z in balls_mm)
    return Scene(solids=balls, boxes=(block,)), balls_mm


def plastic_hip(setup: SetUp) -> HipScene:
    """Return the paper's trial: a bare plastic femur with a bore of 8 mm along its ideal wire, whose middle lies at the
    hip's place.

    The femur is a shell of glass-filled epoxy in place of the cortex, filled with foam.
    """
    femur = Femur(socket=False, cancellous_hu=FOAM_SHARE / BONE_PER_HU)
    head = _centred(setup, femur)
    wire = to_cfcs(np.stack(femur.wire_mm()), setup.side, head)
    whole = replace(voxelise(femur, setup.side, head, None), material="composite", within=None)
    along = (wire[1] - wire[0]) / np.linalg.norm(wire[1] - wire[0])
    bore = bored(whole, np.stack([wire[0] - 5.0 * along, wire[1]]), PLASTIC_BORE_MM)  # start outside the surface
    return HipScene.of(frame_scene(setup.true_frame), Scene(volumes=(bore,)), femur, setup.side, head)


def _centred(setup: SetUp, femur: Femur) -> np.ndarray:
    """Return where the head's centre (3,) lies so that the middle of the ideal wire is at the hip's place."""
    return setup.hip_mm - np.mean(to_cfcs(np.stack(femur.wire_mm()), setup.side, np.zeros(3)), axis=0)


def porcine_hip(setup: SetUp, rng: np.random.Generator) -> HipScene:
    """Return the trials that the paper plans: a pig's femur in soft tissue, with the wire's middle at the hip's place.

    The femur has the human shape at a pig's sizes, so its trochanters are too large.
    """
    head = _centred(setup, PIG)
    bone = Scene(volumes=(voxelise(PIG, setup.side, head, rng),))
    still = frame_scene(setup.true_frame) + Scene(tissue=PIG_FLESH.around(setup.hip_mm))
    return HipScene.of(still, bone, PIG, setup.side, head)


def broken(hip: HipScene, side: str, gap_mm: float = 1.0, motion: RigidTransform | None = None) -> HipScene:
    """Return a hip with a fracture across the base of its neck; `motion` displaces the shaft against head and wire.

    The bone must be the single volume of `hip_scene`, `plastic_hip` or `porcine_hip`, at rest.
    """
    (bone,) = hip.bone.volumes
    along = to_cfcs(hip.femur.towards_head, side, np.zeros(3))
    at = to_cfcs((1 - FRACTURE_SITE) * hip.femur.base_mm, side, hip.head_mm)
    shaft, head = fractured(bone, at, along, gap_mm)
    return replace(hip, bone=replace(hip.bone, volumes=(shaft if motion is None else moved(shaft, motion), head)))


def with_accessories(specimen: Specimen, names: Sequence[str], rng: np.random.Generator) -> Specimen:
    """Return the specimen with the accessories of these names in its beams; its truth lists them under "with".

    Raises UnusableInputError for a name that is not in ACCESSORIES or an accessory that needs a hip.
    """
    scene = specimen.scene
    for name in names:
        scene += named(name, ACCESSORIES, "accessory")(specimen, rng)
    return replace(specimen, scene=scene, truth={**specimen.truth, "with": list(names)})


def _wire(specimen: Specimen) -> np.ndarray:
    if specimen.wire_mm is None:
        raise UnusableInputError("this accessory needs the wire of a hip; simulate hip, plastic or porcine with it")
    return specimen.wire_mm


def _body(specimen: Specimen) -> SoftTissue:
    return specimen.scene.tissue or SoftTissue().around(specimen.setup.hip_mm)


def _angled_plate(specimen: Specimen, _: np.random.Generator) -> Scene:
    caudal = np.array([0.0, 1.0 if specimen.setup.side == "right" else -1.0, 0.0])
    return angled_plate(_wire(specimen), caudal)


def _drape(specimen: Specimen, rng: np.random.Generator) -> Scene:
    """Return a sheet in front of the skin for each beam."""
    body = _body(specimen)
    (x, z), (half_x, half_z) = body.centre_mm, body.half_mm
    y = specimen.setup.hip_mm[1]
    front = drape(rng, np.array([x, y, z + half_z + DRAPE_GAP_MM]), np.array([0.0, 0.0, 1.0]))
    side = drape(rng, np.array([x + half_x + DRAPE_GAP_MM, y, z]), np.array([1.0, 0.0, 0.0]))
    return front + side


ACCESSORIES: dict[str, Callable[[Specimen, np.random.Generator], Scene]] = {
    "guide-wire": lambda specimen, _: guide_wire(_wire(specimen)),
    "lag-screw": lambda specimen, _: lag_screw(_wire(specimen)),
    "angled-plate": _angled_plate,
    "drill-guide": lambda specimen, _: drill_guide(_wire(specimen), _body(specimen)),
    "drape": _drape,
    "table-rail": lambda specimen, _: table_rail(specimen.setup.hip_mm + RAIL_CENTRE_MM),
}
