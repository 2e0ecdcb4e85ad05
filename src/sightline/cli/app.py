"""`sightline app`: the planning app in the browser, served on this machine."""

from importlib.util import find_spec
from os import environ
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.output import Json, Output, Quiet, example

if TYPE_CHECKING:
    from sightline.app.web.serve import ServedApp

DEMO_SEED = 9  # as of `sightline demo`


def register(app: typer.Typer) -> None:
    """Add the command."""
    epilog = example("sightline app", "sightline app --case out/case --frame gamma")
    app.command("app", epilog=epilog)(app_command)


def app_command(
    *,
    case: Annotated[
        Path | None, typer.Option(help="Folder of the case; created if it does not exist.", show_default="the demo's")
    ] = None,
    frame: Annotated[
        str | None, typer.Option(help="For a new case: a frame file, gamma, biplane, stereo or block60.")
    ] = None,
    rehearse: Annotated[
        int | None, typer.Option(min=0, help="For a new case: a simulated patient and robot drawn from this seed.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen at; 0 takes a free one.")] = 8765,
    host: Annotated[
        str, typer.Option(help="Address to listen at. Other machines need the token that is printed.")
    ] = "127.0.0.1",
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    live: Annotated[
        str | None, typer.Option(help="Live image for the step Drill: a source as of `sightline watch`.")
    ] = None,
    language: Annotated[
        str | None,
        typer.Option(help="Of the page: en, de, or a language file.", show_default="the browser's"),
    ] = None,
    fast_robot: Annotated[
        bool, typer.Option("--fast-robot", help="Run the simulated robot as fast as the machine computes.")
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Plan, drill and check a wire in the browser.

    Without --case, on a simulated patient.
    """
    with Output(json=json, quiet=quiet) as output:
        from sightline.errors import UnusableInputError

        if find_spec("nicegui") is None:
            raise UnusableInputError("the app needs NiceGUI: pip install 'sightline[app]'")
        from sightline.app.session.worker import WorkerProcess, warm_up

        worker = WorkerProcess()
        worker.begin(warm_up)  # its imports take as long as those below: one core each

        from sightline.app.run import run
        from sightline.app.session.rehearsing import Patient
        from sightline.app.settings import Settings
        from sightline.app.texts import load

        folder = Path("out/app") if case is None else case
        seed = DEMO_SEED if case is None and rehearse is None else rehearse
        patient = None if seed is None else Patient(seed, frame or "gamma")
        token = environ.get("SIGHTLINE_TOKEN") or None  # not an option: other users can read command lines
        spoken = None if language is None else load(language)
        settings = Settings(folder, frame, patient, live, host, port, token, browser, fast_robot, spoken)

        def ready(site: "ServedApp") -> None:
            output.say(f"open {site.url} in a browser; stop with Ctrl-C")

        run(settings, worker, ready)
        output.result({"case": folder})
