"""The words and times of the link's contract, docs/robot-link.md. Both ends take them from here."""

from enum import IntEnum

ACK_S, STATUS_S = 1.0, 5.0  # an answer's acknowledgement and status come within [what testers of other robots expect]
SILENCE_S = 0.2  # of the leaseholder, before motion stops [physics.md, Drilling]
HEARTBEAT_S = 0.05  # between a client's heartbeats: three may be late [ours]
IDLE_S = 1.0  # between the heartbeats of a client that waits for nothing: silence, if anything moves [ours]
ALIVE_S = 1.0  # a call of our client that has not gone on for so long hangs, and sends no more heartbeats [ours]
MUTE_S = 10.0  # a client that has said nothing by then is cut off [ours]
TELEMETRY_S = 0.02  # between two of a stream [ours]: a display shows no more
ARM = "arm"  # how names of telemetry begin

# Device names. A command's is its kind, "_" and an identifier that its acknowledgement carries too.
COMMAND, CALIBRATION, TARGET, ACKNOWLEDGED = "CMD_", "CLB_", "TGT_", "ACK_"
HEARTBEAT = "HEARTBEAT"
# A client that cannot read STATUS asks by a STRING of the first name for each as a STRING of the second.
MIRROR_STATUS, MIRRORED = "MIRROR_STATUS", "STATUS"
CURRENT_STATUS, CURRENT_POSITION = "CURRENT_STATUS", "CURRENT_POSITION"
MEASURED_CP, MEASURED_JS = f"{ARM}/measured_cp", f"{ARM}/measured_js"
FORCE, DEPTH, CYCLES = f"{ARM}/force", f"{ARM}/depth", f"{ARM}/cycles"
DEPTH_SD = f"{ARM}/depth_sd"  # error of depth, 1 s.d.
EVENT = f"{ARM}/event"  # what supervision noticed: "break-through; 5.31 mm; 12.4 N"

# What a peer may announce in its CAPABILITY beside types of messages, in their twelve characters.
HAS_HEARTBEAT = "X_HEARTBEAT"  # client: I send heartbeats, stop when they end; robot: I watch them
HAS_TELEMETRY = "X_TELEMETRY"  # client: send me the streams; robot: I have them
HAS_DRILLING = "X_DRILLING"  # robot: DRILL, GUIDE and RETRACT are commands; client: I drill by DRILL alone
HAS_PLAN = "X_PLAN"  # robot: a target may carry a plan's identity
IS_SIMULATED = "X_SIMULATOR"  # robot: nothing real moves
HAS_RESET = "X_RESET"  # robot: a person may reset it over the link

RESET = "RESET"  # name of the COMMAND that does, its text the number of the fault that the person has read
SHOT_DEPTH = "SHOT_DEPTH"  # another: how far beyond the entry point the check shot shows the tip, mm, and its s.d.
SIMULATED_WIRE = "SIMULATED_WIRE"  # a third, of simulators alone: where the wire truly is, for simulated images

# Metadata of a target. Where PLAN stands all others must.
UNITS, COORDINATES, PLAN = "units", "coordinates", "plan"
SIDE, FRAME_SERIAL, GO = "side", "frame_serial", "go"
LENGTH_MM, DEPTH_LIMIT_MM, VALID_S = "length_mm", "depth_limit_mm", "valid_s"
PLAN_KEYS = (PLAN, SIDE, FRAME_SERIAL, GO, UNITS, COORDINATES, LENGTH_MM, DEPTH_LIMIT_MM, VALID_S)
# And what a target may say besides: the kind of trajectory, the limits that the plan was judged by, and how much of
# LENGTH_MM lies past the planned end point.
KIND, POSITION_LIMIT_MM, DIRECTION_LIMIT_DEG, BEYOND_MM = (
    "kind",
    "position_limit_mm",
    "direction_limit_deg",
    "beyond_mm",
)
YES, NO = "yes", "no"
MM, CFCS, MCS = "mm", "CFCS", "MCS"


class Code(IntEnum):
    """Codes of STATUS that are used, of those that OpenIGTLink lists."""

    OK = 1
    EMERGENCY = 3
    DENIED = 5  # another client holds the command lease
    CONFIGURATION = 10  # a registration or target that cannot be used
    UNKNOWN = 12  # no such command
    NOT_READY = 13  # not in this state
    MANUAL = 14
    HARDWARE = 18
