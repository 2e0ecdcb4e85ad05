"""Results say in ten lines what a person needs; they show a picture, draw themselves and make tables."""

import base64
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from matplotlib import pyplot
from tests.worked import Worked

import sightline as sl
from sightline.case.canonical import plain
from sightline.common.show import Plotted, Shown
from sightline.errors import UnusableInputError

MATRIX = np.array([[1000.0, 0.0, 512.0, 0.0], [0.0, 1000.0, 512.0, 0.0], [0.0, 0.0, 1.0, 600.0]])


@pytest.fixture(scope="module")
def results(worked: Worked) -> dict[str, Shown]:
    no_image = sl.Observations("pa", worked.observations.ids, worked.observations.uv_px)
    return {
        "image": worked.image,
        "frame": sl.Frame.load("gamma"),
        "detections": worked.beads,
        "no detections": sl.Detections(*(np.zeros(s) for s in ((0, 2), 0, (0, 2, 2))), (), np.zeros(0), (512, 640)),
        "observations": worked.observations,
        "observations without image": no_image,
        "view": worked.views[0],
        "view without image": sl.calibrate(no_image, "gamma"),
        "localized": sl.calibrate(worked.observations, "gamma", method="localized"),
        "matrix": sl.view_from_matrix(MATRIX),
        "points": worked.points,
        "trajectory": worked.plan.trajectory,
        "plan": worked.plan,
        "no-go": sl.plan(worked.views, worked.wire_px[:, 0], worked.wire_px[:, 1]),
        "verdict": worked.plan.verdict,
        "check shot": worked.shot,
    }


def test_a_repr_has_ten_lines_at_most(results: dict[str, Shown]) -> None:
    for name, result in results.items():
        said = repr(result)
        assert said == result.summary()
        lines = said.splitlines()
        assert 1 <= len(lines) <= 10, name
        assert max(map(len, lines)) <= 130, name


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("image", "1024 x 1024 px, uint16"),
        ("frame", "49 beads on the XRII plate, 64 on the source plate"),
        ("detections", "balls; radius"),
        ("no detections", "0 beads in an image of 640 x 512 px"),
        ("observations", "labelled in an image of 1024 x 1024 px"),
        ("observations without image", "error of the centres unknown"),
        ("view", "s.d. ("),
        ("matrix", "error unknown: every verdict on it is NO-GO"),
        ("points", "95 % error"),
        ("trajectory", "95 % error of the direction"),
        ("plan", "Plan of a hip screw, right side: GO"),
        ("no-go", "failed: "),
        ("check shot", "Check shot: passed"),
    ],
)
def test_it_says_what_a_person_needs(results: dict[str, Shown], name: str, words: str) -> None:
    assert words in repr(results[name])


def test_the_figures_said_are_those_of_the_result(results: dict[str, Shown], worked: Worked) -> None:
    view = worked.views[0]
    lines = view.lines_of_sight(np.array([[512.0, 512.0]]))
    sd = np.sqrt(np.diag(sum(lines.covariance.values()))[:3])
    assert view.focal_point_sd_mm == pytest.approx(sd, rel=0.02)
    assert f"{worked.plan.trajectory.entry_error_95_mm:.2f} mm" in repr(worked.plan)
    assert f"95 % error {worked.points.error_95_mm[1]:.2f} mm" in repr(worked.points)
    assert worked.points.error_95_mm[0] == pytest.approx(sl.Trajectory(worked.points).entry_error_95_mm)


@pytest.mark.slow
def test_a_notebook_shows_the_text_and_a_picture_of_bounded_size(results: dict[str, Shown]) -> None:
    before = pyplot.get_fignums()
    for name, result in results.items():
        html = result._repr_html_()
        assert html.startswith("<pre>"), name
        assert len(html) < 700_000, name
        found = re.search(r'src="data:image/png;base64,([^"]+)"', html)
        assert (found is not None) == isinstance(result, Plotted), name
        if found:
            picture = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_COLOR)
            assert picture.std() > 5, name  # something is drawn
    assert pyplot.get_fignums() == before  # no figure of the user's is opened, or left open


def test_text_of_a_file_cannot_become_markup() -> None:
    odd = sl.Observations("<b>pa</b>", ("<script>",), np.zeros((1, 2)))
    assert "<b>" not in odd._repr_html_()
    assert "&lt;b&gt;" in odd._repr_html_()


def test_a_large_picture_is_made_smaller(monkeypatch: pytest.MonkeyPatch, worked: Worked) -> None:
    monkeypatch.setattr("sightline.common.show._MAX_PICTURE_BYTES", 40_000)
    assert len(worked.beads._repr_html_()) < 60_000


def test_plot_draws_into_given_axes_or_into_a_new_figure(results: dict[str, Shown], worked: Worked) -> None:
    for name in ("observations without image", "trajectory", "plan"):
        ax = results[name].plot()
        assert all(one.has_data() for one in np.ravel(ax))
        pyplot.close()
    figure, (left, right) = pyplot.subplots(1, 2)
    assert worked.beads.plot(left) is left
    assert worked.views[0].plot(ax=right) is right
    assert left.images and right.images  # the image is known, and drawn
    pyplot.close(figure)


def test_the_arrows_are_the_residuals_and_their_scale_is_said(worked: Worked) -> None:
    view = worked.views[1]
    ax = view.plot()
    (arrows,) = [one for one in ax.collections if hasattr(one, "scale") and hasattr(one, "U")]
    times = float(re.search(r"residuals, ([\d.]+) times as large", ax.get_title(loc="left"))[1])
    used = view.residuals.used
    by_px = view.plane_map.jacobian(view.residuals.uv_px[used])
    drawn_px = np.stack([arrows.U, arrows.V], axis=1) / arrows.scale
    carried_mm = np.einsum("nij,nj->ni", by_px, drawn_px)
    stated = times * view.residuals.residual_mm[used]
    # An affine map carries them: it knows nothing of the distortion, some ten percent at the edge.
    assert (np.linalg.norm(carried_mm - stated, axis=1) < 0.25 * np.linalg.norm(stated, axis=1)).all()
    pyplot.close()


def test_without_the_image_the_field_is_drawn(results: dict[str, Shown]) -> None:
    ax = results["view without image"].plot()
    assert not ax.images
    bottom, top = ax.get_ylim()
    assert bottom > top  # v points down
    pyplot.close()


def test_tables_hold_the_rows_of_the_result(worked: Worked) -> None:
    beads = worked.beads.to_dataframe()
    assert list(beads)[:4] == ["u_px", "v_px", "radius_px", "kind"]
    assert beads["v_px"].to_numpy() == pytest.approx(worked.beads.uv_px[:, 1])
    assert beads["suv_px2"].to_numpy() == pytest.approx(worked.beads.covariance_px2[:, 0, 1])
    seen = worked.observations.to_dataframe()
    assert list(seen["id"]) == list(worked.observations.ids)
    left = worked.views[0].to_dataframe()
    assert left["residual_y_mm"].to_numpy() == pytest.approx(worked.views[0].residuals.residual_mm[:, 1])
    points = worked.points.to_dataframe()
    assert points[["x_mm", "y_mm", "z_mm"]].to_numpy() == pytest.approx(worked.points.xyz_mm)
    checks = worked.plan.to_dataframe()
    assert list(checks["name"]) == [check.name for check in worked.plan.verdict.checks]
    assert checks["passed"].all()


def test_unknown_errors_are_not_numbers_in_a_table(worked: Worked) -> None:
    views = [sl.view_from_matrix(MATRIX), sl.view_from_matrix(MATRIX[:, [2, 1, 0, 3]], name="other")]
    points = sl.reconstruct(views, np.full((2, 1, 2), 520.0), np.broadcast_to(np.eye(2), (2, 1, 2, 2)))
    table = points.to_dataframe()
    assert table["error_95_mm"].isna().all() and table["gap_sigma"].isna().all()
    assert "error unknown" in repr(points)


def test_without_pandas_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch, worked: Worked) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UnusableInputError, match="pip install pandas"):
        worked.beads.to_dataframe()


def test_the_image_is_written_into_no_document(worked: Worked) -> None:
    assert worked.beads.pixels is not None
    assert worked.observations.pixels is not None
    assert "pixels" not in plain(worked.beads)
    assert "pixels" not in plain(worked.observations)


@pytest.mark.slow
def test_matplotlib_and_pandas_are_imported_only_when_used() -> None:
    program = "import sys, sightline as sl; repr(sl.Frame.load('gamma')); [getattr(sl, name) for name in sl.__all__]; "
    program += "print(*sorted({'matplotlib', 'pandas'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout.strip() == ""
