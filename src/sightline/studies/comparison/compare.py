"""Comparison of the twin with real images: both are measured in the same way."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sightline.case.report.radiographs import grey, jpeg_uri
from sightline.detection import Detections, detect
from sightline.detection.lattice import Lattice
from sightline.errors import DetectionRefusedError, SightlineError, UnusableInputError
from sightline.frame import Frame
from sightline.frame.plate import SOURCE_TO_DETECTOR_MM, SOURCE_TO_HIP_MM
from sightline.imaging import Radiograph, read_image
from sightline.imaging.formats import FORMAT_NAMES
from sightline.studies.comparison import measures as measure
from sightline.studies.comparison.measures import (
    NotMeasurableError,
    field_circle,
    lattice_of,
    open_beam,
    usual_balls,
)
from sightline.studies.runs.page import page
from sightline.studies.runs.plots import COLOURS, PlotAxis, PlotPoint, PlotSeries, xy
from sightline.studies.runs.study import Plot
from sightline.twin import Scene, ViewTruth, draw_setup, hip_scene, render
from sightline.twin.objects.things import Ball, Box, Rod, SoftTissue, Solid
from sightline.twin.xray.setup import shadow_radius_px

LAGS_PX = (1, 2)  # at larger lags blocks of 16 px reduce the correlation by 0.05 or more [calc]
RANGE = (5, 95)  # percentiles of the twin's distortion over other tubes and poses
DRAWS = 2 * 100 // RANGE[0]  # of them: two lie beyond each end of the range
MAX_IMAGES = 40  # per folder: each takes up to half a minute [ours]

SHOWN_PX = 512  # [ours] side of an image on the page, two of which are side by side on a screen
MAX_LEGEND = len(COLOURS)  # images per plot: one colour for each


Curve = list[tuple[float, float]]


@dataclass(frozen=True)
class Measurement:
    """A value measured on one image, or why it could not be measured. Measurements of equal names are compared."""

    name: str
    unit: str
    value: float | None
    why_not: str = ""

    def __str__(self) -> str:
        return f"not measurable: {self.why_not}" if self.value is None else f"{self.value:.3g} {self.unit}".strip()


@dataclass(frozen=True, eq=False)
class ImageMeasurements:
    """All measurements of one image. `curves` by name: residual, noise, correlation, vignetting."""

    image: Radiograph
    beads: Detections | None
    measurements: tuple[Measurement, ...]
    curves: dict[str, Curve] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Pair:
    """A real image and the twin's image of the same kind. `ranges`: 5th and 95th percentile over the twin's draws, by
    measurement."""

    name: str
    real: ImageMeasurements
    twin: ImageMeasurements
    like: str
    ranges: dict[str, tuple[float, float]]


def read_folder(folder: Path, *, invert: bool = False) -> tuple[list[tuple[str, Radiograph]], list[str]]:
    """Read the images of a folder in the order of their names; return them, and why each other file was skipped.

    `invert`: as of `read_image`. Raises UnusableInputError if there is no folder, no image in it, or more than
    MAX_IMAGES files.
    """
    if not folder.is_dir():
        raise UnusableInputError(f"{folder} is not a folder; name one that holds images of a C-arm")
    files = sorted(f for f in folder.iterdir() if f.is_file() and not f.name.startswith("."))
    if len(files) > MAX_IMAGES:
        raise UnusableInputError(f"{folder} holds {len(files)} files; the limit is {MAX_IMAGES}: choose some")
    images, passed = [], []
    for file in files:
        try:
            images.append((file.name, read_image(file, invert=invert)))
        except SightlineError as error:
            passed.append(str(error))
    if not images:
        why = f" ({'; '.join(passed)})" if passed else ""
        raise UnusableInputError(f"no image in {folder} can be read{why}; give {FORMAT_NAMES} files")
    return images, passed


def compare(name: str, image: Radiograph, rng: np.random.Generator) -> Pair:
    """Measure an image, make the twin's image of the same kind, and measure that in the same way."""
    real = measured(image)
    words, twin = twin_of(image, real.beads, rng)
    return Pair(name, real, measured(twin), words, _ranges(real, rng))


def measured(image: Radiograph) -> ImageMeasurements:
    """Measure everything that an image shows of its machine."""
    beads = _beads(image)
    curves: dict[str, Curve] = {}
    measurements = [
        *_distortion(image, beads, curves),
        *_or_why([("edge spread", "px")], lambda: measure.edge_spread(image, beads)[:1]),
        *_noise(image, beads, curves),
        *_contrast(beads),
        *_vignetting(image, beads, curves),
    ]
    return ImageMeasurements(image, beads, tuple(measurements), curves)


def _beads(image: Radiograph) -> Detections | None:
    try:
        return detect(image)
    except DetectionRefusedError:
        return None


def _or_why(names: Sequence[tuple[str, str]], values: Callable[[], Sequence[float]]) -> list[Measurement]:
    """Return measurements of (name, unit), or the reason why they cannot be measured."""
    try:
        return [Measurement(name, unit, float(value)) for (name, unit), value in zip(names, values(), strict=True)]
    except NotMeasurableError as error:
        return [Measurement(name, unit, None, str(error)) for name, unit in names]


def _distortion(image: Radiograph, beads: Detections | None, curves: dict[str, Curve]) -> list[Measurement]:
    names = [("pincushion", "%"), ("turn", "mrad"), *((f"residual of degree {d}", "px") for d in measure.DEGREES)]
    try:
        lattice = measure.lattice_of(beads)
        measured = measure.distortion(lattice, *measure.field_circle(image))
    except NotMeasurableError as error:
        return [Measurement(name, unit, None, str(error)) for name, unit in names]
    curves["residual"] = [(float(d), r) for d, r in measured.residual_px.items()]
    return _of_distortion(measured)


def _of_distortion(measured: measure.DistortionMeasured) -> list[Measurement]:
    few = f"{measured.points} points are too few for its coefficients"
    return [
        Measurement("pincushion", "%", 100 * measured.pincushion),
        Measurement("turn", "mrad", 1000 * abs(measured.turn_rad)),
        *(Measurement(f"residual of degree {d}", "px", measured.residual_px.get(d), few) for d in measure.DEGREES),
    ]


def _noise(image: Radiograph, beads: Detections | None, curves: dict[str, Curve]) -> list[Measurement]:
    names = [
        ("noise at the median level", "%"),
        ("noise exponent", ""),
        *((f"noise correlation at {lag} px", "") for lag in LAGS_PX),
    ]

    def values() -> list[float]:
        model, levels = measure.noise(image, beads)
        percent = 100 * np.sqrt(model.variance(levels))
        curves["noise"] = list(zip(np.exp(levels - levels[2]).tolist(), percent.tolist(), strict=True))
        curves["correlation"] = [(float(lag), float(c)) for lag, c in enumerate(model.correlation)]
        return [percent[2], model.slope, *(model.correlation[lag] for lag in LAGS_PX)]

    return _or_why(names, values)


def _contrast(beads: Detections | None) -> list[Measurement]:
    names = [("contrast of balls", "in ln"), ("radius of balls", "px")]
    return _or_why(names, lambda: measure.ball_contrast(beads)[:2])


def _vignetting(image: Radiograph, beads: Detections | None, curves: dict[str, Curve]) -> list[Measurement]:
    def values() -> list[float]:
        measured = measure.vignetting(image, beads)
        curves["vignetting"] = list(zip(measured.radius.tolist(), measured.brightness.tolist(), strict=True))
        return [100 * measured.brightness[measure.MIN_RINGS - 1], 100 * measured.brightness.max()]

    at = (measure.MIN_RINGS - 0.5) / measure.RINGS
    return _or_why([(f"brightness at {at:.2f} radius", "%"), ("brightest ring", "%")], values)


def _ranges(real: ImageMeasurements, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Return the range of the twin's distortion over other tubes and poses; empty if the image shows none."""
    try:
        lattice = measure.lattice_of(real.beads)
    except NotMeasurableError:
        return {}
    assert real.beads is not None  # noqa: S101 - lattice_of refuses None
    noise_px = float(np.sqrt(np.median(np.trace(real.beads.covariance_px2, axis1=1, axis2=2)) / 2))
    draws = [_one_draw(real.image, lattice, noise_px, rng) for _ in range(DRAWS)]
    values: dict[str, list[float]] = {}
    for measurement in (f for draw in draws for f in draw if f.value is not None):
        values.setdefault(measurement.name, []).append(measurement.value or 0.0)
    return {name: tuple(np.percentile(v, RANGE).tolist()) for name, v in values.items()}


def _one_draw(image: Radiograph, lattice: Lattice, noise_px: float, rng: np.random.Generator) -> list[Measurement]:
    """Measure the distortion of the lattice on the input plane of another tube, from points without an image."""
    view = draw_setup(rng, Frame.load("gamma")).views[VIEW]
    centre, radius = measure.field_circle(image)
    scale = radius / view.chain.mask_px
    xy_mm = lattice_mm(view, lattice, lattice.pitch_px / scale)
    uv = centre + scale * (view.intensifier.to_image(xy_mm) - view.intensifier.centre_px)
    low, high = lattice.uv_px.min(axis=0), lattice.uv_px.max(axis=0)
    shown = ((uv > low) & (uv < high)).all(axis=1)
    column, row = np.rint(uv[shown]).astype(int).T
    kept = image.field_mask[row, column]
    points = uv[shown][kept]
    pitches = xy_mm[shown][kept] * view.intensifier.px_per_mm * scale / lattice.pitch_px
    noisy = points + noise_px * rng.standard_normal(points.shape)
    index = np.rint(pitches @ np.linalg.inv(lattice.axes)).astype(int)
    again = Lattice(np.arange(len(noisy)), noisy, index, lattice.axes, lattice.pitch_px)
    return _of_distortion(measure.distortion(again, centre, radius))


def differences(pair: Pair) -> Iterator[tuple[str, Measurement, Measurement, float | None]]:
    """Yield for each measurement: its name, the real one, the twin's, and the ratio twin / real if both are known."""
    for real, twin in zip(pair.real.measurements, pair.twin.measurements, strict=True):
        known = real.value is not None and twin.value is not None and abs(real.value) > 1e-9
        yield real.name, real, twin, (twin.value or 0.0) / (real.value or 1.0) if known else None


def plots(pairs: Sequence[Pair]) -> list[Plot]:
    """Plot the curves of all images: real ones solid, the twin's dashed, without curves that no real image shows."""
    drawn = (
        ("residual", "What a polynomial leaves", "degree", "rms residual, px", True),
        ("noise", "Noise against signal", "brightness over the median", "noise, % of the signal", True),
        ("correlation", "Correlation of the noise", "px apart", "correlation", False),
        ("vignetting", "Brightness over radius", "radius over the field's radius", "over the middle's", False),
    )
    drawings = []
    for name, title, across, up, log in drawn:
        least = 1e-3 if log else 0.0
        shown = [p for p in pairs if name in p.real.curves][:MAX_LEGEND]
        series = [
            PlotSeries(f"{p.name}{mark}", [PlotPoint(x, max(y, least)) for x, y in s.curves[name]], dashed, k)
            for k, p in enumerate(shown)
            for s, mark, dashed in ((p.real, "", False), (p.twin, ", twin", True))
            if name in s.curves
        ]
        if series:
            svg = xy(series, PlotAxis(across, log=name == "noise"), PlotAxis(up, log=log), title)
            drawings.append(Plot(title, svg, "Real images, and the twin's image of the same kind (dashed)."))
    return drawings


def document(pairs: Sequence[Pair], passed: Sequence[str], seed: int) -> dict[str, Any]:
    """Return all measurements and curves as JSON types, without pixels."""
    return {
        "seed": seed,
        "passed_over": list(passed),
        "images": [
            {
                "name": p.name,
                "twin_shows": p.like,
                "figures": [
                    {
                        "name": name,
                        "unit": real.unit,
                        "real": real.value,
                        "twin": twin.value,
                        "twin_over_real": ratio,
                        "real_not_measurable": real.why_not if real.value is None else None,
                        "twin_not_measurable": twin.why_not if twin.value is None else None,
                        "twin_range": p.ranges.get(name),
                    }
                    for name, real, twin, ratio in differences(p)
                ],
                "curves": {"real": p.real.curves, "twin": p.twin.curves},
            }
            for p in pairs
        ],
    }


def findings(pairs: Sequence[Pair]) -> list[str]:
    """Return sentences: how the twin differs in each measurement, over all images that show it, and which measurements
    no image shows."""
    known: dict[str, list[tuple[Measurement, Measurement]]] = {}
    for pair in pairs:
        for name, real, twin, _ in differences(pair):
            known.setdefault(name, []).append((real, twin))
    sentences = ["only one image: differences may be due to this image, not to the machine"] if len(pairs) == 1 else []
    for name, both in known.items():
        shown = [(r, t) for r, t in both if r.value is not None and t.value is not None]
        if not shown:
            sentences.append(f"{name}: not measurable in any image and its twin")
            continue
        real, twin = (np.median([f.value for f in side]) for side in zip(*shown, strict=True))
        unit = f" {shown[0][0].unit}".rstrip()
        ratio = f", {twin / real:.2f} times" if abs(real) > 1e-9 else ""
        many = "image" if len(shown) == 1 else "images"
        sentences.append(f"{name}: real {real:.3g}{unit}, twin {twin:.3g}{unit}{ratio} (median of {len(shown)} {many})")
    return sentences


VIEW = "pa"
# Of the twin's perforated plate on a detector: its thickness, and its centre's distance from the input plane [ours].
PLATE_THICKNESS_MM, PLATE_HEIGHT_MM = 1.0, 5.0
BALL_DEPTH = SOURCE_TO_HIP_MM / SOURCE_TO_DETECTOR_MM  # of the distance from the source to the input plane


def twin_of(image: Radiograph, beads: Detections | None, rng: np.random.Generator) -> tuple[str, Radiograph]:
    """Describe and render objects of the kind that the image seems to show, with the twin's default C-arm and dose."""
    setup = draw_setup(rng, Frame.load("gamma"))
    view = setup.views[VIEW]
    lattice = _lattice(beads)
    words = []
    scene = Scene()
    if beads is not None and lattice is not None:
        scene += _grid(view, beads, lattice, _scale(image, view))
        words.append("perforated steel plate" if beads.kind.count("hole") else "grid of steel balls")
    elif beads is not None and _has_balls(beads):
        scene += Scene(solids=_balls(view, image, beads))
        words.append("steel balls in the same places")
    if lattice is None and not open_beam(image, beads):
        scene += Scene(tissue=SoftTissue()) + hip_scene(setup, rng).bone
        words.append("a hip")
    return " before ".join(words) or "open beam", render(setup, VIEW, scene, rng)


def lattice_mm(view: ViewTruth, lattice: Lattice, pitch_px: float) -> np.ndarray:
    """Return the points (N, 2), detector coordinates, of a lattice of that kind and pitch over a little more than the
    field."""
    pitch = pitch_px / view.intensifier.px_per_mm
    reach = view.chain.field_mm / 2 + 2 * pitch
    count = int(2 * reach / pitch)
    index = np.stack(np.meshgrid(*2 * (np.arange(-count, count + 1),)), axis=-1).reshape(-1, 2)
    xy = pitch * index @ lattice.axes
    return xy[np.linalg.norm(xy, axis=1) < reach]


def _lattice(beads: Detections | None) -> Lattice | None:
    try:
        return lattice_of(beads)
    except NotMeasurableError:
        return None


def _has_balls(beads: Detections) -> bool:
    try:
        return len(usual_balls(beads)) > 0
    except NotMeasurableError:
        return False


def _scale(image: Radiograph, view: ViewTruth) -> float:
    """Return the scale from the image's pixels to the twin's, at equal field size."""
    return view.chain.mask_px / field_circle(image)[1]


def _grid(view: ViewTruth, beads: Detections, lattice: Lattice, scale: float) -> Scene:
    xy = lattice_mm(view, lattice, scale * lattice.pitch_px)
    centre = view.detector.to_space(xy) - PLATE_HEIGHT_MM * view.detector.normal
    radius = scale * float(np.median(beads.radius_px)) / view.intensifier.px_per_mm
    if "hole" not in beads.kind:
        return Scene(solids=tuple(Ball((x, y, z), radius, within=None) for x, y, z in centre.tolist()))
    a, b, c = view.detector.normal.tolist()
    # The twin cannot model air inside a plate, so holes are filled with polyethylene, which absorbs 2 % in 1 mm.
    filled: dict[str, Any] = {"hole_mm": 0.0, "within": "steel", "material": "polyethylene"}
    rods = tuple(Rod((x, y, z), (a, b, c), radius, PLATE_THICKNESS_MM / 2, **filled) for x, y, z in centre.tolist())
    half = np.array([view.chain.field_mm, view.chain.field_mm, PLATE_THICKNESS_MM / 2])
    middle = view.detector.to_space(np.zeros(2)) - PLATE_HEIGHT_MM * view.detector.normal
    return Scene(solids=rods, boxes=(Box(middle, view.detector.basis, half, material="steel"),))


def _balls(view: ViewTruth, image: Radiograph, beads: Detections) -> tuple[Solid, ...]:
    """Return balls whose shadows have the positions and sizes of those in the image."""
    scale, dark = _scale(image, view), beads.contrast < 0
    uv = view.intensifier.centre_px + scale * (beads.uv_px[dark] - field_circle(image)[0])
    seen = view.in_field(uv)
    on_detector = view.points_on_detector(uv[seen])
    places = view.focal_point_mm + BALL_DEPTH * (on_detector - view.focal_point_mm)
    per_mm = shadow_radius_px(view, places, np.ones(len(places)))
    radius = scale * beads.radius_px[dark][seen] / per_mm
    return tuple(Ball((x, y, z), r, within=None) for (x, y, z), r in zip(places.tolist(), radius.tolist(), strict=True))


def render_comparison(pairs: Sequence[Pair], passed: Sequence[str], folder: str, seed: int) -> str:
    """Return the page as HTML, with the images scaled to SHOWN_PX."""
    return page(
        "compare.html.j2",
        plots=plots(pairs),
        folder=folder,
        seed=seed,
        passed=passed,
        findings=findings(pairs),
        images=[_shown(pair) for pair in pairs],
    )


def _shown(pair: Pair) -> dict[str, Any]:
    rows, reasons = [], dict[str, list[str]]()
    for name, real, twin, ratio in differences(pair):
        for measured, whose in ((real, "real"), (twin, "twin")):
            if measured.value is None:
                reasons.setdefault(measured.why_not, []).append(f"{name} ({whose})")
        if real.value is not None or twin.value is not None:
            span = pair.ranges.get(name)
            between = "" if span is None else f"{span[0]:.3g} to {span[1]:.3g}"
            cells = ["not measurable" if measured.value is None else str(measured) for measured in (real, twin)]
            rows.append((name, *cells, "" if ratio is None else f"{ratio:.2f}", between))
    return {
        "name": pair.name,
        "real": _data_uri(pair.real.image),
        "twin": _data_uri(pair.twin.image),
        "like": pair.like,
        "rows": rows,
        "not_measurable": list(reasons.items()),
    }


def _data_uri(image: Radiograph) -> str:
    shown = grey(image)
    scale = min(1.0, SHOWN_PX / max(shown.shape))
    small = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return jpeg_uri(small)
