"""The robot's reports on itself: state, pose, joints and streams, as (device name, body)."""

from dataclasses import dataclass, field

import numpy as np

from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.machine import Machine
from sightline.robot.control.requests import Snapshot
from sightline.robot.control.states import phase
from sightline.robot.igtl import MILLIMETRE, NEWTON, NDArray, Sensor, Status, Transform
from sightline.robot.link.outgoing import NamedBody


@dataclass
class Cycles:
    """Statistics of the control loop: cycles, cycles that were late, and the largest delay, s."""

    count: int = 0
    missed: int = 0
    worst_s: float = 0.0


@dataclass(frozen=True)
class Telemetry:
    """Reports on one machine and the timing of its control loop."""

    machine: Machine
    cycles: Cycles = field(default_factory=Cycles)

    def current(self) -> Status:
        """Return CURRENT_STATUS: the phase, with state or fault in the text; always code 1."""
        state, fault = self.machine.state, self.machine.fault
        text = state.value if fault is None else f"fault {fault.number}: {fault.text}"
        return Status(Code.OK, phase(state), text, subcode=0 if fault is None else fault.number)

    def state_now(self) -> NamedBody:
        """Return the answer to a status query: named after the phase, with the code of its fault."""
        status, fault = self.current(), self.machine.fault
        code = Code.OK if fault is None else fault.code
        late = f"; {self.cycles.missed} of {self.cycles.count} cycles were late"
        return phase(self.machine.state), Status(code, status.error_name, status.text + late, status.subcode)

    def position(self) -> NamedBody:
        """Return the wire's pose, CFCS; before a registration, a STATUS that refuses."""
        registration = self.machine.registration
        if registration is None:
            text = (
                f"no registration, so no position in {contract.CFCS}; {contract.MEASURED_CP} has it in {contract.MCS}"
            )
            return contract.CURRENT_POSITION, Status(Code.NOT_READY, "UNCALIBRATED", text)
        tool = self.machine.robot.manipulator.tool_matrix(self.machine.q)
        return contract.CURRENT_POSITION, Transform(registration.T_mcs_cfcs.inv().as_matrix() @ tool)

    def joints(self, now: Snapshot) -> NamedBody:
        """Return (6, 5): position, velocity, commanded position, commanded velocity, lower and upper limit; mm, rad."""
        lower, upper = self.machine.robot.manipulator.lower, self.machine.robot.manipulator.upper
        rows = np.stack([now.reading.encoders, now.velocity, now.wanted, now.commanded, lower, upper])
        return contract.MEASURED_JS, NDArray(rows)

    def streams(self, now: Snapshot) -> list[NamedBody]:
        """Return all streams except the pose in CFCS."""
        tool = self.machine.robot.manipulator.tool_matrix(now.reading.encoders)
        bodies: list[NamedBody] = [
            (contract.MEASURED_CP, Transform(tool)),
            self.joints(now),
            (contract.FORCE, Sensor(np.array([now.reading.force_n]), NEWTON)),
            (contract.CYCLES, Sensor(np.array([self.cycles.count, self.cycles.missed, self.cycles.worst_s]))),
            (contract.CURRENT_STATUS, self.current()),
        ]
        for name, value in ((contract.DEPTH_SD, now.depth_sd_mm), (contract.DEPTH, now.depth_mm)):
            if value is not None:
                bodies.append((name, Sensor(np.array([value]), MILLIMETRE)))
        return bodies
