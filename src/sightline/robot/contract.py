"""Names and time limits of the link's contract (docs/robot-link.md), shared by both ends."""

from enum import IntEnum

ACK_S, STATUS_S = 1.0, 5.0  # time limits for acknowledgement and STATUS [what testers of other robots expect]
SILENCE_S = 0.2  # silence of the lease holder after which motion stops [physics.md, Drilling]
HEARTBEAT_S = SILENCE_S / 4  # between a client's heartbeats: three may be late
IDLE_S = ACK_S  # between heartbeats of a client with no pending call; counts as silence during motion
ALIVE_S = ACK_S  # a call of our client without progress for this long has hung: its heartbeats end
MUTE_S = 2 * STATUS_S  # a client that has sent nothing by then is disconnected
TELEMETRY_S = 0.02  # between two messages of a stream; displays refresh no faster [ours]
# Requests that may wait, requests with their answers, and plans: so many are kept of each. A repeat comes within a few
# messages of the first, and a robot sees a few plans in the ten minutes that one is valid [ours].
MAX_KEPT = 256
ARM = "arm"  # prefix of telemetry names

# Device names. A command is named by its kind, "_" and an identifier; its acknowledgement repeats the identifier.
COMMAND, CALIBRATION, TARGET, ACKNOWLEDGED = "CMD_", "CLB_", "TGT_", "ACK_"
HEARTBEAT = "HEARTBEAT"
# A client that cannot read STATUS sends a STRING named MIRROR_STATUS; each STATUS then also goes out as a STRING named
# MIRRORED.
MIRROR_STATUS, MIRRORED = "MIRROR_STATUS", "STATUS"
CURRENT_STATUS, CURRENT_POSITION = "CURRENT_STATUS", "CURRENT_POSITION"
MEASURED_CP, MEASURED_JS = f"{ARM}/measured_cp", f"{ARM}/measured_js"
FORCE, DEPTH, CYCLES = f"{ARM}/force", f"{ARM}/depth", f"{ARM}/cycles"
DEPTH_SD = f"{ARM}/depth_sd"  # standard deviation of the depth
OPEN_HOLE_DEPTH = f"{ARM}/open_hole"  # depth of the target's hole, if it was begun before
OPEN_HOLE = "open hole"  # event; also in TARGET's STATUS, for people
GUIDE_OFF = f"{ARM}/guide_off"  # of a held guide from the plan: mm, rad
EVENT = f"{ARM}/event"  # event from drilling supervision: "break-through; 5.31 mm; 12.4 N"

# Capabilities that a peer may announce in CAPABILITY beside message types, at most twelve characters each.
HAS_HEARTBEAT = "X_HEARTBEAT"  # client: sends heartbeats, stop when they end; robot: watches heartbeats
HAS_TELEMETRY = "X_TELEMETRY"  # client: wants the streams; robot: sends streams
HAS_DRILLING = "X_DRILLING"  # robot: knows DRILL, GUIDE and RETRACT; client: drills by DRILL only
HAS_GUIDE = "X_GUIDE"  # robot: it has no feed; GUIDE instead of DRILL
HAS_PLAN = "X_PLAN"  # robot: a target may carry a plan's identity
IS_SIMULATED = "X_SIMULATOR"  # robot: a simulator, nothing real moves
HAS_RESET = "X_RESET"  # robot: a person may reset it over the link

# Names of COMMAND messages.
RESET = "RESET"  # resets after a fault; text: the number of the fault that the person has read
SHOT_DEPTH = "SHOT_DEPTH"  # text: depth of the tip beyond the entry point in the check shot, mm, and its s.d.
SIMULATED_WIRE = "SIMULATED_WIRE"  # simulators only: the true pose of the wire, for simulated images

# Metadata keys of a target. A target with PLAN must carry all of PLAN_KEYS.
UNITS, COORDINATES, PLAN = "units", "coordinates", "plan"
SIDE, FRAME_SERIAL, GO = "side", "frame_serial", "go"
LENGTH_MM, DEPTH_LIMIT_MM, VALID_S = "length_mm", "depth_limit_mm", "valid_s"
PLAN_KEYS = (PLAN, SIDE, FRAME_SERIAL, GO, UNITS, COORDINATES, LENGTH_MM, DEPTH_LIMIT_MM, VALID_S)
# Optional metadata: the fingerprint of the frame's file, the procedure's key, the plan's accuracy limits, how much of
# LENGTH_MM lies past the planned end point, and how far before the entry point bone may begin.
FRAME, KIND, POSITION_LIMIT_MM, DIRECTION_LIMIT_DEG, BEYOND_MM, BEFORE_MM = (
    "frame",
    "kind",
    "position_limit_mm",
    "direction_limit_deg",
    "beyond_mm",
    "before_mm",
)
NO_SERIAL = "none"  # FRAME_SERIAL of a frame without one
YES, NO = "yes", "no"
MM, CFCS, MCS = "mm", "CFCS", "MCS"


class Code(IntEnum):
    """STATUS codes of OpenIGTLink that this link uses."""

    OK = 1
    EMERGENCY = 3
    DENIED = 5  # another client holds the command lease
    CONFIGURATION = 10  # the registration or target is not usable
    UNKNOWN = 12  # no such command
    NOT_READY = 13  # not possible in this state
    MANUAL = 14
    HARDWARE = 18
