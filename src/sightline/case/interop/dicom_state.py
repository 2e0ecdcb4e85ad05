"""A DICOM grayscale softcopy presentation state: the plan drawn over a referenced image, whose pixels stay the same."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydicom import Dataset, dcmread
from pydicom.uid import GrayscaleSoftcopyPresentationStateStorage

from sightline.bounded import regular_file
from sightline.case.interop.dicom_parts import ExportIdentity, dataset
from sightline.case.interop.overlay import PlanOverlay
from sightline.errors import UnusableInputError

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
    out = dataset(identity, GrayscaleSoftcopyPresentationStateStorage, "PR", f"state {number}", image.study)
    out.InstanceNumber, out.ContentLabel = number, "PLAN"
    out.ContentDescription, out.ContentCreatorName = statement[:64], None
    out.PresentationCreationDate = f"{identity.created:%Y%m%d}"
    out.PresentationCreationTime = f"{identity.created:%H%M%S}"
    out.ReferencedSeriesSequence = [_series(image)]
    out.DisplayedAreaSelectionSequence = [_area(image)]
    out.GraphicAnnotationSequence = [_annotation(image, drawn, statement)]
    layer = Dataset()
    layer.GraphicLayer, layer.GraphicLayerOrder, layer.GraphicLayerRecommendedDisplayGrayscaleValue = _LAYER, 1, 65535
    out.GraphicLayerSequence = [layer]
    if image.window is not None:
        window = Dataset()
        window.WindowCenter, window.WindowWidth = image.window
        out.SoftcopyVOILUTSequence = [window]
    out.PresentationLUTShape = "INVERSE" if image.inverse else "IDENTITY"
    return out


def _reference(image: ReferencedImage) -> Dataset:
    one = Dataset()
    one.ReferencedSOPClassUID, one.ReferencedSOPInstanceUID = image.sop_class, image.instance
    return one


def _series(image: ReferencedImage) -> Dataset:
    out = Dataset()
    out.SeriesInstanceUID, out.ReferencedImageSequence = image.series, [_reference(image)]
    return out


def _area(image: ReferencedImage) -> Dataset:
    out = Dataset()
    out.ReferencedImageSequence = [_reference(image)]
    out.DisplayedAreaTopLeftHandCorner, out.DisplayedAreaBottomRightHandCorner = [1, 1], list(image.shape[::-1])
    out.PresentationSizeMode, out.PresentationPixelAspectRatio = "SCALE TO FIT", [1, 1]
    return out


def _annotation(image: ReferencedImage, drawn: PlanOverlay, statement: str) -> Dataset:
    out = Dataset()
    out.ReferencedImageSequence, out.GraphicLayer = [_reference(image)], _LAYER
    places = [drawn.entry_px, drawn.end_px]
    lines = [_graphic("POLYLINE", drawn.wire_px)] if len(drawn.wire_px) > 1 else []
    out.GraphicObjectSequence = [*lines, *(_graphic("POINT", place[None]) for place in places)]
    out.TextObjectSequence = [
        _text("entry", drawn.entry_px),
        _text("end", drawn.end_px),
        _text(statement[:1024], np.array([4.0, 4.0])),
    ]
    return out


def _from_corner(uv_px: np.ndarray) -> list[float]:
    """Convert IDCS, whose origin is the centre of the first pixel, to DICOM's, whose origin is its corner."""
    return [float(np.float32(x)) for x in (np.asarray(uv_px) + 0.5).ravel()]


def _graphic(kind: str, uv_px: np.ndarray) -> Dataset:
    out = Dataset()
    out.GraphicAnnotationUnits, out.GraphicDimensions, out.NumberOfGraphicPoints = "PIXEL", 2, len(uv_px)
    out.GraphicData, out.GraphicType = _from_corner(uv_px), kind
    if kind == "POLYLINE":
        out.GraphicFilled = "N"
    return out


def _text(words: str, uv_px: np.ndarray) -> Dataset:
    out = Dataset()
    out.UnformattedTextValue, out.AnchorPointAnnotationUnits = words, "PIXEL"
    out.AnchorPoint, out.AnchorPointVisibility = _from_corner(uv_px), "N"
    return out
