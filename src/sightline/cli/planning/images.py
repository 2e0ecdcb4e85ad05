"""The images that `sightline plan` and `check-shot` are given, or take from a case."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.options import Invert, Method
from sightline.cli.output import Output

if TYPE_CHECKING:
    from sightline.case.contents import Images
    from sightline.case.journal import Case, Entry
    from sightline.case.picks import Picks
    from sightline.case.stages import SeenImages
    from sightline.frame import Frame


@dataclass(frozen=True)
class PlanImages:
    """The images of a plan."""

    pa: Annotated[
        Path | None, typer.Argument(help="PA image, or observations as CSV. May be left out with --case.")
    ] = None
    lateral: Annotated[
        Path | None, typer.Argument(help="Lateral image, or observations as CSV (may be the same file).")
    ] = None
    oblique: Annotated[
        Path | None,
        typer.Argument(
            help="A third image, taken last, from between the others: it shows movements of the patient that no pair "
            "shows. Needs a block, and two landmarks or more picked in all images.",
            show_default=False,
        ),
    ] = None
    case: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a case: record images and plan in it. Without images, plan on its newest PA and lateral "
            "image, and on its newest oblique one where picks name it.",
            show_default=False,
        ),
    ] = None
    frame: Annotated[
        str | None,
        typer.Option(
            help="A frame file, gamma, biplane, stereo or block60.", show_default="gamma, or that of the case"
        ),
    ] = None
    method: Method = "smooth"
    invert: Invert = False

    def taken(self, output: Output, stack: ExitStack, picks: "Picks") -> "PlanningImages":
        """Return the images with their beads, read or taken from the case, which is open until the stack ends.

        Raises BadParameter for a missing image, CaseError, and what reading and labelling raise.
        """
        from sightline.case.journal import Case
        from sightline.case.stages import frame_in_use, frame_of
        from sightline.case.views import ALL_NAMES, NAMES
        from sightline.frame import Frame

        files = both_or_none(self.pa, self.lateral)
        if files is None and self.case is None:
            raise typer.BadParameter("give the PA and the lateral image, or --case", param_hint="PA LATERAL")
        if files is not None and self.oblique is not None:
            files = (*files, self.oblique)
        if files is not None and picks.in_oblique and self.oblique is None:
            raise typer.BadParameter("points are picked in an oblique image; give its file", param_hint="OBLIQUE")
        names = ALL_NAMES if self.oblique is not None or picks.in_oblique else NAMES
        case = None
        if self.case is not None and (files is None or Case.exists(self.case)):
            case = stack.enter_context(Case.open(self.case))
        in_use = None if case is None or self.frame is not None else frame_in_use(case)
        frame = Frame.load(self.frame or "gamma") if case is None or in_use is None else frame_of(case, in_use)
        with output.step("finding and labelling the beads"):
            return PlanningImages(case, frame, names, images_of(output, case, files, frame, names, invert=self.invert))


@dataclass(frozen=True, eq=False)
class PlanningImages:
    """The images of the views `names` before calibration, their frame, and the case, None where there is none yet."""

    case: "Case | None"
    frame: "Frame"
    names: Sequence[str]
    seen: "SeenImages"

    def record(self, case: "Case", images: "Images") -> "tuple[tuple[Entry, ...], dict[str, int]]":
        """Record the calibrated images in a case; return their entries, and the numbers of those that acquired them."""
        from sightline.case.journal import Actor
        from sightline.case.stages import record_images

        entries = record_images(case, self.seen, images, self.frame, by=Actor.COMMAND)
        return entries, image_numbers(case, entries, self.names)


def both_or_none(pa: Path | None, lateral: Path | None) -> tuple[Path, ...] | None:
    """Return the files of both views; None where neither is given. Raises BadParameter where one is missing."""
    if pa is not None and lateral is not None:
        return pa, lateral
    if pa is not None:
        raise typer.BadParameter("the lateral image is missing; give both images", param_hint="LATERAL")
    return None


def images_of(
    output: Output,
    case: "Case | None",
    files: tuple[Path, ...] | None,
    frame: "Frame",
    names: Sequence[str],
    *,
    invert: bool = False,
    after: int = 0,
) -> "SeenImages":
    """Return the images of the files, or the newest of these views in the case after entry `after`; say which were
    skipped.

    Raises what `given_images` and `newest_images` raise.
    """
    from sightline.case.stages import given_images, newest_images

    if files is not None:
        return given_images(files, frame, invert=invert)
    assert case is not None  # noqa: S101 - without files there is a case
    seen = newest_images(case, frame, names, after=after, invert=invert)
    for line in seen.skipped:
        output.note(line)
    return seen


def image_numbers(case: "Case", entries: "Sequence[Entry]", names: Sequence[str]) -> dict[str, int]:
    """Return the numbers of the entries that acquired the images of calibrated views, by name."""
    from sightline.case.stages import acquired_of

    return {name: acquired_of(case, entry).number for name, entry in zip(names, entries, strict=True)}
