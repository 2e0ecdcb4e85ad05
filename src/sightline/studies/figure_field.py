"""Drawing of a displaced pattern of holes, as in the paper's figure 13: hollow before, filled after."""

import numpy as np

from sightline.case.report.drawing import svg

SIZE, RIM, HOLE = 560.0, 14.0, 4.0


def field(before_mm: np.ndarray, after_mm: np.ndarray, radius_mm: float, description: str) -> str:
    """Draw holes at `before_mm` and `after_mm` (N, 2), y down, on a round field; the first is the centre hole."""
    scale = (SIZE / 2 - RIM) / radius_mm
    middle = SIZE / 2
    parts = [svg.element("circle", cx=middle, cy=middle, r=scale * radius_mm, class_="grid", fill="none")]
    for k, (a, b) in enumerate(zip(middle + scale * before_mm, middle + scale * after_mm, strict=True)):
        moved = float(np.linalg.norm(after_mm[k] - before_mm[k]))
        hint = svg.hint(f"{'centre hole' if k == 0 else 'hole'}: moved by {moved:.2f} mm")
        colour = "picks" if k == 0 else "beads"
        (x1, y1), (x2, y2) = a.tolist(), b.tolist()
        parts.append(svg.element("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=f"series line-{colour}"))
        parts.append(svg.element("circle", cx=x1, cy=y1, r=HOLE, fill="none", class_=f"series line-{colour}"))
        parts.append(svg.element("circle", hint, cx=x2, cy=y2, r=HOLE, class_=f"source-{colour}"))
    return svg.figure((0, 0, SIZE, SIZE), description, parts, class_="field")
