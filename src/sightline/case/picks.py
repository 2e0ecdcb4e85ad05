"""What a person picks and draws in the images of a plan or of a check shot, as one file, and the plan asked for by it.

`sightline plan` and `check-shot` take the file as --picks; `plan --out` writes one.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sightline.case.contents import Images, PlanRequest
from sightline.case.views import ALL_NAMES, CHECK_NAMES, NAMES
from sightline.common.bounded import MAX_JSON_BYTES, read_bounded
from sightline.common.strict import naming, read_strictly
from sightline.errors import UnusableInputError
from sightline.from_images.head_and_shaft import fit_head, fit_shaft, refuse_tables
from sightline.from_images.interlocking import NailDrawn
from sightline.from_images.neck import fit_neck
from sightline.from_images.pipeline import find_placed_wires
from sightline.planning import Aids, Circle, Nail, Procedure, WirePicks, kind, propose_wires
from sightline.planning.check.wires import PlacedWire
from sightline.planning.nail.files import known_nails, nail_of
from sightline.planning.procedures.document import ProcedureDocument, Strict
from sightline.planning.procedures.procedure import ADVICE, document_of, keeping

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0)]
Pixel = tuple[Number, Number]
View = Literal["pa", "lateral"]
VIEWS: tuple[View, View] = ("pa", "lateral")
End = Literal["entry", "end"]
ENDS: tuple[End, End] = ("entry", "end")
Text = Annotated[str, Field(max_length=200)]
MIN_WIRE_POINTS = 5  # four on the centre line, and the tip
_ADVICE = {**ADVICE, "extra_forbidden": "is not a key of a file of picks; correct its spelling or remove it"}


class PickedPlace(Strict):
    """A point in the images that show it, px."""

    pa: Pixel | None = None
    lateral: Pixel | None = None
    oblique: Pixel | None = None
    check_pa: Annotated[Pixel | None, Field(alias="check-pa")] = None
    check_lateral: Annotated[Pixel | None, Field(alias="check-lateral")] = None

    def uv_px(self, images: Sequence[str]) -> np.ndarray:
        """Return the pixels (V, 2) in these images, NaN where it is not picked."""
        places = [getattr(self, image.replace("-", "_")) for image in images]
        return np.array([(np.nan, np.nan) if place is None else place for place in places])

    @staticmethod
    def of(uv_px: np.ndarray) -> "PickedPlace":
        """Return the place of pixels (V, 2) in PA, lateral and any oblique image."""
        shown = {name: tuple(uv.tolist()) for name, uv in zip(ALL_NAMES, uv_px, strict=False) if np.isfinite(uv).all()}
        return PickedPlace.model_validate(shown)


class Landmark(PickedPlace):
    """A point of the bone. `name`: its key in the procedure; "" for a point that only shows whether the patient moved.

    In the images of a plan it is picked in two of them or more; in those of a check shot in both, and in PA and lateral
    too unless the plan has a landmark of this name.
    """

    name: Text = ""

    @model_validator(mode="after")
    def _in_two_images(self) -> Self:
        if self.check_pa is None and self.check_lateral is None:
            if np.isfinite(self.uv_px(ALL_NAMES)[:, 0]).sum() < len(NAMES):
                raise ValueError("needs its pixels in two images: pa, lateral, oblique")
        elif None in (self.check_pa, self.check_lateral) or (self.pa is None) != (self.lateral is None):
            raise ValueError("needs its pixels in check-pa and check-lateral, and in pa and lateral or neither")
        return self


class PickedWire(Strict):
    """Entry and end, the tip, of a wire. `snapped`: which of them have their lateral pixel moved to its curve."""

    entry: PickedPlace
    end: PickedPlace
    snapped: tuple[End, ...] = ()

    @model_validator(mode="after")
    def _both_views(self) -> Self:
        if not all(np.isfinite(place.uv_px(NAMES)).all() for place in (self.entry, self.end)):
            raise ValueError("needs entry and end, each with its pixel in pa and lateral")
        return self

    def picks(self, views: int) -> WirePicks:
        """Return the picks of the wire on this number of views."""
        images = ALL_NAMES[:views]
        each = ["entry" in self.snapped, "end" in self.snapped]
        return WirePicks(self.entry.uv_px(images), self.end.uv_px(images), each if len(set(each)) > 1 else each[0])

    @staticmethod
    def of(picks: WirePicks) -> "PickedWire":
        """Return the wire of picks."""
        each = [picks.snapped] * 2 if isinstance(picks.snapped, bool) else picks.snapped
        snapped: tuple[End, ...] = tuple(name for name, is_snapped in zip(ENDS, each, strict=True) if is_snapped)
        entry, end = (PickedPlace.of(np.asarray(uv)) for uv in (picks.entry_uv_px, picks.end_uv_px))
        return PickedWire(entry=entry, end=end, snapped=snapped)


class NailSizes(Strict):
    """A nail as its maker states it, mm."""

    diameter_mm: Positive
    hole_mm: Positive
    bore_mm: Annotated[float, Field(allow_inf_nan=False, ge=0)]
    material: Literal["titanium", "steel"]
    spacing_mm: Positive | None = None


class NailPicked(Strict):
    """A nail whose holes are planned.

    `nail`: its sizes, a nail's file, or the key of a shipped one. `edges`: in each view two clicks on one edge that
    reach past the holes, then two on the other. `holes`: by the key of its wire one click in each hole.
    """

    nail: NailSizes | Text
    edges: dict[View, tuple[Pixel, Pixel, Pixel, Pixel]]
    holes: dict[Text, PickedPlace]

    @model_validator(mode="after")
    def _both_views(self) -> Self:
        if self.edges.keys() != set(NAMES) or not self.holes:
            raise ValueError("needs its edges in pa and lateral, and a hole")
        if not all(np.isfinite(hole.uv_px(NAMES)).all() for hole in self.holes.values()):
            raise ValueError("needs each hole's pixel in pa and lateral")
        return self

    def drawn(self, drilled: Sequence[str]) -> NailDrawn:
        """Return the nail as drawn. Raises UnusableInputError."""
        nail = Nail(**self.nail.model_dump()) if isinstance(self.nail, NailSizes) else nail_of(self.nail)
        if nail is None:
            raise UnusableInputError(
                f"{self.nail!r} is not a nail's file; give one, or one of {', '.join(known_nails())}"
            )
        if not set(drilled) < self.holes.keys():
            raise UnusableInputError("in_bone names holes that are not clicked, or all of them; leave one to plan")
        strokes = np.reshape([self.edges[view] for view in VIEWS], (2, 2, 2, 2))
        clicks = {key: hole.uv_px(NAMES) for key, hole in self.holes.items()}
        return NailDrawn(nail, strokes, clicks, tuple(drilled))


class Picks(Strict):
    """What is picked and drawn in images, px.

    `wires`: by their keys in the procedure. `in_bone`: keys of wires, or of a nail's holes, that are in the bone
    already. `head`: circles over the femoral head, centre and radius. `aids`: clicks by the key of an aid. `fit`: the
    aids that are fitted to the edges in the images. `mirrored`: views whose image is shown mirrored. `wire_points`: on
    the inserted wire in both check images, the tip last, where it is not to be found by itself.
    """

    schema_: Annotated[Literal["sightline-picks/1"], Field(alias="schema")] = "sightline-picks/1"
    wires: dict[Text, PickedWire] = Field(default_factory=dict)
    in_bone: tuple[Text, ...] = ()
    landmarks: tuple[Landmark, ...] = ()
    head: dict[View, tuple[Number, Number, Positive]] | None = None
    aids: dict[Text, dict[View, tuple[Pixel, ...]]] = Field(default_factory=dict)
    fit: tuple[Literal["head", "shaft", "neck"], ...] = ()
    nail: NailPicked | None = None
    pick_sd_px: Positive = 0.5
    mirrored: tuple[Text, ...] = ()
    wire_points: dict[Literal["check-pa", "check-lateral"], tuple[Pixel, ...]] | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.head is not None and len(self.head) < len(NAMES):
            raise ValueError("head needs a circle in pa and lateral")
        if self.nail is not None and self.wires:
            raise ValueError("the holes of a nail are planned from their clicks; leave wires out")
        counts = {len(points) for points in (self.wire_points or {}).values()}
        if self.wire_points is not None and (
            len(self.wire_points) < len(CHECK_NAMES) or len(counts) > 1 or min(counts) < MIN_WIRE_POINTS
        ):
            raise ValueError(f"wire_points needs {MIN_WIRE_POINTS} points or more in each check image, as many in both")
        return self

    @staticmethod
    def read(file: Path) -> "Picks":
        """Read a file of picks. Raises UnusableInputError."""
        with naming(file):
            text = read_bounded(file, MAX_JSON_BYTES, UnusableInputError, "give a file of picks (docs/planning.md)")
            return read_strictly(text, Picks, UnusableInputError, _ADVICE)

    @property
    def text(self) -> str:
        """The content of its file."""
        content = self.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        return json.dumps({"schema": self.schema_, **content}, indent=1) + "\n"

    @property
    def in_oblique(self) -> bool:
        """Whether a point is picked in a third image."""
        ends = chain.from_iterable((wire.entry, wire.end) for wire in self.wires.values())
        return any(place.oblique is not None for place in (*ends, *self.landmarks))

    def landmarks_px(self, images: Sequence[str]) -> np.ndarray:
        """Return the pixels (V, L, 2) of the landmarks in these images, NaN where one is not picked."""
        return np.reshape([mark.uv_px(images) for mark in self.landmarks], (-1, len(images), 2)).swapaxes(0, 1)

    @property
    def wire_uv_px(self) -> np.ndarray | None:
        """(2, M, 2): the points on the inserted wire in both check images."""
        return None if self.wire_points is None else np.array([self.wire_points[name] for name in CHECK_NAMES])  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True, eq=False)
class AskedPlan:
    """The plan that picks ask for: its `request`, the picks with what was proposed, and sentences on these proposals
    and on aids that could not be fitted, those by "head_not_fitted", "shaft_not_fitted" and "neck_not_fitted"."""

    request: PlanRequest
    picks: Picks
    proposals: tuple[str, ...]
    unfitted: Mapping[str, list[str]]


def wires_of(procedure: str) -> tuple[str, ...]:
    """Return the keys of a procedure's wires in the order of drilling; of KEY:WIRE that of the wire.

    Raises UnusableInputError.
    """
    known = _alone(procedure)
    return document_of(procedure).drilling_order if known is None else (known.wire.key,)


def _alone(procedure: str) -> Procedure | None:
    """Return the procedure of the only wire to be planned; None where several are planned together."""
    of_one = ":" in procedure and not Path(procedure).is_file()
    return kind(procedure) if of_one or len(document_of(procedure).wires) == 1 else None


def refuse_unusable(picks: Picks, procedure: str, *, propose: bool) -> None:
    """Raise UnusableInputError for picks that `ask_plan` refuses whatever the images show."""
    if picks.nail is not None:
        picks.nail.drawn(picks.in_bone)
    _missing(picks, wires_of(procedure), procedure, propose=propose)


def ask_plan(picks: Picks, images: Images, procedure: str, side: str | None, *, propose: bool) -> AskedPlan:
    """Return the plan that picks in calibrated images ask for. `propose`: the wires that are not picked, by the
    procedure's rule.

    Raises UnusableInputError, and what `find_placed_wires` and `propose_wires` raise.
    """
    views = [image.view for image in images]
    alone, order = _alone(procedure), wires_of(procedure)
    nail = None if picks.nail is None else picks.nail.drawn(picks.in_bone)
    missing = _missing(picks, order, procedure, propose=propose)
    picked = {key: wire.picks(len(views)) for key, wire in picks.wires.items()}
    if nail is not None:
        clicks = {key: uv for key, uv in nail.clicks_px.items() if key not in picks.in_bone}
        picked = {key: WirePicks(uv, uv) for key, uv in clicks.items()}
    first = next(key for key in (*picked, *missing) if key not in picks.in_bone)
    known = alone or Procedure.of(document_of(procedure), first)
    placed = {} if nail is not None else _placed(picks, picked, images, known.document)
    picked = {key: picks for key, picks in picked.items() if key not in placed}
    aids, unfitted = _fitted(picks, _drawn(picks, known), images)
    proposals = propose_wires(views, known.document, aids or Aids(), side, picked) if missing else {}
    picked |= {key: WirePicks.of_proposal(proposals[key]) for key in missing}
    own = picked[first]
    request = PlanRequest(
        np.asarray(own.entry_uv_px),
        np.asarray(own.end_uv_px),
        pick_sd_px=picks.pick_sd_px,
        snapped=own.snapped,
        landmarks_uv_px=picks.landmarks_px(ALL_NAMES[: len(views)]),
        landmark_names=tuple(mark.name for mark in picks.landmarks),
        kind=known.key,
        procedure=keeping(known),
        side=side,
        aids=aids,
        others=None if alone else {key: picks for key, picks in picked.items() if key != first},
        placed=placed or None,
        nail=nail,
    )
    wires = picks.wires | {key: PickedWire.of(picked[key]) for key in missing}
    sentences = tuple(f"{'' if alone else key} {proposals[key].sentence}".strip() for key in missing)
    return AskedPlan(request, picks.model_copy(update={"wires": wires}), sentences, unfitted)


def _missing(picks: Picks, order: Sequence[str], procedure: str, *, propose: bool) -> tuple[str, ...]:
    """Return the wires to propose. Raises UnusableInputError for unknown wires, for none, and for none to propose."""
    given = picks.wires if picks.nail is None else picks.nail.holes
    if unknown := sorted({*given, *picks.in_bone} - set(order)):
        raise UnusableInputError(f"{procedure} has no wire {unknown[0]!r}; its wires are {', '.join(order)}")
    if not set(picks.in_bone) <= given.keys():
        raise UnusableInputError(f"in_bone names {', '.join(picks.in_bone)}; give entry and end of each, too")
    missing = tuple(key for key in order if key not in given) if propose else ()
    if propose and (not missing or picks.nail is not None):
        raise UnusableInputError("all wires have entry and end; leave --propose out")
    if not missing and given.keys() == set(picks.in_bone):
        raise UnusableInputError(
            "no wire is picked: give --entry and --end, or entries and ends or the holes of a nail in --picks, or "
            "--propose"
        )
    return missing


def _placed(
    picks: Picks, picked: Mapping[str, WirePicks], images: Images, procedure: ProcedureDocument
) -> dict[str, PlacedWire]:
    """Return the wires that are in the bone already, found in the images."""
    if not picks.in_bone:
        return {}
    each = [(image.seen.image, image.seen.beads, image.view) for image in images]
    seen = [(image, beads, view) for image, beads, view in each if image is not None and beads is not None]
    if len(seen) < len(each):
        raise UnusableInputError("a placed wire is found in images; a table of beads shows no wire")
    ends = {key: (picked[key].entry_uv_px, picked[key].end_uv_px) for key in picks.in_bone}
    clicked = {key: np.array(both).swapaxes(0, 1)[:2] for key, both in ends.items()}
    return find_placed_wires(seen, clicked, {wire.key: wire.diameter_mm for wire in procedure.wires})


def _drawn(picks: Picks, known: Procedure) -> Aids | None:
    """Return what is drawn, None for nothing. Raises UnusableInputError for an aid that the procedure does not have."""
    types = {aid.key: aid.type for aid in known.aids}
    if unknown := sorted(picks.aids.keys() - types.keys()):
        raise UnusableInputError(f"{known.key} has no aid {unknown[0]!r}; choose one of {', '.join(types)}")
    if picks.head is None and not picks.aids:
        return None
    clicked = {key: [each.get(view) for view in VIEWS] for key, each in picks.aids.items()}
    uv = {key: [None if each is None else np.array(each) for each in both] for key, both in clicked.items()}
    aids = Aids.clicked(types, uv, picks.pick_sd_px)
    if picks.head is None:
        return aids
    circles = [picks.head[view] for view in VIEWS]
    first, second = (Circle.of(circle[:2], circle[2], picks.pick_sd_px) for circle in circles)
    return replace(aids, head=(first, second))


_BORDERS = "two clicks on each border in each image"
_NEEDS = {
    "head": (fit_head, ("head",), "draw the head"),
    "shaft": (fit_shaft, ("shaft",), f"draw the shaft: {_BORDERS}"),
    "neck": (
        fit_neck,
        ("neck", "head"),
        f"draw the head, and the neck from the head past the narrowest place: {_BORDERS}",
    ),
}


def _fitted(picks: Picks, aids: Aids | None, images: Images) -> tuple[Aids | None, dict[str, list[str]]]:
    """Return the aids with those of `fit` fitted to the edges, and sentences on the images in which one could not be.

    Raises UnusableInputError where there is nothing to fit, or no image.
    """
    views, unfitted = [image.view for image in images], {}
    for key in sorted(picks.fit, key=list(_NEEDS).index):  # the neck begins at the fitted head
        fit, needed, advice = _NEEDS[key]
        drawn: list[Any] = [getattr(aids, name) for name in needed] if aids is not None else [None]
        if aids is None or None in drawn:
            raise UnusableInputError(f"fit names the {key}, which is not drawn; {advice}")
        shown = refuse_tables([image.seen.image for image in images])
        lines, kept = fit(views, shown, *drawn)
        aids = replace(aids, **{key: lines})
        unfitted[f"{key}_not_fitted"] = [f"{view} image: {key} kept as drawn; {why}" for view, why in kept.items()]
    return aids, unfitted
