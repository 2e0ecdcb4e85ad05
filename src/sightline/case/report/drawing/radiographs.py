"""Drawings of a radiograph with overlays: beads, triangles, image-matching curves, the wire."""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sightline.case.report.drawing import svg
from sightline.detection import RejectedCandidate
from sightline.imaging import Radiograph

JPEG_QUALITY = 82  # [ours] 1024² in about 150 kB; overlays are drawn over it, not burnt in
CLOSEUP_PX = 24.0  # half the side of a close-up: about 3 mm at the hip [ours]
STRETCH = (0.5, 99.5)  # percentiles of the pixels inside the field that become black and white [ours]


def grey(image: Radiograph) -> np.ndarray:
    """Return the image (H, W) as uint8 for display: log intensity, stretched over the field's unsaturated pixels."""
    log = np.log1p(np.clip(image.pixels.astype(np.float32), 0.0, None))
    shown = log[image.field_mask & (image.pixels < image.white)]
    low, high = np.percentile(shown if shown.size else log, STRETCH)
    return np.clip((log - low) / max(high - low, 1e-6) * 255.0, 0.0, 255.0).astype(np.uint8)


def _data_uri(image: Radiograph) -> str:
    _, jpeg = cv2.imencode(".jpg", grey(image), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()


def colour_map(values: np.ndarray, top: float) -> list[str]:
    """Return the colours of values from 0 to `top`: viridis, which is legible in grey and to colour-blind people."""
    steps = np.clip(np.asarray(values) / top * 255.0, 0, 255).astype(np.uint8).reshape(-1, 1)
    bgr = cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)
    return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in bgr]


@dataclass(frozen=True)
class MarkedBead:
    """A bead to draw: its residual in mm on the reference plane, and whether the fit used it."""

    id: str
    uv_px: tuple[float, float]
    radius_px: float
    residual_mm: float
    used: bool


def _ring(bead: MarkedBead, colour: str) -> str:
    u, v = bead.uv_px
    says = svg.hint(f"{bead.id}: residual {bead.residual_mm:.3f} mm{'' if bead.used else ', left out of the fit'}")
    dash = None if bead.used else "3 3"
    return svg.element("circle", says, cx=u, cy=v, r=bead.radius_px + 3.0, stroke=colour, stroke_dasharray=dash)


def beads(marked: Sequence[MarkedBead], top_mm: float) -> str:
    """Draw rings coloured by residual; the ring of a bead left out of the fit is dashed."""
    colours = colour_map(np.array([m.residual_mm for m in marked]), top_mm)
    return svg.group(
        (_ring(m, colour) for m, colour in zip(marked, colours, strict=True)),
        class_="beads",
    )


def rejected(candidates: Iterable[RejectedCandidate]) -> str:
    """Draw dots at rejected candidates, with the reason as a hint."""
    return svg.group(
        (
            svg.element("circle", svg.hint(f"not a bead: {c.reason}"), cx=c.uv_px[0], cy=c.uv_px[1], r=2.5)
            for c in candidates
        ),
        class_="rejected",
    )


def triangles(corners_px: np.ndarray, bounding_px: np.ndarray) -> str:
    """Draw the triangles (T, 3, 2) of the localized method and, filled, those (N, 3, 2) around the picks."""
    thin = (svg.element("polygon", points=svg.points(t)) for t in corners_px)
    filled = (svg.element("polygon", points=svg.points(t), class_="bounding") for t in bounding_px)
    return svg.group([*thin, *filled], class_="triangles")


def radiograph(image: Radiograph, name: str, overlays: Iterable[str], description: str) -> str:
    """Draw an image with overlays, cut to the field of view; `sources` holds its pixels."""
    rows, columns = np.nonzero(image.field_mask)
    height, width = image.shape
    left, right, top, bottom = 0, width - 1, 0, height - 1
    if len(rows):
        left, right, top, bottom = columns.min(), columns.max(), rows.min(), rows.max()
    # Pixel (0, 0) is the centre of the top-left pixel, so the image starts half a pixel before it.
    box = (left - 0.5, top - 0.5, right - left + 1.0, bottom - top + 1.0)
    return svg.figure(box, description, [_pixels(name), *overlays], class_="radiograph")


def closeup(name: str, uv_px: np.ndarray, overlays: Iterable[str], description: str) -> str:
    """Draw the neighbourhood of one pixel, magnified; `sources` holds its pixels."""
    box = (uv_px[0] - CLOSEUP_PX, uv_px[1] - CLOSEUP_PX, 2 * CLOSEUP_PX, 2 * CLOSEUP_PX)
    return svg.figure(box, description, [_pixels(name), *overlays], class_="radiograph near")


def _pixels(name: str) -> str:
    return svg.element("use", href=f"#radiograph-{name}")


def sources(images: dict[str, Radiograph]) -> str:
    """Return the pixels of the images, which all figures of a page share."""
    parts = (
        svg.element(
            "image",
            id=f"radiograph-{name}",
            href=_data_uri(image),
            x=-0.5,
            y=-0.5,
            width=image.shape[1],
            height=image.shape[0],
        )
        for name, image in images.items()
    )
    return svg.element("svg", svg.element("defs", *parts), class_="sources", aria_hidden="true", width=0, height=0)
