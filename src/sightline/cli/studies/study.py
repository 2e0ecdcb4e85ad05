"""`sightline study`: measure accuracy on the twin by many trials."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.options import command, commands
from sightline.cli.output import Output, as_json

if TYPE_CHECKING:
    from sightline.studies.runs.run import Result, StudyRun
    from sightline.studies.runs.study import Study

PRINTED = 2  # tables on the terminal; the page has all of them


@command(commands, "study", "sightline study table1 --trials 50")
def study(
    output: Output,
    *,
    name: Annotated[str, typer.Argument(help="Name of the study; a wrong name lists them all.")],
    trials: Annotated[int, typer.Option(min=1, help="Number of trials; more can be added later.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Trial k draws from default_rng([seed, k]).")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler; by default the cores of this machine.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for trials and results; by default out/study/NAME.")] = None,
) -> None:
    """Measure accuracy on the digital twin.

    An interrupted run continues where it stopped.
    """
    from sightline.studies.catalogue import study_called
    from sightline.studies.runs.run import StudyRun

    chosen = study_called(name)
    folder = out or Path("out/study") / name
    result = _do(output, StudyRun.open(chosen, trials, seed, folder), scheduler)
    files = _write(folder, chosen, result)
    for finding in result.summary.findings:
        output.say(f"- {finding}")
    for table in result.summary.tables[:PRINTED]:
        output.table(table.title, table.columns, table.rows)
    output.say(f"page: {files[0]}; values with their intervals: {files[1]}")
    output.result({**result.document(), "files": files})


def _do(output: Output, run: "StudyRun", scheduler: str | None) -> "Result":
    left = len(run.missing)
    if 0 < left < run.trials:
        output.note(f"{run.trials - left} trials were finished earlier; {left} remain")
    try:
        with output.progress(f"study {run.study.name}", left) as advance:
            run.do(scheduler, advance=advance)
    except KeyboardInterrupt:
        output.note(f"{len(run.record.finished)} finished trials are kept; run the same command to continue")
        raise
    return run.result()


def _write(folder: Path, chosen: "Study", result: "Result") -> list[Path]:
    from sightline.common.atomic import write_folder
    from sightline.studies.runs.page import render

    page = render(chosen.about, result)
    documents = {"report.html": page.encode(), "result.json": as_json(result.document()).encode()}
    return write_folder(folder / "report", documents)
