"""Dialects: how the robot's answers differ for clients that know only the convention of 2013."""

from dataclasses import dataclass

from sightline.robot.contract import Code


@dataclass(frozen=True)
class Dialect:
    """The variable parts of the robot's answers.

    `tells_entered`: a STATUS is sent on entering PLANNING and CALIBRATION. `tells_reachable`: REACHABLE_TARGET is sent.
    `names_commanded`: CURRENT_STATUS names the phase of a refused command instead of the robot's. `in_manual`: code for
    a motion refused in MANUAL. `own_emergency`: code of STATUS EMERGENCY for the client that sent it. `own_frames`:
    registrations map a base frame of the robot to a patient frame other than CFCS (`Setup.frames`).
    """

    tells_entered: bool = True
    tells_reachable: bool = True
    names_commanded: bool = False
    in_manual: Code = Code.MANUAL
    own_emergency: Code = Code.EMERGENCY
    own_frames: bool = False


SIGHTLINE = Dialect()
BRP2013 = Dialect(
    tells_entered=False,
    tells_reachable=False,
    names_commanded=True,
    in_manual=Code.NOT_READY,
    own_emergency=Code.OK,
    own_frames=True,
)
DIALECTS = {"sightline": SIGHTLINE, "brp2013": BRP2013}
