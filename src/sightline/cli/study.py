"""`sightline study`: one question asked of the twin, by many trials."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.output import Json, Output, Quiet, as_json

if TYPE_CHECKING:
    from sightline.studies.run import Result, Run
    from sightline.studies.study import Study

PRINTED = 2  # tables; all stand on the page


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("study")(study)


def study(
    name: Annotated[str, typer.Argument(help="Which study; a wrong name prints them all.")],
    *,
    trials: Annotated[int, typer.Option(min=1, help="How many; more can be added later.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Trial k draws from the generator of [seed, k].")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler; without it, the cores of this machine.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of trials and results; out/study/NAME unless told.")] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure accuracy on the twin; an interrupted run goes on where it stopped."""
    with Output(json=json, quiet=quiet) as output:
        from sightline.studies.catalogue import study_called
        from sightline.studies.run import Run

        chosen = study_called(name)
        folder = out or Path("out/study") / name
        result = _do(output, Run.open(chosen, trials, seed, folder), scheduler)
        files = _write(folder, chosen, result)
        for finding in result.summary.findings:
            output.say(f"- {finding}")
        for table in result.summary.tables[:PRINTED]:
            output.table(table.title, table.columns, table.rows)
        output.say(f"page: {files[0]}; figures with their intervals: {files[1]}")
        output.result({**result.document(), "files": files})


def _do(output: Output, run: "Run", scheduler: str | None) -> "Result":
    left = len(run.missing)
    if 0 < left < run.trials:
        output.note(f"{run.trials - left} trials were finished before; {left} are left")
    try:
        with output.progress(f"study {run.study.name}", left) as advance:
            run.do(scheduler, advance=advance)
    except KeyboardInterrupt:
        output.note(f"{len(run.record.finished)} finished trials are kept; the same command goes on from there")
        raise
    return run.result()


def _write(folder: Path, chosen: "Study", result: "Result") -> list[Path]:
    from sightline.atomic import write_folder
    from sightline.studies.page import render

    page = render(chosen.about, result)
    return write_folder(folder, {"report.html": page.encode(), "result.json": as_json(result.document()).encode()})
