"""Names of the images as the procedure calls its views, such as "Inlet image", in the language of the page."""

from dataclasses import replace

from sightline.app import texts
from sightline.case.views import spoken
from sightline.checks import Check
from sightline.planning.procedures import kind as kind_of


def image_label(image: str, kind: str) -> str:
    """Return the name of an image of a procedure, by its key, as on a label: "PA image", "Inlet check image"."""
    purpose, view = _parts(image, kind)
    return texts.IMAGE_LABELS.get(_joined(purpose, view)) or texts.titled(_made(purpose, view))


def image_name(image: str, kind: str) -> str:
    """Return the name of an image as in a sentence: "PA image", "inlet check image"."""
    purpose, view = _parts(image, kind)
    return texts.IMAGE_NAMES.get(_joined(purpose, view)) or _made(purpose, view)


def image_short(image: str, kind: str) -> str:
    """Return the name of an image's view where there is little room: "PA", "lat", "inlet"."""
    _, view = _parts(image, kind)
    return texts.IMAGES_SHORT.get(view) or view


def in_image(image: str, kind: str) -> str:
    """Return the name of an image as in an instruction: "PA", "INLET CHECK"."""
    purpose, view = _parts(image, kind)
    known, made = texts.IN_IMAGE.get(_joined(purpose, view)), view.upper()
    return known or (texts.IN_IMAGE_OF_VIEW[purpose].format(view=made) if purpose else made)


def with_view_named(check: Check, kind: str) -> Check:
    """Return the check; the sentence of one of a view begins with the procedure's name of the view."""
    if not check.view:
        return check
    said = check.sentence.removeprefix(f"{check.view}: ")
    return replace(check, sentence=f"{texts.titled(spoken(check.view, kind_of(kind)))}: {said}")


def _parts(image: str, kind: str) -> tuple[str, str]:
    """Return what an image is taken for, "" for the plan, "check" or "shot", and the key of its view: "inlet"."""
    purpose, _, slot = image.rpartition("-")
    own = spoken(slot, kind_of(kind))
    return purpose, "pa" if own == "PA" else own


def _joined(purpose: str, view: str) -> str:
    return f"{purpose}-{view}" if purpose else view


def _made(purpose: str, view: str) -> str:
    return texts.IMAGE_OF_VIEW[purpose].format(view=view)
