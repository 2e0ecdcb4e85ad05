"""Files of results: which form a result has, and what is checked of every file."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, overload

from pydantic import BaseModel

from sightline.calibration import BeadView, MatrixView
from sightline.calibration.exchange import reading
from sightline.calibration.exchange.formats import read_view
from sightline.calibration.exchange.reading import json_bytes
from sightline.calibration.maps.grid import GridMap
from sightline.calibration.view import CalibratedView
from sightline.case.canonical import plain
from sightline.case.interop.plan_file import sealed
from sightline.case.saved import documents, models
from sightline.common.atomic import write_whole
from sightline.common.bounded import MAX_JSON_BYTES, read_bounded
from sightline.common.strict import naming
from sightline.detection import Detections, Observations
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.planning import Plan, SpacePoints, Trajectory
from sightline.planning.bone.registered import RegisteredBone
from sightline.planning.check.result import CheckShot

_MAX_DEPTH = 12
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class _Form:
    """One kind of result: its class, the model of its file, and both ways between result and document."""

    kind: type
    model: type[BaseModel]
    written: Callable[[Any], dict[str, Any]]
    read: Callable[[dict[str, Any]], Any]


_FORMS = {
    "sightline-detections/1": _Form(Detections, models.SavedDetections, plain, documents.detections),
    "sightline-observations/1": _Form(Observations, models.SavedObservations, plain, documents.observations),
    "sightline-view/1": _Form(BeadView, models.SavedView, documents.view_written, documents.view),
    "sightline-matrix-view/1": _Form(
        MatrixView, models.SavedMatrixView, documents.matrix_written, documents.matrix_view
    ),
    "sightline-points/1": _Form(SpacePoints, models.SavedPoints, plain, documents.points),
    "sightline-trajectory/1": _Form(
        Trajectory, models.SavedTrajectory, documents.trajectory_written, documents.trajectory
    ),
    "sightline-plan/1": _Form(Plan, models.SavedPlan, documents.plan_written, documents.plan),
    "sightline-bone-pose/1": _Form(
        RegisteredBone, models.SavedBonePose, RegisteredBone.document, documents.registered_bone
    ),
    "sightline-grid-map/1": _Form(GridMap, models.SavedGridMap, documents.grid_written, documents.grid_map),
    "sightline-check-shot/1": _Form(CheckShot, models.SavedCheckShot, documents.shot_written, documents.shot),
}


def document(result: Any, **more: Any) -> dict[str, Any]:
    """Return a result as the JSON types of its file, with `more` keys. Raises UnusableInputError for other objects."""
    for schema, form in _FORMS.items():
        if isinstance(result, form.kind):
            return sealed(plain({"schema": schema, **form.written(result), **more}))
    known = ", ".join(form.kind.__name__ for form in _FORMS.values())
    raise UnusableInputError(f"a {type(result).__name__} cannot be saved; give a Frame or one of {known}")


def save(result: Any, path: str | Path) -> Path:
    """Write a result as JSON, whole or not at all, and return its path.

    `result`: Detections, Observations, a view, SpacePoints, a Trajectory, a Plan, a BonePose, a CheckShot, a GridMap or
    a Frame (whose file is that of docs/frame-file.md). The image that a result was found in is not saved.
    Raises UnusableInputError for other objects, and for a view that was not made by `calibrate` or `view_from_matrix`.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> sl.save(pa, "pa.json").name
    'pa.json'
    """
    if isinstance(result, Frame):
        result.save(path)
        return Path(path)
    return write_whole(path, json_bytes(document(result)))


@overload
def load(path: str | Path) -> Any: ...
@overload
def load(path: str | Path, kind: type[_Result]) -> _Result: ...
def load(path: str | Path, kind: type | None = None) -> Any:
    """Return the result in a file of `save`, or the list of results where the file holds a list.

    `kind`: the class that the result must be of, where given. Views and plans are computed again from what they were
    made from; the checks of a view are those of the file, as those of its image cannot be made again.
    Raises UnusableInputError for a file that is damaged, was edited, is of another form or another version, or whose
    result this version does not reach again.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> sl.load("out/demo/trajectory.json", sl.Trajectory).length_mm > 50
    True
    """
    file = Path(path)
    data = read_bounded(file, MAX_JSON_BYTES, UnusableInputError, "give a file that `save` wrote")
    with naming(file, "save the result again"):
        given = reading.json_value(data, _MAX_DEPTH)
        result = [_read(document) for document in given] if isinstance(given, list) else _read(given)
    if kind is not None and not isinstance(result, kind):
        raise UnusableInputError(f"{file.name} holds a {type(result).__name__}, not a {kind.__name__}")
    return result


_VIEW = re.compile(rb'"sightline-(matrix-)?view/')


def saved_views(file: Path) -> list[CalibratedView] | None:
    """Return the views in a JSON file of `save` or of `sightline demo`; None for other files.

    Raises UnusableInputError.
    """
    if file.suffix.lower() != ".json":
        return None
    if not _VIEW.search(read_bounded(file, MAX_JSON_BYTES, UnusableInputError, "give the file of a view")):
        return None
    saved = load(file)
    return saved if isinstance(saved, list) else [saved]


def add_view(view: CalibratedView, file: Path) -> list[str]:
    """Write a view into a file of views, in the place of an older one of its name or last; return all names.

    Raises UnusableInputError, also for a file that holds something else.
    """
    views = {each.name: each for each in saved_views(file) or ()} if file.exists() else {}
    if file.exists() and not views:
        raise UnusableInputError(f"{file.name} holds no views; name another file")
    views[view.name] = view
    write_whole(file, json_bytes([document(each) for each in views.values()]))
    return list(views)


def read_views(files: Sequence[Path]) -> list[CalibratedView]:
    """Return the views in files of `save`, or of other programs, one each (`sl.read_view`), in their order.

    Raises UnusableInputError, also where two have the same name.
    """
    views: list[CalibratedView] = []
    for file in files:
        saved = saved_views(file)
        views += [read_view(file).view()] if saved is None else saved
    names = [view.name for view in views]
    if len(set(names)) < len(names) or len(names) < 2:
        raise UnusableInputError(f"the views are {', '.join(names)}; give two or more of different names")
    return views


def _read(given: Any) -> Any:
    schema = given.get("schema") if isinstance(given, dict) else None
    if schema is None:
        raise UnusableInputError('it does not name its form in "schema"; give a file that `save` wrote')
    form = _FORMS.get(str(schema))
    if form is None:
        known = ", ".join(_FORMS)
        raise UnusableInputError(f"its form {str(schema)[:60]!r} is not one that this version reads: {known}")
    if given.get("digest") != sealed(given)["digest"]:
        raise UnusableInputError("it was changed after it was written: its digest differs; save the result again")
    form.model.model_validate(given)
    try:
        return form.read(given)
    except (KeyError, TypeError, ValueError) as error:
        raise UnusableInputError(f"its content is not that of {schema}: {error}; save the result again") from None
