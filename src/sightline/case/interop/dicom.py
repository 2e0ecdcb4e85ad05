"""A plan and images as DICOM: secondary captures, presentation states. The case number names the patient.

A plan becomes the undistorted image of each view, a copy with the plan burnt in, and a presentation state.
"""

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from pydicom import Dataset, dcmread
from pydicom.uid import GrayscaleSoftcopyPresentationStateStorage, SecondaryCaptureImageStorage, generate_uid

from sightline import __version__
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.case.interop.plan_file import PlanFile
from sightline.common.bounded import regular_file
from sightline.errors import UnusableInputError
from sightline.imaging.dicom import file_bytes, fill, with_pixels
from sightline.imaging.radiograph import stretched

_SERIES = {"OT": 1, "PR": 2}  # images, presentation states


@dataclass(frozen=True)
class ExportIdentity:
    """Identity of an export: case number, time of creation, the patient's side where known. Equal identities give equal
    UIDs."""

    case: str
    created: datetime
    side: Literal["left", "right"] | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,16}", self.case):
            raise UnusableInputError(
                f"--case {self.case[:40]!r} is not a case number: give 1 to 16 letters, digits or _ . - , and no name"
            )

    def uid(self, *parts: str) -> str:
        """Return the UID of one part of the export."""
        return str(generate_uid(entropy_srcs=[self.case, self.created.isoformat(), *parts]))


def dataset(
    identity: ExportIdentity, sop_class: str, modality: str, part: str, study_uid: str | None = None
) -> Dataset:
    """Return the modules patient, study, series, equipment and SOP common.

    Without `study_uid` the object belongs to a study of the export's own.
    """
    study = identity.uid("study")
    # Of the study of the original image only the UIDs were read.
    is_own = study_uid in (None, study)
    return fill(
        Dataset(),
        SOPClassUID=sop_class,
        SOPInstanceUID=identity.uid("instance", part),
        StudyInstanceUID=study_uid or study,
        SeriesInstanceUID=identity.uid("series", modality, study_uid or study),
        SpecificCharacterSet="ISO_IR 192",
        PatientName=identity.case,
        PatientID=identity.case,
        **dict.fromkeys(("PatientBirthDate", "PatientSex", "ReferringPhysicianName", "AccessionNumber")),
        StudyDate=f"{identity.created:%Y%m%d}" if is_own else None,
        StudyTime=f"{identity.created:%H%M%S}" if is_own else None,
        StudyID=identity.case if is_own else None,
        PatientIdentityRemoved="YES",
        DeidentificationMethod="Only the case number is written",
        Modality=modality,
        SeriesNumber=_SERIES[modality],
        Manufacturer="Sightline",
        Laterality=None if identity.side is None else identity.side[0].upper(),
        SoftwareVersions=__version__,
    )


def capture(
    image: tuple[np.ndarray, float], pinhole: Pinhole, identity: ExportIdentity, comment: str, number: int
) -> Dataset:
    """Return an image as a secondary capture: pixels (H, W), uint8 or uint16, and their white value.

    The stated pixel size is that on the plate. Raises UnusableInputError for other types of pixels.
    """
    pixels, white = image
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.shape != pinhole.shape:
        raise UnusableInputError("DICOM holds whole numbers of 8 or 16 bits; give images with such pixels")
    bits = 8 * pixels.itemsize
    top = min(float(white), 2.0**bits - 1)
    _, across, down = pinhole.detector_mm()
    secondary = fill(
        dataset(identity, SecondaryCaptureImageStorage, "OT", f"{pinhole.name} {number}"),
        ConversionType="WSD",
        InstanceNumber=number,
        PatientOrientation=None,
        ImageType=["DERIVED", "SECONDARY"],
        BurnedInAnnotation="NO",
        SeriesDescription="Sightline",
        ImageComments=comment[:10240],
        DerivationDescription="Resampled to the plane of the XRII plate: distortion removed",
        WindowCenter=[f"{0.5 * (top + 1):.10g}"],
        WindowWidth=[f"{top + 1:.10g}"],
        PixelSpacing=[f"{down:.10g}", f"{across:.10g}"],
        PixelSpacingCalibrationType="FIDUCIAL",
        PixelSpacingCalibrationDescription="mm in the plane of the XRII plate",
    )
    return with_pixels(secondary, pixels, bits)


@dataclass(frozen=True, eq=False)
class PlanOverlay:
    """Entry and end point (2,), and the wire from entry to end (M, 2), IDCS of the image that is drawn on."""

    entry_px: np.ndarray
    end_px: np.ndarray
    wire_px: np.ndarray


def on_plate(plan: PlanFile, pinhole: Pinhole) -> PlanOverlay:
    """Return the projected plan, not the picks, in a pinhole's image, where the wire is straight."""
    entry, end = pinhole.view().project(plan.points_mm)
    return PlanOverlay(entry, end, np.stack([entry, end]))


def burn_in(pixels: np.ndarray, drawn: PlanOverlay, words: str) -> np.ndarray:
    """Return the image (H, W) as uint8, contrast stretched, with `words` and the wire in white with a black rim."""
    shown = stretched(pixels.astype(np.float32), pixels)
    fine = 16  # OpenCV draws to 1/16 px
    path = np.rint(drawn.wire_px * fine).astype(np.int32).reshape(-1, 1, 2)
    for colour, width in ((0, 5), (255, 1)):
        cv2.polylines(shown, [path], False, colour, width, cv2.LINE_AA, 4)
        for place in (drawn.entry_px, drawn.end_px):
            u, v = (int(x) for x in np.rint(np.asarray(place) * fine))
            cv2.circle(shown, (u, v), 6 * fine, colour, width, cv2.LINE_AA, 4)
        cv2.putText(shown, words, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA)
    return shown


_LAYER = "PLAN"
_READ = ["SOPClassUID", "SOPInstanceUID", "SeriesInstanceUID", "StudyInstanceUID", "Rows", "Columns"]
_ALSO = ["PhotometricInterpretation", "NumberOfFrames", "WindowCenter", "WindowWidth"]


@dataclass(frozen=True)
class ReferencedImage:
    """The UIDs that a reference to an image needs, its shape (H, W), and how it is displayed. Nothing else is read."""

    sop_class: str
    instance: str
    series: str
    study: str
    shape: tuple[int, int]
    inverse: bool = False
    window: tuple[str, str] | None = None

    @staticmethod
    def of(image: Dataset) -> "ReferencedImage":
        """Return the reference to an image. Raises UnusableInputError if `image` is not a single image."""
        missing = [keyword for keyword in _READ if not image.get(keyword)]
        if missing or int(image.get("NumberOfFrames") or 1) != 1:
            raise UnusableInputError(
                f"a presentation state refers to one image; missing: {', '.join(missing) or 'none'}"
            )
        centre, width = (_first(image.get(keyword)) for keyword in ("WindowCenter", "WindowWidth"))
        return ReferencedImage(
            str(image.SOPClassUID),
            str(image.SOPInstanceUID),
            str(image.SeriesInstanceUID),
            str(image.StudyInstanceUID),
            (int(image.Rows), int(image.Columns)),
            image.get("PhotometricInterpretation") == "MONOCHROME1",
            (centre, width) if centre is not None and width is not None else None,
        )

    @staticmethod
    def read(file: Path) -> "ReferencedImage":
        """Read the reference from a DICOM file's header. Raises UnusableInputError."""
        try:
            with regular_file(file) as stream:
                header = dcmread(stream, stop_before_pixels=True, specific_tags=_READ + _ALSO)
            return ReferencedImage.of(header)
        except UnusableInputError as error:
            raise UnusableInputError(f"{file.name}: {error}") from None
        except Exception:  # broken bytes may make pydicom raise anything; its messages may quote the patient
            raise UnusableInputError(f"{file.name} is not a DICOM image; give the original of the view") from None


def _first(value: object) -> str | None:
    """Return the first of one or several numbers as text; None if it is not a number."""
    several = value if isinstance(value, (list, tuple)) or hasattr(value, "__getitem__") else [value]
    text = "" if value is None else str(several[0] if not isinstance(value, str) else value)  # pyright: ignore[reportIndexIssue]
    try:
        return f"{float(text):.10g}"
    except ValueError:
        return None


def state(image: ReferencedImage, drawn: PlanOverlay, statement: str, identity: ExportIdentity, number: int) -> Dataset:
    """Return the presentation state that draws wire, entry and end point, and the plan's statement over an image."""
    window = {} if image.window is None else dict(zip(("WindowCenter", "WindowWidth"), image.window, strict=True))
    reference = fill(Dataset(), ReferencedSOPClassUID=image.sop_class, ReferencedSOPInstanceUID=image.instance)
    series = fill(Dataset(), SeriesInstanceUID=image.series, ReferencedImageSequence=[reference])
    area = fill(
        Dataset(),
        ReferencedImageSequence=[reference],
        DisplayedAreaTopLeftHandCorner=[1, 1],
        DisplayedAreaBottomRightHandCorner=list(image.shape[::-1]),
        PresentationSizeMode="SCALE TO FIT",
        PresentationPixelAspectRatio=[1, 1],
    )
    lines = [_graphic("POLYLINE", drawn.wire_px, GraphicFilled="N")] if len(drawn.wire_px) > 1 else []
    marks = [_graphic("POINT", place[None]) for place in (drawn.entry_px, drawn.end_px)]
    texts = (("entry", drawn.entry_px), ("end", drawn.end_px), (statement[:1024], np.array([4.0, 4.0])))
    annotation = fill(
        Dataset(),
        ReferencedImageSequence=[reference],
        GraphicLayer=_LAYER,
        GraphicObjectSequence=[*lines, *marks],
        TextObjectSequence=[_text(words, uv_px) for words, uv_px in texts],
    )
    layer = fill(
        Dataset(), GraphicLayer=_LAYER, GraphicLayerOrder=1, GraphicLayerRecommendedDisplayGrayscaleValue=65535
    )
    return fill(
        dataset(identity, GrayscaleSoftcopyPresentationStateStorage, "PR", f"state {number}", image.study),
        InstanceNumber=number,
        ContentLabel="PLAN",
        ContentDescription=statement[:64],
        ContentCreatorName=None,
        PresentationCreationDate=f"{identity.created:%Y%m%d}",
        PresentationCreationTime=f"{identity.created:%H%M%S}",
        ReferencedSeriesSequence=[series],
        DisplayedAreaSelectionSequence=[area],
        GraphicAnnotationSequence=[annotation],
        GraphicLayerSequence=[layer],
        **({"SoftcopyVOILUTSequence": [fill(Dataset(), **window)]} if window else {}),
        PresentationLUTShape="INVERSE" if image.inverse else "IDENTITY",
    )


def _from_corner(uv_px: np.ndarray) -> list[float]:
    """Convert IDCS, whose origin is the centre of the first pixel, to DICOM's, whose origin is its corner."""
    return [float(np.float32(x)) for x in (np.asarray(uv_px) + 0.5).ravel()]


def _graphic(kind: str, uv_px: np.ndarray, **more: str) -> Dataset:
    return fill(
        Dataset(),
        GraphicAnnotationUnits="PIXEL",
        GraphicDimensions=2,
        NumberOfGraphicPoints=len(uv_px),
        GraphicData=_from_corner(uv_px),
        GraphicType=kind,
        **more,
    )


def _text(words: str, uv_px: np.ndarray) -> Dataset:
    return fill(
        Dataset(),
        UnformattedTextValue=words,
        AnchorPointAnnotationUnits="PIXEL",
        AnchorPoint=_from_corner(uv_px),
        AnchorPointVisibility="N",
    )


def write(plan: PlanFile, identity: ExportIdentity, originals: Mapping[str, Path]) -> dict[str, bytes]:
    """Return three files per view, and for each of `originals` (a DICOM file by view) a presentation state over it.

    Raises UnusableInputError if the plan was made without images, or an original is not the image of its view.
    """
    documents: dict[str, bytes] = {}
    for k, (view, pinhole) in enumerate(plan.plates.items()):
        image = plan.pixels(view)
        if image is None:
            raise UnusableInputError(f"the plan has no image of view {view}: it was made from observations in CSV")
        drawn = on_plate(plan, pinhole)
        plain = capture(image, pinhole, identity, f"{view}, undistorted; {plan.statement}", 4 * k + 1)
        shown = burn_in(image[0], drawn, plan.verdict)
        documents[f"{view}.dcm"] = file_bytes(plain)
        documents[f"{view}-plan.dcm"] = file_bytes(
            capture((shown, 255.0), pinhole, identity, f"{view}, plan drawn; {plan.statement}", 4 * k + 2)
        )
        over_plain = state(ReferencedImage.of(plain), drawn, plan.statement, identity, 4 * k + 3)
        documents[f"{view}-state.dcm"] = file_bytes(over_plain)
        if view in originals:
            documents[f"{view}-original-state.dcm"] = _over_original(plan, view, originals[view], identity, 4 * k + 4)
    unknown = set(originals) - set(plan.plates)
    if unknown:
        raise UnusableInputError(f"the plan has no view {', '.join(sorted(unknown))}")
    return documents


def _over_original(plan: PlanFile, view: str, original: Path, identity: ExportIdentity, number: int) -> bytes:
    if plan.document.drawn is None or view not in plan.document.drawn:
        raise UnusableInputError("the plan does not say where it lies in the raw images; plan again with --out")
    given = plan.document.drawn[view]
    entry, end, wire = (np.array(px, dtype=np.float64) for px in (given.entry_px, given.end_px, given.wire_px))
    drawn = PlanOverlay(entry, end, wire.reshape(-1, 2))
    image = ReferencedImage.read(original)
    inside = all((px >= -0.5).all() and (px <= np.array(image.shape[::-1]) - 0.5).all() for px in drawn.wire_px)
    if not inside:
        raise UnusableInputError(f"{original.name} is not the image of view {view}: the wire lies outside it")
    return file_bytes(state(image, drawn, plan.statement, identity, number))


def encode(kind: str, name: str, pixels: np.ndarray, white: float, pinhole: Pinhole) -> dict[str, bytes]:
    """Return an image (H, W) as one file, by its name. `kind`: png, npy or dicom. Raises UnusableInputError."""
    if kind == "npy":
        buffer = io.BytesIO()
        np.save(buffer, pixels)
        return {f"{name}.npy": buffer.getvalue()}
    if kind not in ("png", "dicom"):
        raise UnusableInputError(f"{kind!r} is not an image format; choose png, npy or dicom")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise UnusableInputError(f"the image has {pixels.dtype} pixels, which {kind} cannot hold; choose npy")
    if kind == "png":
        return {f"{name}.png": cv2.imencode(".png", pixels)[1].tobytes()}
    identity = ExportIdentity("undistorted", datetime.now().replace(microsecond=0))
    return {f"{name}.dcm": file_bytes(capture((pixels, white), pinhole, identity, f"{name}, undistorted", 1))}
