"""`sightline app`: the planning app in the browser, served on this machine."""

from importlib.util import find_spec
from os import environ
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.demo import SEED
from sightline.cli.demo_procedures import DEFAULT
from sightline.cli.output import Json, Output, Quiet, example
from sightline.cli.robots.robot import Rehearsed

if TYPE_CHECKING:
    from sightline.app.session.rehearsing import Patient
    from sightline.app.web.serve import ServedApp


def register(app: typer.Typer) -> None:
    """Add the command."""
    examples = ("sightline app", "sightline app --case out/case --frame gamma")
    epilog = example(*examples, "sightline app --procedure distal-interlocking")
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
    procedure: Annotated[
        Rehearsed | None,
        typer.Option(
            help="For a new case: a simulated patient of this procedure. Beside a nail its frame is block60.",
            show_default="hip-screw",
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen at; 0 takes a free one.")] = 8765,
    host: Annotated[
        str, typer.Option(help="Address to listen at. Other machines need the token that is printed.")
    ] = "127.0.0.1",
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    live: Annotated[
        str | None, typer.Option(help="Live image for the step Drill: a source as of `sightline watch`.")
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

        from sightline.app.run import Settings, run

        folder = case or Path("out/app" if procedure is None else f"out/app-{procedure}")
        patient = None
        if case is None or rehearse is not None or procedure is not None:
            patient = _patient(rehearse, procedure or DEFAULT, frame)
        token = environ.get("SIGHTLINE_TOKEN") or None  # not an option: other users can read command lines
        settings = Settings(folder, frame, patient, live, host, port, token, browser, fast_robot)

        def ready(site: "ServedApp") -> None:
            output.say(f"open {site.url} in a browser; stop with Ctrl-C")

        run(settings, worker, ready)
        output.result({"case": folder})


def _patient(seed: int | None, procedure: str, frame: str | None) -> "Patient":
    """Return the simulated patient of a procedure, as `sightline demo` draws it."""
    from sightline.app.session.rehearsing import Patient
    from sightline.cli.demo_procedures import SEEDS, frame_for

    seed = SEEDS.get(procedure, SEED) if seed is None else seed
    # The names of the frames import the twin, for which the first page would wait.
    frame = frame or ("gamma" if procedure == DEFAULT else frame_for(procedure, None))
    return Patient(seed, frame, procedure=procedure)
