"""`sightline app`: the planning app in the browser, served on this machine."""

from dataclasses import dataclass
from importlib.util import find_spec
from os import environ
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.base import Output, Rehearsed, ServeAt, command, commands, serving
from sightline.cli.demo import DEFAULT, SEED, SEEDS, frame_for

if TYPE_CHECKING:
    from sightline.app.session.rehearsing import Patient
    from sightline.app.web.serve import ServedApp


@dataclass(frozen=True)
class NewCase:
    """What a new case begins with."""

    frame: Annotated[
        str | None, typer.Option(help="For a new case: a frame file, gamma, biplane, stereo or block60.")
    ] = None
    rehearse: Annotated[
        int | None, typer.Option(min=0, help="For a new case: a simulated patient and robot drawn from this seed.")
    ] = None
    procedure: Annotated[
        Rehearsed | None,
        typer.Option(
            help="For a new case: a simulated patient of this procedure. Beside a nail its frame is block60.",
            show_default="hip-screw",
        ),
    ] = None

    @property
    def patient(self) -> "Patient":
        """The simulated patient, as `sightline demo` draws it."""
        from sightline.app.session.rehearsing import Patient

        procedure = self.procedure or DEFAULT
        seed = SEEDS.get(procedure, SEED) if self.rehearse is None else self.rehearse
        # The names of the frames import the twin, for which the first page would wait.
        frame = self.frame or ("gamma" if procedure == DEFAULT else frame_for(procedure, None))
        return Patient(seed, frame, procedure=procedure)


@dataclass(frozen=True)
class Served:
    """Where the page is served."""

    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen at; 0 takes a free one.")] = 8765
    host: Annotated[str, typer.Option(help="Address to listen at. Other machines need the token that is printed.")] = (
        "127.0.0.1"
    )
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True


@command(
    commands,
    "app",
    "sightline app",
    "sightline app --case out/case --frame gamma",
    "sightline app --procedure distal-interlocking",
)
def app(
    output: Output,
    *,
    case: Annotated[
        Path | None, typer.Option(help="Folder of the case; created if it does not exist.", show_default="the demo's")
    ] = None,
    new: NewCase,
    served: Served,
    live: Annotated[
        str | None, typer.Option(help="Live image for the step Drill: a source as of `sightline watch`.")
    ] = None,
    fast_robot: Annotated[
        bool, typer.Option("--fast-robot", help="Run the simulated robot as fast as the machine computes.")
    ] = False,
    serve: ServeAt = None,
) -> None:
    """Plan, drill and check a wire in the browser.

    Without --case, on a simulated patient.
    """
    from sightline.errors import UnusableInputError

    if find_spec("nicegui") is None:
        raise UnusableInputError("the app needs NiceGUI: pip install 'sightline[app]'")
    from sightline.app.session.jobs import WorkerProcess, warm_up

    worker = WorkerProcess()
    worker.begin(warm_up)  # its imports take as long as those below: one core each

    from sightline.app.run import Settings, run

    folder = case or Path("out/app" if new.procedure is None else f"out/app-{new.procedure}")
    rehearses = case is None or new.rehearse is not None or new.procedure is not None
    settings = Settings(
        folder,
        new.frame,
        new.patient if rehearses else None,
        live,
        served.host,
        served.port,
        environ.get("SIGHTLINE_TOKEN") or None,  # not an option: other users can read command lines
        served.browser,
        fast_robot,
    )

    def ready(site: "ServedApp") -> None:
        output.say(f"open {site.url} in a browser; stop with Ctrl-C")

    if not serve:
        run(settings, worker, ready)
    else:
        from sightline.app.session.shown import ShownSession

        outside = ShownSession()
        with serving(serve, outside, output):
            run(settings, worker, ready, outside.follow)
    output.result({"case": folder})
