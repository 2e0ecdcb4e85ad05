"""Required attributes of the two objects that are written, by module, from DICOM PS3.3 (A.8.1, A.33.1).

Type 1 must have a value; type 2 must be there, and may be empty.
"""

from pydicom import Dataset

_PATIENT = {2: "PatientName PatientID PatientBirthDate PatientSex"}
_DEIDENTIFIED = {1: "PatientIdentityRemoved DeidentificationMethod"}  # 1C of the method: identity was removed
_STUDY = {1: "StudyInstanceUID", 2: "StudyDate StudyTime ReferringPhysicianName StudyID AccessionNumber"}
_SERIES = {1: "Modality SeriesInstanceUID", 2: "SeriesNumber Laterality"}  # 2C of the latter: a paired part
_SOP = {1: "SOPClassUID SOPInstanceUID SpecificCharacterSet"}
_COMMON = [_PATIENT, _DEIDENTIFIED, _STUDY, _SERIES, _SOP]
_PIXELS = "SamplesPerPixel PhotometricInterpretation Rows Columns BitsAllocated BitsStored HighBit"
_SPACING = "PixelSpacing PixelSpacingCalibrationType PixelSpacingCalibrationDescription"
_CAPTURE = [
    *_COMMON,
    {1: f"ConversionType {_PIXELS} PixelRepresentation PixelData {_SPACING}", 2: "InstanceNumber PatientOrientation"},
]
_STATE = [
    *_COMMON,
    {1: "InstanceNumber ContentLabel PresentationCreationDate PresentationCreationTime PresentationLUTShape"},
    {2: "Manufacturer ContentDescription ContentCreatorName"},
    {1: "ReferencedSeriesSequence DisplayedAreaSelectionSequence GraphicAnnotationSequence GraphicLayerSequence"},
]
# Of every item of a sequence, wherever it stands; all of type 1.
_ITEMS = {
    "ReferencedSeriesSequence": "SeriesInstanceUID ReferencedImageSequence",
    "ReferencedImageSequence": "ReferencedSOPClassUID ReferencedSOPInstanceUID",
    "DisplayedAreaSelectionSequence": "DisplayedAreaTopLeftHandCorner DisplayedAreaBottomRightHandCorner "
    "PresentationSizeMode PresentationPixelAspectRatio",
    "GraphicAnnotationSequence": "GraphicLayer",
    "GraphicObjectSequence": "GraphicAnnotationUnits GraphicDimensions NumberOfGraphicPoints GraphicData GraphicType",
    "TextObjectSequence": "UnformattedTextValue AnchorPointAnnotationUnits AnchorPoint AnchorPointVisibility",
    "GraphicLayerSequence": "GraphicLayer GraphicLayerOrder",
    "SoftcopyVOILUTSequence": "WindowCenter WindowWidth",
}
_ENUMERATED = {
    "GraphicAnnotationUnits": {"PIXEL", "DISPLAY"},
    "GraphicType": {"POINT", "POLYLINE", "INTERPOLATED", "CIRCLE", "ELLIPSE"},
    "PresentationSizeMode": {"SCALE TO FIT", "TRUE SIZE", "MAGNIFY"},
    "PresentationLUTShape": {"IDENTITY", "INVERSE"},
    "AnchorPointVisibility": {"Y", "N"},
    "ConversionType": {"DV", "DI", "DF", "WSD", "SD", "SI", "DRW", "SYN"},
    "PhotometricInterpretation": {"MONOCHROME1", "MONOCHROME2"},
}
MODULES = {"capture": _CAPTURE, "state": _STATE}


def faults(dataset: Dataset, kind: str) -> list[str]:
    """What the object lacks, or has that it may not have; empty for a good one."""
    out = _missing(dataset, MODULES[kind], kind)
    for element in dataset.iterall():
        if element.keyword in _ENUMERATED and element.value not in _ENUMERATED[element.keyword]:
            out.append(f"{element.keyword} is {element.value}")
        for item in element.value if element.VR == "SQ" else ():
            out += _missing(item, [{1: _ITEMS.get(element.keyword, "")}], element.keyword)
    return out


def _missing(dataset: Dataset, modules: list[dict[int, str]], where: str) -> list[str]:
    return [
        f"{where}: {keyword} (type {kind})"
        for module in modules
        for kind, keywords in module.items()
        for keyword in keywords.split()
        if keyword not in dataset or (kind == 1 and dataset[keyword].is_empty)
    ]
