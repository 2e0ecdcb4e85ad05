"""A calibration frame as data: its plates or its solid, and how well their beads are known. CFCS, mm."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from scipy.linalg import block_diag

from sightline.common.atomic import write_whole
from sightline.common.geometry.rigid import rigid_fit
from sightline.common.show import Plotted
from sightline.errors import FrameError, UnusableInputError
from sightline.frame.designs import (
    BUILTIN,
    DETECTOR_PLATE,
    FRAME_NAMES,
    SOLIDS,
    WITH_PLATE,
    FrameDesign,
    builtin_design,
    views_of,
)
from sightline.frame.plate import ROLES, Fiducial, FrameView, Plate, RigidBody
from sightline.frame.tolerances import InUse, Tolerances, error_factor

if TYPE_CHECKING:
    from sightline.frame.document import FrameDocument

# Reading is imported where it is done: its schema takes 0.1 s, which the built-in frames need not wait for.
_MAX_VIEWS = 6  # of a summary
_Body = TypeVar("_Body", bound=RigidBody)


@dataclass(frozen=True, eq=False, repr=False)
class Frame(Plotted):
    """A calibration frame: two plates for each of its `views`, or one `solid` that every image shows.

    `detector`: with a solid, a plate on the detector of an image intensifier, or None. Every image shows it; it tells
    the distortion alone. Its coordinates are not CFCS but its own: origin in the middle of the detector's input plane,
    z towards the X-ray source, mm. Its pose against the solid is estimated for each image.

    `tolerances` is None where the file states none: then `effective_tolerances` are the defaults, and reports say so.
    `covariance_mm2` (3M, 3M), or None: full covariance of all bead coordinates, views in file order, in each
    view XRII before source; it replaces the tolerances. `in_use`: handling errors added to either, or None.

    >>> frame = sl.Frame.load("gamma")  # or "biplane", "stereo", "block60", or a file of yours
    >>> list(frame.views)
    ['pa', 'lateral']
    """

    name: str
    views: dict[str, FrameView]
    serial: str | None = None
    measured_on: str | None = None
    temperature_c: float | None = None
    tolerances: Tolerances | None = None
    covariance_mm2: np.ndarray | None = None
    in_use: InUse | None = None
    solid: RigidBody | None = None
    detector: Plate | None = None

    def summary(self) -> str:
        """Return name, serial, the beads of each plate, and how well they are known."""
        lines = [f"Frame {self.name}" + ("" if self.serial is None else f", serial {self.serial}")]
        for name, view in list(self.views.items())[:_MAX_VIEWS]:
            xrii, source = len(view.xrii.fiducials), len(view.source.fiducials)
            lines.append(f"  view {name}: {xrii} beads on the XRII plate, {source} on the source plate")
        lines += [f"  ... and {len(self.views) - _MAX_VIEWS} views more"] if len(self.views) > _MAX_VIEWS else []
        sd = self.effective_tolerances
        if self.solid is None:
            known = f"s.d. of a bead {sd.bead_mm:g} mm on its plate, of a plate {sd.plate_mm:g} mm and "
            known += f"{sd.plate_rad:g} rad"
        else:
            lines.append(f"  a solid of {len(self.solid.fiducials)} beads, seen in every image")
            if self.detector is not None:
                lines.append(f"  a plate of {len(self.detector.fiducials)} beads on the detector, for the distortion")
            known = f"s.d. of a bead {sd.bead_mm:g} mm"
        if self.covariance_mm2 is not None:
            known = "measured, with the full covariance of the coordinates"
        elif self.tolerances is None:
            known += " (defaults: the file states none)"
        when = "" if self.measured_on is None else f", measured on {self.measured_on}"
        return "\n".join([*lines, f"  {known}{when}"])

    def _new_axes(self, figure: Any) -> Any:
        return figure.add_subplot(projection="3d")

    def _draw(self, ax: Any) -> None:
        from sightline.common import draw

        for name, view in self.views.items():
            for role, plate in (("XRII", view.xrii), ("source", view.source)):
                ax.scatter(*plate.xyz_mm.T, s=4, label=f"{name}, {role} plate")
        if self.solid is not None:
            ax.scatter(*self.solid.xyz_mm.T, s=4, label="solid")
        draw.box(ax, np.array(list(self.xyz_mm_by_id.values())), f"frame {self.name}, CFCS")
        ax.legend(fontsize="small")

    @property
    def effective_tolerances(self) -> Tolerances:
        """The stated tolerances, or the defaults."""
        return self.tolerances or Tolerances()

    def view(self, name: str) -> FrameView:
        """Return the view called `name`. Raises FrameError, with the views there are."""
        try:
            return self.views[name]
        except KeyError:
            known = f"it has: {', '.join(self.views)}" if self.solid is None else "it is a solid without plates"
            raise FrameError(f"frame {self.name!r} has no view {name!r}; {known}") from None

    @cached_property
    def bodies(self) -> tuple[RigidBody, ...]:
        """The rigid bodies, in the order of `error_factor`: plates of the views in file order, XRII plate first; or the
        solid and the plate on the detector."""
        plates = tuple(plate for _, _, plate in self.named_plates)
        return plates if self.solid is None else tuple(body for body in (self.solid, self.detector) if body is not None)

    @property
    def named_plates(self) -> tuple[tuple[str, str, Plate], ...]:
        """(view, role, plate) of each plate, in the order of the frame's covariance; of a solid none."""
        return tuple((name, role, getattr(view, role)) for name, view in self.views.items() for role in ROLES)

    @cached_property
    def fiducials(self) -> tuple[Fiducial, ...]:
        """All fiducials of the `bodies`, in their order."""
        return tuple(f for body in self.bodies for f in body.fiducials)

    @property
    def xyz_mm(self) -> np.ndarray:
        """(M, 3) coordinates of all `fiducials`, CFCS; of a plate on the detector its own."""
        return np.concatenate([body.xyz_mm for body in self.bodies])

    def with_beads_at(self, xyz_mm: np.ndarray) -> "Frame":
        """Return the frame with its fiducials at other coordinates (M, 3), CFCS."""
        places = iter(xyz_mm.tolist())

        def moved(body: _Body) -> _Body:
            return replace(body, fiducials=tuple(replace(f, xyz_mm=tuple(next(places))) for f in body.fiducials))

        views = {name: FrameView(moved(view.xrii), moved(view.source)) for name, view in self.views.items()}
        solid = None if self.solid is None else moved(self.solid)
        detector = None if self.detector is None else moved(self.detector)
        return replace(self, views=views, solid=solid, detector=detector)

    def with_plate(self, plate: Plate = DETECTOR_PLATE) -> "Frame":
        """Return the frame of a solid with a plate on the detector, for image intensifiers. Raises FrameError.

        Where the solid's covariance is measured, the plate's balls have the default tolerance.

        >>> sl.Frame.load("block40").with_plate().name
        'block40+detector-plate'
        """
        if self.solid is None:
            raise FrameError(f"frame {self.name!r} has plates of its own; add a plate on the detector to a solid")
        if twice := sorted(set(plate.ids) & set(self.solid.ids)):
            raise FrameError(f"solid and plate both have a ball {twice[0]!r}; give every ball a unique id")
        covariance = self.covariance_mm2
        if covariance is not None:
            covariance = np.asarray(block_diag(covariance, Tolerances.bead_mm**2 * np.eye(3 * len(plate.ids))))
        return replace(self, name=f"{self.name}+detector-plate", detector=plate, covariance_mm2=covariance)

    def fiducials_of(self, view: str) -> tuple[Fiducial, ...]:
        """Return the fiducials that an image of a view can show: those of its plates, or all of a solid's frame.

        Raises FrameError.
        """
        return self.view(view).fiducials if self.solid is None else self.fiducials

    @cached_property
    def xyz_mm_by_id(self) -> dict[str, tuple[float, float, float]]:
        """The coordinates of every bead by its id, CFCS, mm."""
        return {f.id: f.xyz_mm for f in self.fiducials}

    def rows(self, view: str) -> slice:
        """Return the rows of `error_factor` and `covariance_mm2` with the bead coordinates of one view.

        Raises FrameError.
        """
        if self.solid is not None:
            return slice(0, 3 * len(self.fiducials))
        start = 0
        for name, each in self.views.items():
            if name == view:
                return slice(start, start + 3 * len(each.fiducials))
            start += 3 * len(each.fiducials)
        raise FrameError(f"frame {self.name!r} has no view {view!r}; it has: {', '.join(self.views)}")

    @cached_property
    def error_factor(self) -> np.ndarray:
        """(3M, K) matrix L, mm: the errors of all bead coordinates are L @ e with K independent unit-variance e.

        M beads, views in file order, in each view XRII before source. Bead errors are independent; a plate's shift and
        rotation (about the centroid of its beads) are shared by its beads; an arm's (about the centroid of the
        view's beads) by the view; the beads of a solid share none. With `covariance_mm2`, a factor of that; `in_use`
        adds columns.
        """
        stated = self.effective_tolerances if self.covariance_mm2 is None else self.covariance_mm2
        return error_factor([body.xyz_mm for body in self.bodies], self.views, stated, self.in_use)

    @property
    def key(self) -> str:
        """Identifier of the physical frame: name and serial."""
        return f"{self.name}/{self.serial or ''}"

    @cached_property
    def fingerprint(self) -> str:
        """Identifier of the frame file: key, and a hash of the content.

        One frame measured twice has one key and two fingerprints, since its coordinates differ.
        """
        return f"{self.key}#{sha256(self.to_json()).hexdigest()[:16]}"

    @staticmethod
    def load(source: str | Path, before: "Iterable[Frame]" = ()) -> "Frame":
        """Return the frame of a file, or a built-in one: "gamma", "biplane", "stereo", "block30", "block40", "block60",
        "cube120"; for image intensifiers "block30", "block40" or "block60" with "+detector-plate".

        A file is JSON, or a frame specification of XMALab (CSV); docs/frame-file.md has both.
        `before`: frames that were used earlier; the mirror image of one with the same name and serial is refused, since
        it would calibrate as well and mirror every point. Raises FrameError.
        """
        if isinstance(source, str) and source in BUILTIN:
            frame = Frame.from_design(builtin_design(source))
        elif isinstance(source, str) and source in SOLIDS:
            frame = Frame(source, {}, solid=SOLIDS[source])
        elif isinstance(source, str) and source in WITH_PLATE:
            frame = Frame.load(WITH_PLATE[source]).with_plate()
        else:
            from sightline.frame.document import read_document

            frame = Frame.from_document(read_document(Path(source)))
        frame.refuse_mirror_image(before)
        return frame

    @staticmethod
    def of(frame: "Frame | str | Path") -> "Frame":
        """Return a frame as it is, or load it (`load`). Raises FrameError, UnusableInputError."""
        if isinstance(frame, Frame):
            return frame
        if isinstance(frame, str | Path):
            return Frame.load(frame)
        raise UnusableInputError(
            f"a frame is a Frame, the path of a frame file or one of {', '.join(FRAME_NAMES)}, "
            f"not {type(frame).__name__}"
        )

    def save(self, path: str | Path) -> None:
        """Write the frame file of docs/frame-file.md, whole or not at all.

        Raises FrameError for a frame that could not be loaded again; then nothing is written.
        """
        from sightline.frame.document import document_from_json

        text = self.to_json()
        document_from_json(text)
        write_whole(path, text)

    def refuse_solid(self, why: str) -> None:
        """Raise FrameError with the reason `why` for a solid, where plates are needed."""
        if self.solid is not None:
            raise FrameError(f"frame {self.name!r} is a solid; {why}")

    def refuse_plate(self, why: str) -> None:
        """Raise FrameError with the reason `why` for a frame with a plate on the detector."""
        if self.detector is not None:
            raise FrameError(f"frame {self.name!r} has a plate on the detector, whose place is not known; {why}")

    def refuse_mirror_image(self, before: "Iterable[Frame]") -> None:
        """Raise FrameError where one of the frames `before`, of the same name and serial, is mirrored by this one."""
        if any(other.key == self.key and is_mirror_image(self.xyz_mm_by_id, other.xyz_mm_by_id) for other in before):
            raise FrameError(
                f"frame {self.key.rstrip('/')} is the mirror image of the file of the same frame before it; one of "
                "them is left-handed: correct it, and see that 'sightline frame check FILE --before FILE' passes"
            )

    @staticmethod
    def from_design(design: FrameDesign) -> "Frame":
        """Return the frame of a design, without stated tolerances. Raises FrameError for an impossible design."""
        return Frame(design.name, views_of(design))

    @staticmethod
    def from_document(document: "FrameDocument") -> "Frame":
        """Return the frame that a valid document describes."""
        from sightline.frame.document import SdRad, fiducials_of

        mm, rad, solid = document.sd_mm, document.sd_rad or SdRad(plate=0.0, arm=0.0), document.solid
        covariance = None
        if document.covariance_mm2 is not None:
            covariance = np.array(document.covariance_mm2)
            covariance.flags.writeable = False
        return Frame(
            name=document.name,
            views={
                name: FrameView(Plate(fiducials_of(view.xrii)), Plate(fiducials_of(view.source)))
                for name, view in document.views.items()
            },
            serial=document.serial,
            measured_on=document.measured_on.isoformat() if document.measured_on else None,
            temperature_c=document.temperature_c,
            tolerances=Tolerances(mm.bead, mm.plate, rad.plate, mm.arm, rad.arm) if mm else None,
            covariance_mm2=covariance,
            in_use=InUse(**document.in_use.model_dump()) if document.in_use else None,
            solid=RigidBody(fiducials_of(solid)) if solid else None,
            detector=Plate(fiducials_of(document.detector)) if document.detector else None,
        )

    @staticmethod
    def from_json(text: bytes) -> "Frame":
        """Return the frame in the text of a frame file. Raises FrameError."""
        from sightline.frame.document import document_from_json

        return Frame.from_document(document_from_json(text))

    def to_json(self) -> bytes:
        """Return the text of the frame file, unchecked."""
        document: dict[str, Any] = {"name": self.name, "units": "mm"}
        for key in ("serial", "measured_on", "temperature_c"):
            if (value := getattr(self, key)) is not None:
                document[key] = value
        if (sd := self.tolerances) is not None:
            document["sd_mm"] = {"bead": sd.bead_mm}
            if self.solid is None:
                document["sd_mm"] |= {"plate": sd.plate_mm, "arm": sd.arm_mm}
                document["sd_rad"] = {"plate": sd.plate_rad, "arm": sd.arm_rad}
        if self.in_use is not None:
            document["in_use"] = asdict(self.in_use)
        if self.solid is not None:
            document["solid"] = _fiducials_document(self.solid)
            if self.detector is not None:
                document["detector"] = _fiducials_document(self.detector)
        else:
            document["views"] = {
                name: {"xrii": _fiducials_document(view.xrii), "source": _fiducials_document(view.source)}
                for name, view in self.views.items()
            }
        if self.covariance_mm2 is not None:
            document["covariance_mm2"] = self.covariance_mm2.tolist()
        return _text(document)


def _fiducials_document(body: RigidBody) -> list[dict[str, Any]]:
    """Return the fiducials of a plate or a solid as plain values."""
    fiducials: list[dict[str, Any]] = []
    for f in body.fiducials:
        entry: dict[str, Any] = {"id": f.id, "xyz": list(f.xyz_mm), "diameter": f.diameter_mm, "datum": f.datum}
        fiducials.append(entry if f.shape == "ball" else {**entry, "shape": f.shape})
    return fiducials


def _text(document: Mapping[str, Any]) -> bytes:
    """Return the text of a frame file, with a line for each fiducial and each row of the covariance."""
    blocks = ("views", "solid", "covariance_mm2")
    parts = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in document.items() if key not in blocks]
    if "views" in document:
        views = [_view_text(name, view) for name, view in document["views"].items()]
        parts.append(' "views": {\n' + ",\n".join(views) + "\n }")
    parts += [f' "{key}": ' + _lines(document[key], "  ") for key in ("solid", "covariance_mm2") if key in document]
    return ("{\n" + ",\n".join(parts) + "\n}\n").encode()


def _view_text(name: str, view: dict[str, list[Any]]) -> str:
    plates = ",\n".join(f'   "{role}": {_lines(fiducials, "    ")}' for role, fiducials in view.items())
    return f"  {json.dumps(name)}: {{\n{plates}\n  }}"


def _lines(entries: list[Any], indent: str) -> str:
    return "[\n" + ",\n".join(indent + json.dumps(entry) for entry in entries) + f"\n{indent[:-1]}]"


MIN_COMMON = 4  # beads: three always lie in one plane
MIRRORED_RATIO = 2.0  # [ours] of the misfits, upright to mirrored: beads in one plane are their own mirror image

Places = Mapping[str, tuple[float, float, float]]  # of beads by id, mm


def is_mirror_image(places: Places, before: Places) -> bool:
    """Return whether only the mirror image fits the beads `before`; False with fewer than four common ids."""
    return len(common_ids(places, before)) >= MIN_COMMON and fits_mirrored(*misfits_mm(places, before))


def fits_mirrored(upright_mm: float, mirrored_mm: float) -> bool:
    """Return whether the mirrored misfit is clearly smaller than the upright one."""
    return MIRRORED_RATIO * mirrored_mm < upright_mm


def common_ids(places: Places, before: Places) -> list[str]:
    """Return the ids that both have, sorted."""
    return sorted(places.keys() & before.keys())


def misfits_mm(places: Places, before: Places) -> tuple[float, float]:
    """Return the rms distances of the common beads after the best rigid motion: as they are, and mirrored."""
    ids = common_ids(places, before)
    now, then = (np.array([by_id[i] for i in ids], dtype=np.float64) for by_id in (places, before))
    return _misfit_mm(now, then), _misfit_mm(-now, then)


def _misfit_mm(from_mm: np.ndarray, to_mm: np.ndarray) -> float:
    off = rigid_fit(from_mm, to_mm).apply(from_mm) - to_mm
    return float(np.sqrt((off**2).sum(axis=1).mean()))
