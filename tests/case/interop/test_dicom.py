"""DICOM of a plan: every required attribute, references that lead somewhere, lines in place, nobody named."""

import io
import re
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from pydicom import Dataset, dcmread
from tests.case.conftest import WIRE_MM
from tests.case.interop.dicom_modules import faults

from sightline.case.interop import dicom as dicom_plan
from sightline.case.interop.dicom import ExportIdentity
from sightline.case.interop.plan_file import PlanFile
from sightline.errors import UnusableInputError
from sightline.imaging import Radiograph, read_image, write_dicom

FILED = ExportIdentity("case-0042", datetime(2024, 5, 17, 10, 30), "left")
NAMED = re.compile("|".join(("Name", "Birth", "Address", "Institution", "Operator", "Physician", "Device", "Station")))


def read(data: bytes) -> Dataset:
    return dcmread(io.BytesIO(data))


@pytest.fixture(scope="module")
def original(pair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A raw image of the PA view as a C-arm writes it, with a patient in its header."""
    file = write_dicom(pair[0].image, tmp_path_factory.mktemp("raw") / "pa.dcm")
    header = dcmread(file)
    header.PatientName, header.PatientID, header.AccessionNumber = "DOE^JANE", "12345", "A77"
    header.save_as(file)
    return file


@pytest.fixture(scope="module")
def objects(go_plan: PlanFile, original: Path) -> dict[str, Dataset]:
    return {name: read(data) for name, data in dicom_plan.write(go_plan, FILED, {"pa": original}).items()}


def test_every_object_has_what_its_modules_require(objects: dict[str, Dataset]) -> None:
    assert len(objects) == 7
    for name, made in objects.items():
        assert faults(made, "state" if "state" in name else "capture") == [], name
    assert len({made.SOPInstanceUID for made in objects.values()}) == len(objects)


def test_side_study_and_series_are_said_where_they_are_known(objects: dict[str, Dataset]) -> None:
    for name, made in objects.items():
        assert made.Laterality == "L"
        assert made.SeriesNumber == (2 if "state" in name else 1)
        study = (made.StudyDate, made.StudyTime, made.StudyID)
        # Of the original's own study nothing but its UIDs was read.
        assert study == (("", "", "") if "original" in name else ("20240517", "103000", "case-0042")), name


def test_without_a_side_the_laterality_is_there_and_empty(go_plan: PlanFile) -> None:
    for data in dicom_plan.write(go_plan, ExportIdentity(FILED.case, FILED.created), {}).values():
        assert read(data)["Laterality"].is_empty


@pytest.mark.parametrize("keyword", ["ConversionType", "PixelData", "StudyInstanceUID", "PatientID"])
def test_the_check_notices_what_is_missing(objects: dict[str, Dataset], keyword: str) -> None:
    spoilt = Dataset()
    spoilt.update(objects["pa.dcm"])
    del spoilt[keyword]
    assert any(keyword in fault for fault in faults(spoilt, "capture"))


def test_the_capture_is_the_undistorted_image(objects: dict[str, Dataset], go_plan: PlanFile, tmp_path: Path) -> None:
    for view, pinhole in go_plan.plates.items():
        known = go_plan.pixels(view)
        assert known is not None
        objects[f"{view}.dcm"].save_as(tmp_path / "a.dcm")
        assert np.array_equal(read_image(tmp_path / "a.dcm").pixels, known[0])
        assert objects[f"{view}.dcm"].PixelSpacing == pytest.approx(pinhole.pixel_mm)
        drawn = objects[f"{view}-plan.dcm"]
        assert (drawn.Rows, drawn.Columns, drawn.BitsStored) == (*known[0].shape, 8)


def test_the_burnt_line_runs_from_entry_to_end(objects: dict[str, Dataset], go_plan: PlanFile) -> None:
    for view, pinhole in go_plan.plates.items():
        shown = objects[f"{view}-plan.dcm"].pixel_array
        entry, end = pinhole.view().project(go_plan.points_mm)
        for share in np.linspace(0.15, 0.85, 15):  # clear of the rings about the ends
            u, v = np.rint(entry + share * (end - entry)).astype(int)
            assert shown[v - 1 : v + 2, u - 1 : u + 2].max() > 200  # drawn over noise that the stretch spreads to 255
            assert shown[v - 3 : v + 4, u - 3 : u + 4].min() < 40  # its dark rim


def graphics(made: Dataset) -> dict[str, list[np.ndarray]]:
    out: dict[str, list[np.ndarray]] = {}
    (annotation,) = made.GraphicAnnotationSequence
    for graphic in annotation.GraphicObjectSequence:
        out.setdefault(graphic.GraphicType, []).append(np.array(graphic.GraphicData).reshape(-1, 2))
        assert len(out[graphic.GraphicType][-1]) == graphic.NumberOfGraphicPoints
    return out


def test_a_state_refers_to_its_image_and_draws_where_the_plan_lies(
    objects: dict[str, Dataset], go_plan: PlanFile
) -> None:
    for view, pinhole in go_plan.plates.items():
        image, made = objects[f"{view}.dcm"], objects[f"{view}-state.dcm"]
        (series,) = made.ReferencedSeriesSequence
        (reference,) = series.ReferencedImageSequence
        assert (series.SeriesInstanceUID, reference.ReferencedSOPInstanceUID) == (
            image.SeriesInstanceUID,
            image.SOPInstanceUID,
        )
        assert made.StudyInstanceUID == image.StudyInstanceUID
        assert made.SeriesInstanceUID != image.SeriesInstanceUID
        (line,) = graphics(made)["POLYLINE"]
        wanted = pinhole.view().project(go_plan.points_mm) + 0.5  # counted from the corner of the first pixel
        assert np.abs(line - wanted).max() < 1e-3  # 32-bit numbers
        (area,) = made.DisplayedAreaSelectionSequence
        assert list(area.DisplayedAreaBottomRightHandCorner) == [image.Columns, image.Rows]


def test_over_the_original_the_wire_bends_with_its_distortion(
    objects: dict[str, Dataset], original: Path, setup
) -> None:
    made, image = objects["pa-original-state.dcm"], dcmread(original)
    (series,) = made.ReferencedSeriesSequence
    assert series.ReferencedImageSequence[0].ReferencedSOPInstanceUID == image.SOPInstanceUID
    assert made.StudyInstanceUID == image.StudyInstanceUID
    (line,) = graphics(made)["POLYLINE"]
    ends = setup.views["pa"].project(WIRE_MM) + 0.5
    assert np.abs(line[[0, -1]] - ends).max() < 1.0  # planned from these very pixels, at 0.1 px
    middle = setup.views["pa"].project(WIRE_MM.mean(axis=0)[None])[0] + 0.5
    assert np.abs(line[len(line) // 2] - middle).max() < 1.0


def test_nobody_is_named(objects: dict[str, Dataset]) -> None:
    for name, made in objects.items():
        for element in made.iterall():
            if NAMED.search(element.keyword) and element.keyword not in ("PatientName", "ContentCreatorName"):
                assert element.is_empty, f"{name}: {element.keyword}"
        assert str(made.PatientName) == made.PatientID == "case-0042"
        text = " ".join(str(element.value) for element in made.iterall() if element.keyword != "PixelData")
        for word in ("DOE", "12345", "A77", "alert"):
            assert word not in text, name


def test_the_verdict_and_the_errors_are_written(objects: dict[str, Dataset], no_go_plan: PlanFile) -> None:
    assert "95 % errors" in objects["pa.dcm"].ImageComments
    assert objects["pa-state.dcm"].ContentDescription.startswith("GO")
    for name, data in dicom_plan.write(no_go_plan, FILED, {}).items():
        made = read(data)
        said = made.ContentDescription if "state" in name else made.ImageComments
        assert "NO-GO" in said, name


def test_the_same_export_is_the_same_to_the_bit(go_plan: PlanFile) -> None:
    assert dicom_plan.write(go_plan, FILED, {}) == dicom_plan.write(go_plan, FILED, {})


@pytest.mark.parametrize("case", ["", "DOE^JANE", "a b", "x" * 17])
def test_what_may_be_a_name_is_no_case_number(case: str) -> None:
    with pytest.raises(UnusableInputError, match="is not a case number"):
        ExportIdentity(case, FILED.created)


def test_an_original_that_is_none_is_refused(go_plan: PlanFile, original: Path, tmp_path: Path) -> None:
    small = write_dicom(Radiograph(np.zeros((64, 64), np.uint16), 4095.0), tmp_path / "small.dcm")
    (tmp_path / "text.dcm").write_text("DOE^JANE")
    for given, words in (
        ({"pa": small}, "the wire lies outside"),
        ({"pa": tmp_path / "text.dcm"}, "not a DICOM image"),
        ({"pa": tmp_path / "none.dcm"}, "not a DICOM image"),
        ({"oblique": original}, "no view oblique"),
    ):
        with pytest.raises(UnusableInputError, match=words) as refused:
            dicom_plan.write(go_plan, FILED, given)
        assert "DOE" not in str(refused.value)
