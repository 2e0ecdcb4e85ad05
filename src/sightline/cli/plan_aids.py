"""`sightline plan`: the aids that are drawn, and those that are fitted to edges."""

from dataclasses import replace
from typing import TYPE_CHECKING

from sightline.cli.planning.points import VIEWS, Point

if TYPE_CHECKING:
    from sightline.case.contents import Images
    from sightline.planning import Aids, Procedure


def drawn(
    known: "Procedure",
    circles: tuple[tuple[float, ...], tuple[float, ...]] | None,
    clicked: dict[str, Point],
    sd_px: float,
) -> "Aids | None":
    """Return what is drawn, None for nothing. Raises UnusableInputError for an aid that the procedure does not have."""
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.planning import Aids, Circle

    types = {one.key: one.type for one in known.aids}
    if unknown := sorted(clicked.keys() - types.keys()):
        raise UnusableInputError(f"{known.key} has no aid {unknown[0]!r}; choose one of {', '.join(types)}")
    if circles is None and not clicked:
        return None
    uv = {key: [np.reshape(one[v], (-1, 2)) if v in one else None for v in VIEWS] for key, one in clicked.items()}
    aids = Aids.clicked(types, uv, sd_px)
    if circles is None:
        return aids
    first, second = (Circle.of(np.array(one[:2]), one[2], sd_px) for one in circles)
    return replace(aids, head=(first, second))


def fitted(
    aids: "Aids | None", images: "Images", *, head: bool, shaft: bool, neck: bool
) -> "tuple[Aids | None, dict[str, list[str]]]":
    """Return the aids with head, shaft and neck fitted to the images, and for each of them a sentence for each image in
    which it could not be, by "head_not_fitted", "shaft_not_fitted" and "neck_not_fitted".

    Raises UnusableInputError where there is nothing to fit, or no image.
    """
    from sightline.errors import UnusableInputError
    from sightline.from_images.head import fit_head, refuse_tables
    from sightline.from_images.neck import fit_neck
    from sightline.from_images.shaft import fit_shaft

    views, unfitted = [one.view for one in images], {}
    if head:
        if aids is None or aids.head is None:
            raise UnusableInputError("--fit-head fits a head that is drawn; draw it with --aid or --head")
        circles, kept = fit_head(views, refuse_tables([one.seen.image for one in images]), aids.head)
        aids, unfitted["head_not_fitted"] = replace(aids, head=circles), _kept("head", kept)
    if shaft:
        if aids is None or aids.shaft is None:
            raise UnusableInputError(
                "--fit-shaft fits a shaft that is drawn; draw it with --aid: in each image two clicks on each border"
            )
        lines, kept = fit_shaft(views, refuse_tables([one.seen.image for one in images]), aids.shaft)
        aids, unfitted["shaft_not_fitted"] = replace(aids, shaft=lines), _kept("shaft", kept)
    if neck:
        if aids is None or aids.neck is None or aids.head is None:
            raise UnusableInputError(
                "--fit-neck fits a drawn neck from the centre of a drawn head; draw both with --aid: the neck by two "
                "clicks on each border in each image, from the head past the narrowest place"
            )
        lines, kept = fit_neck(views, refuse_tables([one.seen.image for one in images]), aids.neck, aids.head)
        aids, unfitted["neck_not_fitted"] = replace(aids, neck=lines), _kept("neck", kept)
    return aids, unfitted


def _kept(key: str, kept: dict[str, str]) -> list[str]:
    return [f"{view} image: {key} kept as drawn; {why}" for view, why in kept.items()]
