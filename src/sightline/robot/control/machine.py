"""The machine: samples and supervises the plant, moves and stops. It knows states and activities, but no requests."""

from collections import deque
from collections.abc import Sequence
from math import isfinite

import numpy as np

from sightline.common.geometry.lines import angle_rad
from sightline.robot.contract import MAX_KEPT, Code
from sightline.robot.control.course import STANDING_SHARE, Activity, align, moving_limit, retract
from sightline.robot.control.drilling import Drilling
from sightline.robot.control.insertion import Insertion, LinkRegistration, Setup
from sightline.robot.control.requests import Answer, Outcome, Outcomes, Panel, RequestRefusedError, RobotFault, Snapshot
from sightline.robot.control.states import ACTIVITIES, MOVING, TRANSITIONS, WAITING, State, Trigger
from sightline.robot.control.timing import Lease, LoopClock
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.target import DepthZero
from sightline.robot.plant import WATCHDOG_S, Plant, PlantFlag, Reading

GUIDE_FAULT_MM = 1.0  # of the guide from the plan, beyond which the robot does not hold it [ours: the paper's limit]
STOP_S = 1.0  # time limit for a stop: ten times the longest one


WINDOW = 6  # samples over which a joint at rest changes by at most one count: below 1 % of full speed
STILL_COUNTS = 1.5


class Samples:
    """The last few samples of a plant. `latest`: the newest sample with finite values."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.latest: Reading = plant.read()
        self._sound = True  # the last sample was finite
        self._sampled_s: float | None = None  # LoopClock time: a pause of the controller is not the plant's silence
        self._past: deque[Reading] = deque([self.latest], maxlen=WINDOW)

    def take(self, now_s: float) -> None:
        """Read one sample."""
        reading = self._plant.read()
        self._sound = isfinite(reading.force_n) and all(map(isfinite, reading.encoders.tolist()))
        if not self._sound:
            return
        if self._sampled_s is None or reading.time_s > self.latest.time_s:
            self._sampled_s = now_s
            self._past.append(reading)
        self.latest = reading

    def missing(self, now_s: float) -> str | None:
        """Return why there is no valid sample of the plant, or the fault it reports; None if all is well."""
        if self.latest.fault:
            return f"the arm's controller reports a fault: {self.latest.fault}"
        if not self._sound:
            return "an encoder or the force sensor gives no number"
        if self._sampled_s is None or now_s - self._sampled_s > WATCHDOG_S:
            return f"no sample from the drives for {WATCHDOG_S:g} s"
        return None

    def wrong(self, manipulator: Manipulator, state: State, rest: np.ndarray) -> str | None:
        """Return the fault in the latest sample for a robot that moves, or that should stand at `rest` (n,); else
        None."""
        reading = self.latest
        beyond = manipulator.beyond_limits(reading.encoders)
        limit = moving_limit(manipulator)
        outside = np.abs(beyond) > limit
        if any(outside.tolist()):
            joint = int(np.argmax(outside))
            at, excess = float(reading.encoders[joint]), float(beyond[joint])
            return f"outside the workspace: {manipulator.describe_excess(joint, at, excess, 'is at')}"
        if PlantFlag.OVERLOAD in reading.flags and state in MOVING:
            return "a drive is at the limit of its force: something blocks the robot"
        if state in WAITING and (manipulator.has_feed or state is not State.GUIDE):  # a person pushes at a guide
            off = np.abs(reading.encoders - rest) > STANDING_SHARE * limit
            if off.any():
                return f"{manipulator.joints[int(np.argmax(off))]} was moved while it should stand"
        return None

    @property
    def velocity(self) -> np.ndarray:
        """(n,): joint velocities over the window, mm/s and rad/s."""
        first, last = self._past[0], self._past[-1]
        elapsed = last.time_s - first.time_s
        return (last.encoders - first.encoders) / elapsed if elapsed > 0 else np.zeros_like(last.encoders)

    def still(self, manipulator: Manipulator) -> bool:
        """Return whether all joints stand still."""
        moved = np.ptp([reading.encoders for reading in self._past], axis=0)
        return len(self._past) == WINDOW and bool((moved < STILL_COUNTS * manipulator.resolution).all())


class Machine:
    """A calibrated robot with its plant, registration and target. `first_fault`: the number of its first fault.

    `state` changes only by the table. `registration` and `insertion` come from a client, `drilling` is the hole in
    progress; each is None if there is none. Motion ends if the client that holds the `lease` is silent. `outcomes` are
    waiting to be reported to clients.
    """

    def __init__(self, robot: CalibratedRobot, plant: Plant, setup: Setup, panel: Panel, first_fault: int) -> None:
        self.robot, self.setup, self.panel = robot, setup, panel
        self.state = State.UNDEFINED
        self.fault: RobotFault | None = None
        self.registration: LinkRegistration | None = None
        self.insertion: Insertion | None = None
        self.drilling: Drilling | None = None
        self._holes: deque[Drilling] = deque(maxlen=MAX_KEPT)  # since the start, the newest last
        self.lease, self.outcomes = Lease(), Outcomes()
        self._clock = LoopClock()
        self._unread_s = 0.0
        self._plant, self._samples = plant, Samples(plant)
        self._activity: Activity | None = None
        self._next_fault = first_fault
        self._begun_s = 0.0  # LoopClock time of an activity's first cycle: the request before it may have taken long
        self._acted_s: float | None = None  # time of the current activity's last cycle
        self._commanded = np.zeros(self.robot.manipulator.count)
        self._rest = self.q  # position of the joints while the robot waits
        self._moving_for: tuple[int, str] | None = None
        self._stopped_s = 0.0

    # State and operations.

    @property
    def q(self) -> np.ndarray:
        """(n,): joint positions by the encoders, mm and rad."""
        return self._samples.latest.encoders

    @property
    def fed_mm(self) -> float:
        """Position of the feed by its encoder, mm."""
        return float(self.q[self.robot.manipulator.feed])

    @property
    def clock_s(self) -> float:
        """LoopClock time, s."""
        return self._clock.now_s

    @property
    def stop_pressed(self) -> bool:
        """Whether the stop button is pressed."""
        return PlantFlag.STOP_PRESSED in self._samples.latest.flags

    @property
    def run_held(self) -> bool:
        """Whether the hold-to-run switch is held."""
        return PlantFlag.RUN_HELD in self._samples.latest.flags

    @property
    def moves(self) -> bool:
        """Whether an activity is running, or the joints have not yet come to rest after a stop."""
        return self._activity is not None or self.outcomes.stopping

    def snapshot(self) -> Snapshot:
        """Return the current state for telemetry."""
        zero = self._depth_zero
        return Snapshot(
            self.state,
            self._samples.latest,
            self._samples.velocity,
            self.q if self._activity is None else self._activity.position,
            self._commanded,
            None if zero is None else zero.depth_mm(self.fed_mm),
            None if zero is None else zero.sd_mm,
            self.guide_off,
            self.fault,
        )

    def cycle(self, now_s: float, unread_s: float) -> None:
        """Run one cycle: read the plant, supervise, command. `unread_s`: see `Controller.cycle`."""
        self._clock.tick(now_s)
        self._unread_s = unread_s
        if self._acted_s is not None and now_s - self._acted_s > WATCHDOG_S:
            self._halt_by_itself(f"the control loop was {now_s - self._acted_s:.2f} s late", now_s)
        if self._acted_s is None:
            self._begun_s = self._clock.now_s
        self._samples.take(self._clock.now_s)
        self._supervise(now_s)
        self._act(now_s)
        if self._activity is None:
            self._commanded = np.zeros(self.robot.manipulator.count)
            self._plant.hold()
        self._report_stops(now_s)

    def begin(self, client: int, trigger: Trigger) -> Answer:
        """Enter the state that a command leads to; the caller has checked that it is legal. Returns the answer."""
        was = self.state
        self._enter(trigger)
        manipulator, insertion, q = self.robot.manipulator, self.insertion, self.q
        if trigger is Trigger.START_UP:
            self.forget()
        elif trigger is Trigger.MANUAL:
            self.insertion = None
        elif self.state is State.RETRACT:
            self._activity = retract(manipulator, q)
        elif self.state is State.ALIGN and insertion is not None:
            self._activity = align(manipulator, insertion, q)
            if manipulator.has_feed:
                self.drilling = Drilling(manipulator, insertion, self.setup.into_bone, self.open_hole(insertion))
        elif self.state is State.DRILL and self.drilling is not None:
            if self.drilling not in self._holes:
                self._holes.append(self.drilling)
            self.drilling.resume()
            self._activity = self.drilling
        if self._activity is None:
            return Answer(Code.OK)
        self._moving_for = (client, trigger.value)
        return Answer(Code.OK, f"from {was.value} to {self.state.value}", done=False)

    def stop(self, told: Sequence[Outcome], now_s: float) -> None:
        """Stop. `told`: outcomes to report once the joints stand still."""
        self._halt(now_s)
        for outcome in told:
            self.outcomes.stop(outcome)
        self._end_motion(Code.NOT_READY, "stopped by a client's STOP")
        self._enter(Trigger.STOP)

    def abandon(self, now_s: float) -> None:
        """Stop because the client is gone: report to nobody; clear registration and target."""
        self._moving_for = None
        self._halt(now_s)
        self._enter(Trigger.LOST)
        self.forget()

    def fail(self, code: Code, text: str, now_s: float) -> None:
        """Stop and enter EMERGENCY with a new fault (an existing fault is kept); only a person can reset it."""
        self._halt(now_s)
        if self.state is not State.EMERGENCY:
            self.fault = RobotFault(self._next_fault, code, text)
            self._next_fault += 1
        self._enter(Trigger.FAULT)
        self.forget()
        self.outcomes.add(Outcome(None, State.EMERGENCY.value, Code.EMERGENCY, text))
        self._end_motion(code, text)

    def reset(self) -> None:
        """Clear the fault and leave EMERGENCY. Raises RequestRefusedError while the stop button is pressed."""
        if self.stop_pressed:
            raise RequestRefusedError(Code.NOT_READY, "the stop button is pressed; release it at the robot")
        self.fault = None
        self._enter(Trigger.RESET)

    def open_hole(self, insertion: Insertion) -> Drilling | None:
        """Return the hole of this insertion, where it was begun; a stop, a fault or a lost client does not close it."""
        begun = (hole for hole in reversed(self._holes) if hole.bottom_mm is not None)
        return next((hole for hole in begun if hole.insertion.is_same(insertion)), None)

    def forget(self) -> None:
        """Clear registration, target and the hole in progress."""
        self.registration = self.insertion = self.drilling = None

    # Supervision.

    def _supervise(self, now_s: float) -> None:
        """End motion for reasons that hold in every activity."""
        if self.state is State.EMERGENCY:
            if self.panel.take_reset():
                try:
                    self.reset()
                except RequestRefusedError as refused:
                    answer = refused.answer
                    self.outcomes.add(Outcome(None, State.EMERGENCY.value, answer.code, answer.text))
            return
        self.panel.take_reset()  # discard a reset pressed before any fault
        missing = self._samples.missing(self._clock.now_s)
        if missing:
            self.fail(Code.HARDWARE, missing, now_s)
        elif self.stop_pressed and self.state is not State.UNDEFINED:
            self.fail(Code.EMERGENCY, "the stop button was pressed", now_s)
        elif self.state in ACTIVITIES:
            wrong = self._samples.wrong(self.robot.manipulator, self.state, self._rest) or self._guide_fault()
            reason = self._reason_to_halt(now_s) if self.state in MOVING else None
            if wrong:
                self.fail(Code.HARDWARE, wrong, now_s)
            elif reason:
                self._halt_by_itself(reason, now_s)

    @property
    def guide_off(self) -> tuple[float, float] | None:
        """How far the guide's mouth is from where it should be held, mm, and its direction, rad; None if it is not
        held."""
        manipulator, insertion = self.robot.manipulator, self.insertion
        if manipulator.has_feed or insertion is None or self.state not in (State.ALIGNED, State.GUIDE):
            return None
        held, now = manipulator.tool_matrix(np.stack([insertion.q, self.q]))[:, :3]
        return float(np.linalg.norm(now[:, 3] - held[:, 3])), float(angle_rad(held[:, 2], now[:, 2]))

    def _guide_fault(self) -> str | None:
        off = self.guide_off
        if off is None or off[0] <= GUIDE_FAULT_MM:
            return None
        return f"the guide is {off[0]:.1f} mm from the plan (at most {GUIDE_FAULT_MM:g} mm): it was pushed away"

    def _reason_to_halt(self, now_s: float) -> str | None:
        if not self.run_held:
            return "the hold-to-run switch was released"
        if self.state is not State.RETRACT and self.insertion is not None and now_s > self.insertion.expires_s:
            return "the plan has expired"
        return self.lease.silence(self._begun_s, self._clock.now_s, self._unread_s)

    def _act(self, now_s: float) -> None:
        if self._activity is None:
            return
        step = self._activity.step(self._samples.latest, now_s)
        if step.trigger is None:
            self._acted_s = now_s
            self._commanded = step.velocity
            self._plant.command(step.velocity, step.drill_on)
        elif step.trigger is Trigger.FAULT:
            self.fail(Code.HARDWARE, step.text, now_s)
        elif step.trigger is Trigger.HALT:
            self._halt_by_itself(step.text, now_s)
        else:
            retracted, self._rest = self.state is State.RETRACT, self._activity.position
            self._halt(now_s)
            self._enter(step.trigger)
            if retracted:
                self.insertion = None  # nothing is drilled again before its target is sent again
            self._end_motion(Code.OK, self.state.value)

    def _halt_by_itself(self, reason: str, now_s: float) -> None:
        self._halt(now_s)
        self._enter(Trigger.HALT)
        self._end_motion(Code.NOT_READY, reason)

    def _report_stops(self, now_s: float) -> None:
        """Report stops once the joints stand still; fail if they do not within STOP_S."""
        if self.outcomes.stopping and not self._samples.still(self.robot.manipulator):
            if now_s - self._stopped_s <= STOP_S:
                return
            self.outcomes.still_move("the joints still move")
            self.fail(Code.HARDWARE, f"the joints still move {STOP_S:g} s after a stop", now_s)
        self.outcomes.stand()

    # Helpers.

    def _enter(self, trigger: Trigger) -> None:
        self.state = TRANSITIONS[self.state, trigger]

    def _halt(self, now_s: float) -> None:
        """Stop the joints and the drill, and end the activity."""
        self._plant.hold()
        self._activity = self._acted_s = None
        self._commanded = np.zeros(self.robot.manipulator.count)
        self._stopped_s = now_s

    def _end_motion(self, code: Code, text: str) -> None:
        if self._moving_for is not None:
            self.outcomes.conclude(Outcome(*self._moving_for, code, text))
            self._moving_for = None

    @property
    def _depth_zero(self) -> DepthZero | None:
        """Depth zero of the hole in progress, else of the plan."""
        if self.insertion is None or not self.robot.manipulator.has_feed:
            return None
        if self.drilling is not None:
            return self.drilling.zero
        return DepthZero(float(self.insertion.q[self.robot.manipulator.feed]))
