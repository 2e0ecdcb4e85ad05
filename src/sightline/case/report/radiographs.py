"""Drawings of a radiograph with overlays: beads, triangles, picks, image-matching curves, the wire with its errors."""

import base64
from collections.abc import Iterable

import cv2
import numpy as np

from sightline.calibration import CalibratedView, Residuals
from sightline.case.report import svg
from sightline.common.geometry.covariance import ellipsoid_factor
from sightline.detection import RejectedCandidate
from sightline.imaging import Radiograph
from sightline.imaging.radiograph import stretched
from sightline.planning import Hole, MatchingCurve, Pick, Plan, Trajectory
from sightline.planning.nail.expected import rim

_JPEG_QUALITY = 82  # [ours] 1024² in about 150 kB; overlays are drawn over it, not burnt in
CLOSEUP_PX = 24.0  # [ours] half the side of a close-up: about 3 mm at the hip, so that half a pixel is seen


def grey(image: Radiograph) -> np.ndarray:
    """Return the image (H, W) as uint8 for display: log intensity, stretched over the field's unsaturated pixels."""
    log = np.log1p(np.clip(image.pixels.astype(np.float32), 0.0, None))
    shown = log[image.field_mask & (image.pixels < image.white)]
    return stretched(log, shown if shown.size else log)


def jpeg_uri(shown: np.ndarray) -> str:
    """Return a picture (H, W), as `grey` makes it, as the address of a JPEG that holds it."""
    _, jpeg = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()


def colour_map(values: np.ndarray, top: float) -> list[str]:
    """Return the colours of values from 0 to `top`: viridis, which is legible in grey and to colour-blind people."""
    steps = np.clip(np.asarray(values) / top * 255.0, 0, 255).astype(np.uint8).reshape(-1, 1)
    bgr = cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)
    return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in bgr]


def beads(residuals: Residuals, radius_px: np.ndarray, top_mm: float) -> str:
    """Draw rings (N,) coloured by residual, up to `top_mm`; the ring of a bead left out of the fit is dashed."""
    sizes = np.linalg.norm(residuals.residual_mm, axis=1)
    rings = []
    rows = zip(residuals.ids, residuals.uv_px, radius_px, sizes, residuals.used, colour_map(sizes, top_mm), strict=True)
    for name, (u, v), radius, size, used, colour in rows:
        hint = svg.hint(f"{name}: residual {size:.3f} mm{'' if used else ', left out of the fit'}")
        dash = None if used else "3 3"
        rings.append(svg.element("circle", hint, cx=u, cy=v, r=radius + 3.0, stroke=colour, stroke_dasharray=dash))
    return svg.group(rings, class_="beads")


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
            href=jpeg_uri(grey(image)),
            x=-0.5,
            y=-0.5,
            width=image.shape[1],
            height=image.shape[0],
        )
        for name, image in images.items()
    )
    return svg.element("svg", svg.element("defs", *parts), class_="sources", aria_hidden="true", width=0, height=0)


LABEL_EVERY_MM = 50.0  # [ours] depth between labelled ticks, every fifth: 250 px apart, so that no labels overlap
TICK_PX = 6.0
NAIL_MM, AXIS_MM = 25.0, 15.0  # drawn: of the nail to either side of a hole, of its axis beyond the nail [ours]
_DIFFERENCE_MM = 0.05  # step of the numerical derivative of a projection; its error is below 1e-4 of an ellipse


def curve(matching: MatchingCurve, name: str) -> str:
    """Draw a curve, its 95 % band if the error is known, a tick every 10 mm of depth and a label every 50 mm."""
    uv, across = matching.uv_px, matching.across_px
    parts = []
    if matching.half_width_px is not None:
        wide = matching.half_width_px[:, None] * across
        parts.append(
            svg.element("polygon", points=svg.points(np.vstack([uv + wide, (uv - wide)[::-1]])), class_="band")
        )
    parts.append(
        svg.element("polyline", svg.hint(f"image-matching curve of the {name}"), points=svg.points(uv), class_="curve")
    )
    for i in np.flatnonzero(matching.is_tick):
        long = np.isclose(matching.depth_mm[i] % LABEL_EVERY_MM, 0.0)
        (u1, v1), (u2, v2) = uv[i] - across[i] * TICK_PX * (1 + long), uv[i] + across[i] * TICK_PX * (1 + long)
        parts.append(svg.element("line", x1=u1, y1=v1, x2=u2, y2=v2, class_="tick"))
        if long:
            parts.append(svg.text(f"{matching.depth_mm[i]:.0f}", u2 + 4, v2 + 5, class_="depth"))
    return svg.group(parts)


def pick(chosen: Pick, name: str) -> str:
    """Draw a cross-hair that is open at the picked point."""
    u, v = chosen.uv_px
    path = f"M{u - 14:.2f} {v:.2f}h9m10 0h9M{u:.2f} {v - 14:.2f}v9m0 10v9"
    return svg.element("path", svg.hint(f"pick: {name}"), d=path, class_=f"pick {name}")


def landmarks(plan: Plan, k: int) -> str:
    """Draw the landmarks picked in view `k`: the pick, and a line to where all views together put the landmark.

    The line's hint states its length. It is drawn to scale, so a good one is hardly visible."""
    uv, residual = np.array(plan.arguments["landmarks_uv_px"])[k], plan.residuals_px[k, len(plan.picks) :]
    named = zip(uv, residual, plan.landmark_names, strict=True)
    parts = []
    for n, ((u, v), (du, dv), name) in enumerate(named, 1):
        if np.isfinite([u, du]).all():
            hint = svg.hint(f"{name or f'landmark {n}'}: {np.hypot(du, dv):.2f} px from its projection")
            parts.append(svg.element("circle", hint, cx=u, cy=v, r=6.0))
            parts.append(svg.element("line", x1=u, y1=v, x2=u - du, y2=v - dv))
    return svg.group(parts, class_="landmarks")


def truth(uv_px: np.ndarray) -> str:
    """Draw small circles at the true points (N, 2)."""
    circles = (svg.element("circle", svg.hint("truth"), cx=float(u), cy=float(v), r=4.0) for u, v in uv_px)
    return svg.group(circles, class_="truth")


def nail_hole(view: CalibratedView, hole: Hole) -> str:
    """Draw the nail's edges beside a measured hole, both rims of the hole, and its axis to both sides of the nail."""
    along, axis, radius = hole.nail_direction, hole.direction, hole.nail.diameter_mm / 2
    sideways = np.cross(along, hole.nail_mm - view.focal_point_mm)
    sideways *= radius / np.linalg.norm(sideways)
    ahead = np.linspace(-NAIL_MM, NAIL_MM, 9)[:, None] * along
    lines = [("edge of the nail", hole.nail_mm + side * sideways + ahead) for side in (-1.0, 1.0)]
    lines += [("rim of the hole", rim(hole.pose, hole.nail, side)[0][np.r_[:30, 0]]) for side in (-1.0, 1.0)]
    lines.append(("axis of the hole", np.stack([hole.entry_mm - AXIS_MM * axis, hole.exit_mm + AXIS_MM * axis])))
    shown = ((name, view.project_seen(xyz)[0]) for name, xyz in lines)
    parts = (svg.element("polyline", svg.hint(name), points=svg.points(uv)) for name, uv in shown if len(uv))
    return svg.group(list(parts), class_="nail")


def _ellipse(view: CalibratedView, xyz_mm: np.ndarray, covariance_mm2: np.ndarray) -> str:
    """Draw the 95 % ellipse of a point's projection: the error of the point, with the view taken as exact."""
    steps = xyz_mm + _DIFFERENCE_MM * np.vstack([np.eye(3), -np.eye(3)])
    ahead, back = np.split(view.project(steps), 2)
    jacobian = (ahead - back).T / (2 * _DIFFERENCE_MM)
    values, vectors = np.linalg.eigh(jacobian @ covariance_mm2 @ jacobian.T)
    rx, ry = np.sqrt(np.clip(values, 0.0, None)) * ellipsoid_factor(0.95, 2)
    u, v = view.project(xyz_mm[None])[0]
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    shape = {"cx": float(u), "cy": float(v), "rx": float(rx), "ry": float(ry)}
    return svg.element("ellipse", **shape, transform=f"rotate({angle:.1f} {u:.2f} {v:.2f})", class_="ellipse")


def wire(view: CalibratedView, trajectory: Trajectory) -> str:
    """Draw the planned wire with the image's distortion, and its 95 % ellipses if the error is known."""
    along = np.linspace(0.0, 1.0, 25)[:, None]
    path = view.project((1 - along) * trajectory.entry_mm + along * trajectory.end_mm)
    parts = [svg.element("polyline", svg.hint("planned wire"), points=svg.points(path), class_="wire")]
    if trajectory.error_stated:
        pairs = zip(trajectory.points.xyz_mm, trajectory.points.covariance_mm2, strict=True)
        parts += [_ellipse(view, xyz, covariance) for xyz, covariance in pairs]
    return svg.group(parts)
