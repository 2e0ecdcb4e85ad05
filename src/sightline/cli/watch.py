"""`sightline watch`: calibrate each frame of a live image, draw the plan, raise an alarm when frame or C-arm move."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import (
    ImagesFrame,
    Invert,
    Output,
    ServeAt,
    WireKey,
    command,
    commands,
    frame_of_images,
    serving,
)

if TYPE_CHECKING:
    from sightline.calibration import BeadView
    from sightline.case.interop.plan_file import PlanFile
    from sightline.case.live import LiveState
    from sightline.case.watch.analyser import TimedImage, Watched
    from sightline.case.watch.live import Watch
    from sightline.frame import Frame
    from sightline.planning import Trajectory

_WAIT_S = 0.5  # timeout of one wait for a frame


@dataclass(frozen=True)
class LiveOptions:
    """The live image: a source, or a simulated C-arm."""

    source: Annotated[
        str | None,
        typer.Argument(help="Device number, stream address, video file, multi-frame DICOM file or folder of images."),
    ] = None
    rehearse: Annotated[
        int | None,
        typer.Option(metavar="SEED", help="Watch a simulated C-arm drawn from this seed; it is bumped after 6 s."),
    ] = None
    frame: ImagesFrame = None
    invert: Invert = False


@command(
    commands,
    "watch",
    "sightline watch 0 --plan out/plan",
    "sightline watch --rehearse 1 --seconds 10 --serve igtl:18944",
)
def watch(
    output: Output,
    *,
    live: LiveOptions,
    plan: Annotated[Path | None, typer.Option(help="Plan to draw: plan.json of `sightline plan --out`.")] = None,
    wire: WireKey = None,
    planned: Annotated[
        list[Path] | None,
        typer.Option(
            help="Planning image taken with the C-arm in its present position: the reference for movements. Default: "
            "the first half second. May be given for each view."
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Stop after this time.", show_default=False)] = None,
    serve: ServeAt = None,
) -> None:
    """Watch a live image and report movements.

    Every frame is calibrated, the plan is drawn into it, and an alarm is given when frame or C-arm move. With --json
    every frame is one line, and the last line is the summary.
    """
    from sightline.case.watch.analyser import BLIND_TO
    from sightline.case.watch.live import Watch

    frame = frame_of_images(output, live.frame)
    frame.refuse_solid("a live image is watched by the plates of a frame")
    images, drawn = _opened(live, frame, output)
    known = None if plan is None else _planned(plan, wire, frame, output)
    drawn = drawn if known is None else known.trajectory
    with output.step("planning images"):
        references = [_reference(path, frame, invert=live.invert) for path in planned or ()]
    output.note(BLIND_TO)
    watching = Watch(frame, images, drawn, references)
    with watching, serving(serve, partial(_state, watching, known), output):
        tally = _follow(watching, output, seconds)
    output.result(_summary(tally, watching) | {"blind_to": BLIND_TO})


def _opened(live: LiveOptions, frame: "Frame", output: Output) -> "tuple[Iterable[TimedImage], Trajectory | None]":
    """Return the images of the source, and the wire of a simulated one. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError
    from sightline.imaging.sources import open_source

    if (live.source is None) == (live.rehearse is None):
        raise UnusableInputError("give one source, or --rehearse SEED for a simulated one")
    if live.source is not None:
        return open_source(live.source, invert=live.invert), None
    from sightline.rehearsal.stream import SimulatedFluoroscopy

    with output.step("taking the C-arm's images"):
        stream = SimulatedFluoroscopy(int(live.rehearse or 0), frame)
    return stream, stream.wire


def _planned(path: Path, wire: str | None, frame: "Frame", output: Output) -> "PlanFile":
    """Raises UnusableInputError."""
    from sightline.case.interop.plan_file import PlanFile
    from sightline.errors import UnusableInputError

    plan = PlanFile.read(path, wire)
    made_with = plan.document.frame
    if made_with is not None and made_with.name != frame.name:
        raise UnusableInputError(
            f"the plan was made with frame {made_with.name!r}, not {frame.name!r}; give that frame with --frame"
        )
    if not plan.go:
        output.note(f"the plan drawn is {plan.verdict}")
    return plan


def _state(watching: "Watch", plan: "PlanFile | None") -> "LiveState":
    """Return what readers of `--serve` are shown now."""
    from sightline.case.live import STATUS, LiveState, shown_of, status_of

    newest = watching.latest()
    shown = LiveState({STATUS: status_of(newest)}, shown_of(newest))
    if plan is None:
        return shown
    wire, side = plan.points_mm if plan.go else None, None if plan.of_solid else plan.side
    return replace(shown, verdict=plan.verdict, wire_mm=wire, side=side)


def _reference(path: Path, frame: "Frame", *, invert: bool) -> "BeadView":
    from sightline.calibration import calibrate
    from sightline.case.views import see

    return calibrate(see(path, frame, invert=invert).observations, frame)


def _follow(watching: "Watch", output: Output, seconds: float | None) -> "list[Watched]":
    """Return the result of each processed frame, without its image."""
    from time import monotonic

    end = None if seconds is None else monotonic() + seconds
    history: list[Watched] = []
    with output.live("Watching; stop with Ctrl-C", ("", "")) as show:
        number = 0
        while end is None or monotonic() < end:
            watched = watching.next(number, _WAIT_S)
            if watched is None:
                if watching.ended:
                    break
                continue
            number = watched.number
            output.line(_document(watched))
            history.append(replace(watched, view=None, corridor=None))
            show(_rows(watched, history))
    error = watching.error
    if error is not None:
        raise error
    return history


def _rows(watched: "Watched", history: "list[Watched]") -> list[tuple[str, str]]:
    """Return the rows that a person sees of a frame."""
    movement = watched.movement
    view = watched.view
    error = "unknown" if watched.error_95_mm is None else f"{watched.error_95_mm:.2f} mm"
    return [
        ("frame", f"{watched.number}, {watched.dropped} dropped, {_rate(history):.0f} a second"),
        ("latency", f"{1e3 * watched.latency_s:.0f} ms" + (" STALE" if watched.stale else "")),
        ("view", f"none: {watched.reason}" if view is None else f"{view.name}, {len(view.residuals.ids)} beads"),
        ("residual", "-" if view is None else f"{view.residuals.leave_one_out_rms_mm:.3f} mm, leave-one-out"),
        ("error at the target", f"{error} (95 %)"),
        ("movement", watched.note if movement is None else f"{movement.shift_mm:.3f} mm: {movement.text}"),
        ("plan", "not drawn" if watched.corridor is None else f"drawn at {len(watched.corridor.uv_px)} points"),
    ]


def _rate(history: "list[Watched]") -> float:
    """Return the frames per second of the last half second."""
    last = history[-16:]
    gone = last[-1].stamped_s - last[0].stamped_s
    return (len(last) - 1) / gone if gone > 0 else 0.0


def _document(watched: "Watched") -> dict[str, Any]:
    view, drawn = watched.view, watched.corridor
    return {
        "number": watched.number,
        "dropped": watched.dropped,
        "stamped_s": watched.stamped_s,
        "latency_s": watched.latency_s,
        "stale": watched.stale,
        "reason": watched.reason,
        "view": None
        if view is None
        else {
            "name": view.name,
            "focal_point_mm": view.focal_point_mm,
            "beads": int(view.residuals.used.sum()),
            "leave_one_out_rms_mm": view.residuals.leave_one_out_rms_mm,
            "failed": [check.name for check in view.checks if not check.passed],
        },
        "error_95_mm": watched.error_95_mm,
        "movement": watched.movement,
        "moved": watched.moved,
        "note": watched.note,
        "plan": None if drawn is None else {"uv_px": drawn.uv_px, "half_95_px": drawn.half_95_px},
    }


def _summary(history: "list[Watched]", watching: "Watch") -> dict[str, Any]:
    """Return the summary. Raises CalibrationRefusedError where no frame gave a view."""
    from statistics import median

    from sightline.errors import CalibrationRefusedError

    without_view = [watched.reason for watched in history if watched.reason]
    if len(without_view) == len(history):
        why = f": {history[-1].reason}" if history else ""
        raise CalibrationRefusedError(f"none of {len(history)} frames gave a calibrated view{why}")
    return {
        "frames": history[-1].number,
        "worked_on": history[-1].number - history[-1].dropped,
        "dropped": history[-1].dropped,
        "without_view": len(without_view),
        "latency_s": {"median": median(w.latency_s for w in history), "largest": max(w.latency_s for w in history)},
        "moved": any(watched.moved for watched in history),
    }
