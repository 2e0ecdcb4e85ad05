"""`sightline export plan`: a plan in the formats of 3D Slicer, ITK, DICOM, tables and robots."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from sightline.cli.export import Out
from sightline.cli.output import Json, Output, Quiet, example

Side = Literal["right", "left"]
KINDS = ("slicer", "itk", "dicom", "csv", "igtl")


def register(export_app: typer.Typer) -> None:
    """Add the command to the group."""
    export_app.command("plan", epilog=example("sightline export plan out/plan --to csv,slicer --out out/export"))(plan)


def plan(
    path: Annotated[Path, typer.Argument(metavar="PLAN", help="plan.json, or the folder of `sightline plan --out`.")],
    *,
    out: Out,
    to: Annotated[
        str,
        typer.Option(
            help=f"Formats: {','.join(KINDS)}. Each goes to a folder of its name, of several wires one for each in it."
        ),
    ] = "csv",
    side: Annotated[
        Side | None,
        typer.Option(
            help="Side of the patient, which patient axes depend on; needed where the plan does not state it."
        ),
    ] = None,
    case: Annotated[str, typer.Option(help="Case number: the only identification in the files.")] = "plan",
    original: Annotated[
        list[str] | None,
        typer.Option(help="Raw DICOM image to draw on, 'pa:FILE'; its UIDs are written.", show_default=False),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Export a plan.

    A plan that is not GO says so in every file, and is not exported as a robot's message.
    """
    with Output(json=json, quiet=quiet) as output:
        from datetime import datetime

        from sightline.atomic import write_folder
        from sightline.case.interop import dicom_plan, itk, robot_files, slicer, tables
        from sightline.case.interop.dicom import ExportIdentity
        from sightline.case.interop.plan_file import PlanFile
        from sightline.errors import UnusableInputError

        kinds = [kind.strip() for kind in to.split(",")]
        unknown = [kind for kind in kinds if kind not in KINDS]
        if unknown:
            raise UnusableInputError(f"{unknown[0]!r} is not a format of a plan; choose from {', '.join(KINDS)}")
        wires, originals = PlanFile.read_all(path), _originals(original)
        stated = next(iter(wires.values())).side  # one patient's, the same for all wires
        if side is not None and stated is None:
            output.note(f"the plan does not state its side: the patient axes rest on --side {side} alone")
        side = side or stated
        if side is not None:
            for known in wires.values():
                known.refuse_other_side(side)
        filed = ExportIdentity(case, datetime.now().replace(microsecond=0), side)
        if originals and "dicom" not in kinds:
            raise UnusableInputError("--original is for --to dicom only; leave it out")
        writers: dict[str, Callable[[PlanFile], dict[str, bytes]]] = {
            "slicer": lambda known: slicer.write(known, side),
            "itk": lambda known: itk.write(known, side),
            "dicom": lambda known: dicom_plan.write(known, filed, originals),
            "csv": lambda known: tables.write(known, side),
            "igtl": lambda known: robot_files.write(known, case),
        }
        with output.step("making the files"):  # all of them before any is written
            documents = {
                f"{kind}/{f'{wire}/' if wire else ''}{name}": data
                for kind in kinds
                for wire, known in wires.items()
                for name, data in writers[kind](known).items()
            }
        written = write_folder(out, documents)
        statements = {wire: known.statement for wire, known in wires.items()}
        for wire, statement in statements.items():
            output.say(f"{wire}: {statement}" if wire else statement)
        for file in written:
            output.say(f"written: {file}")
        said = {"statement": statements[""]} if "" in statements else {"statements": statements}
        go = all(known.go and known.document.all_wires in (None, "go") for known in wires.values())
        output.result({"go": go, **said, "side": side, "files": written})


def _originals(texts: list[str] | None) -> dict[str, Path]:
    from sightline.errors import UnusableInputError

    out: dict[str, Path] = {}
    for text in texts or ():
        view, colon, file = text.partition(":")
        if not colon or not file or view in out:
            raise UnusableInputError(f"--original {text!r} is not VIEW:FILE, for example pa:shot1.dcm, once a view")
        out[view] = Path(file)
    return out
