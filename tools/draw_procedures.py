"""Draw the pictures of the procedures' pages: both views of a demo with its planned wires, landmarks and aids.

`sightline demo --procedure KEY --out out/KEY` for each KEY, then `python tools/draw_procedures.py out/KEY ...` writes
docs/pictures/procedure-KEY.jpg.
"""

import sys
from contextlib import suppress
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from sightline.app.plan.decisions import Decisions
from sightline.case.journal import Case, Kind
from sightline.case.report.content import Report, report_of
from sightline.case.report.radiographs import grey
from sightline.case.views import CalibratedImage
from sightline.errors import OutsideRegionError

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
MIDDLE = 0.45  # grey of the median pixel: a panel's images are pale
WIRE, MARK, AID = "#f0e442", "#56b4e9", "#ff8c42"


def draw(folder: Path) -> Path:
    """Write the picture of a demo's folder, and return it."""
    with Case.open(folder / "case", read_only=True) as case:
        report = report_of(case)
        edit = case.latest(Kind.CHANGED, where={"what": "edit"})
        decided = Decisions.of(edit.content["to"] if edit else {})
    figure, panels = plt.subplots(1, 2, figsize=(12, 6.3))
    for panel, image in zip(panels, report.images, strict=True):
        _view(panel, report, image, decided)
    panels[0].legend(loc="lower left", fontsize=9, framealpha=0.7)
    figure.tight_layout()
    path = PICTURES / f"procedure-{report.plan.kind.document.key}.jpg"
    figure.savefig(path, dpi=100, pil_kwargs={"quality": 82})
    plt.close(figure)
    return path


def _view(panel: Axes, report: Report, image: CalibratedImage, decided: Decisions) -> None:
    """Draw one view."""
    assert image.seen.image is not None  # noqa: S101 - a demo has images
    shown = grey(image.seen.image).astype(np.float64)
    shown /= shown.max()
    panel.imshow(shown ** (np.log(MIDDLE) / np.log(np.median(shown[shown > 0]))), cmap="gray")
    panel.set(title=f"{report.spoken(image.name)} view", xticks=[], yticks=[])
    for name, colour, label in (("landmark-", MARK, "landmarks"), ("", AID, "drawn")):
        marks = {key: mark for key, mark in decided.marks.items() if key not in ("entry", "end")}
        uv = [mark.at(image.name) for key, mark in marks.items() if key.startswith("landmark-") is bool(name)]
        at = np.array([one for one in uv if one is not None]).reshape(-1, 2)
        panel.plot(*at.T, "+" if name else "x", color=colour, markersize=9, label=label if len(at) else None)
    plans = [report.plan] if report.wires is None else report.wires.plans.values()
    for k, plan in enumerate(plans):
        along = np.linspace(plan.trajectory.entry_mm, plan.trajectory.end_mm, 31)
        with suppress(OutsideRegionError):
            uv = image.view.project(along)
            panel.plot(*uv.T, color=WIRE, linewidth=1.6, label=None if k else "planned wire, entry ringed")
            panel.plot(*uv[0], "o", color=WIRE, markerfacecolor="none", markersize=9)


if __name__ == "__main__":
    for each in sys.argv[1:]:
        print(draw(Path(each)))
