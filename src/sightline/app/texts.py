"""Texts of the page that are used in more than one place, or chosen by a key; and how values are written."""

import re
from collections.abc import Sequence

from sightline.case.views import ImageSlot, spoken
from sightline.common.checks import Check, CheckCode
from sightline.planning.procedures import kind as kind_of

_PA = re.compile(r"\bpa\b")  # in the sentence of a check
_NEGATIVE_ZERO = re.compile(r"(?<![\w.])-(0(?:\.0*)?)(?!\.?\d)")
_IMAGE_OF = {"": "image", "check": "check image", "shot": "shot"}  # by what an image is taken for
STEPS = {"images": "Images", "calibrate": "Calibrate", "plan": "Plan", "drill": "Drill", "verify": "Verify"}
DROP_LABELS = {"pa": "PA image", "lateral": "Lateral image", "oblique": "Oblique image (optional)"}
STALE = "This image is {age:.1f} s old and may be out of date. The plan over it is hidden."
STEP_STATUS = {"done": "done", "open": "to do", "attention": "needs attention", "blocked": "blocked"}
XRAY = {
    "fit": "Show the whole image",
    "window": "Brightness and contrast: drag on the image",
    "measure": "Ruler: click two places for a length, a third for an angle",
    "link": "Zoom all images together",
    "bone": "Bone",
    "metal": "Metal",
    "beads": "Beads",
    "invert": "Invert black and white",
    "flip": "Mirror the display",
    "rotate": "Rotate the display by 90°",
    "reset": "Reset the display",
    "maximise": "Enlarge this image",
    "restore": "Show both images",
    "point": "{name}: column {u}, row {v}",
    "snapped": "on the matching curve",
    "placing": "Click to place: {name}, or arrow keys and Enter. Escape cancels.",
    "mirrored": "mirrored",
    "rotated": "rotated by {degrees}°",
    "head_up": "head up",
    "head_right": "head to the right",
    "head_down": "head down",
    "head_left": "head to the left",
    "stale": "Plan hidden: the image is out of date",
    "edit_lost": "Repeat the last change of {name}: the image or the plan changed before it was saved.",
    "load_failed": "Reload the page: the image could not be loaded.",
    "readout": "column {u}, row {v}: {value}",
    "outside": "–",
    "off_field": "Click inside the X-ray field.",
    "held_in_field": "Outside the X-ray field: the point was put on its edge. Drag it to its place.",
}
TICKS = "mm along the line of sight of the other image, a tick every 10 mm"
MEASURED = "Green: the wire where this image shows it, and its tip. Dashed: the plan."
ORIENTATION = {
    "right": "Right side: +Y of the frame points to the feet.",
    "left": "Left side: +Y of the frame points to the head.",
}
SPACE_TEXTS = {
    "feet": "From the feet",
    "side": "From the side",
    "above": "From above",
    "hip": "Wire",
    "frame": "Frame",
    "room": "Room",
    "keys": "Arrow keys rotate the scene, with Shift they move it; plus and minus zoom.",
    "none": "This browser does not support 3-D graphics (WebGL). Planning works without it.",
}
SPACE_AXES = {"feet": "Along Y", "side": "Along X", "above": "Along Z"}  # beside a block, which has no patient axes
SPACE_GROUPS = {
    "frame": "frame",
    "views": "focal points and images",
    "sights": "lines of sight",
    "points": "landmarks",
    "bone": "bone",
    "wire": "planned wire",
    "drilled": "measured wire",
    "robot": "robot",
    "sides": "sides",
}
LINK_LOST = "The link to the robot is lost: if the robot still moves, press its red button. Then start it again."
ROBOT_NEXT = {  # what to do next, by the robot's state; of the others the state itself
    "TARGETING": "The robot has the plan: clear the arm's path, then align.",
    "ALIGN": "The arm is moving: STOP or the space bar stops it.",
    "ALIGNED": "Aligned: check the confirmation shot, then drill.",
    "DRILL": "The wire is advancing: STOP or the space bar stops it.",
    "PAUSED": "Paused: check the second shot, then continue drilling.",
    "DONE": "Drilled: open the chuck and retract, then go on with the next wire.",
    "STOP": "Stopped: see why, then align again, or retract the wire.",
    "RETRACT": "The wire is retracting: STOP or the space bar stops it.",
}
ONLY_GO = "Complete the plan first: only a plan that is GO can be sent."
SIDE_HEADING = "Patient's side"
IDENTITY, SIDE_UNKNOWN = "{side} · {case}", "Side?"
DISPLAY_AND = " and "
POINT_GROUPS = {
    "wire": "Wire",
    "landmark": "Landmarks: did the bone move?",
    "aid": "Aids",
}
PLACE_WHAT = "Place {what}"
PROPOSE_OTHERS = "Propose the other wires"
SKIP = "Skip"
SKIP_TITLE = "A plan needs two landmarks, a check shot of the drilled wire three."
WIRE_STATES = {  # of a wire, by its verdict and by what was done
    "missing": "not placed",
    "go": "GO",
    "no-go": "NO-GO",
    "incomplete": "INCOMPLETE",
    "sent": "sent",
    "drilled": "drilled",
    "verified": "verified",
    "refuted": "NOT verified",
}
LACKS = {  # of the chosen procedure, by what the simulated patient does not have: what is wrong, and what to do
    "hip": ("The simulated patient has no hip.", "Choose another procedure, or begin another case: sightline app"),
    "nail": (
        "The simulated patient has no nail.",
        "Choose another procedure, or begin another case: sightline app --procedure distal-interlocking",
    ),
    "pelvis": (
        "The simulated patient has no sacrum.",
        "The app simulates none; choose another procedure, or see: sightline demo --procedure iliosacral-screw",
    ),
    "vertebra": (
        "The simulated patient has no vertebra.",
        "The app simulates none; choose another procedure, or see: sightline demo --procedure pedicle-screw",
    ),
    "growing-femur": (
        "The simulated patient has no growth plate.",
        "The app simulates none; choose another procedure, or see: sightline demo --procedure slipped-epiphysis-pin",
    ),
}
SEARCHING_NAIL = "Searching the nail in both images."
RULER_SPACE = "Measured in space, from both images. Error: 95 %."
RULER_NEEDS_WIRE = "Place the wire first: the ruler measures in its plane."
CURVE_TITLE = "where the {name} point may lie"
VERDICTS = {"go": "GO", "no-go": "NO-GO", "incomplete": "INCOMPLETE"}
MORE = "(and {count} more: Details)"
LEFT = "To do: {what}."
FIGURES = {  # by the check that states them; of a procedure's own ones the first that it has
    CheckCode.ENTRY_ERROR: "Entry, 95 % error",
    CheckCode.END_ERROR: "Tip, 95 % error",
    CheckCode.DIRECTION_ERROR: "Direction, 95 % error",
    CheckCode.TIP_APEX_DISTANCE: "Tip-apex distance",
    CheckCode.TIP_IN_HEAD: "Tip to joint",
    CheckCode.TIP_BEHIND_FRONT: "Tip to front",
    CheckCode.TIP_IN_SACRAL_CORRIDOR: "Tip in corridor",
    CheckCode.WIRE_IN_SACRAL_CORRIDOR: "Wire in corridor",
    CheckCode.WIRE_IN_PEDICLE: "Wire in pedicle",
    CheckCode.WIRE_IN_NECK: "Wire in neck",
    CheckCode.TIP_TO_BONE_NEAREST: "Tip to bone",
    CheckCode.MOVEMENT: "Bone movement",
}
FIGURE_MOVED = ("seen", "none seen")  # of a movement between three images, which has no single value in mm
FIGURE_PASSED, FIGURE_FAILED = "within its limit", "beyond its limit"
TIME_UNDER = {"left": "min left", "expired": "expired", "done": "drilled", "unknown": "min left"}
TIME_TOLD = {
    "left": "The images are {age} min old. The plan expires ten minutes after the older one was taken.",
    "expired": "Take both images again (step Images): the plan has expired.",
    "done": "The images were {sent} min old when the plan was sent; the wire is drilled.",
    "unknown": "The time left is known once both images and their times are.",
}
LINKS = {"none": "no robot", "open": "connected", "lost": "link lost: use the red button"}
DETAILS = "Details"
SHARES_OF = {"entry": "entry", "end": "tip", "direction": "direction"}
STATE_UNKNOWN = "Getting ready"
STATES = {
    "UNDEFINED": "Not ready: send the plan",
    "START_UP": "Ready for a plan",
    "PLANNING": "Ready for a plan",
    "CALIBRATION": "Ready for a plan",
    "TARGETING": "Plan received; not moving",
    "MANUAL": "Moved by hand",
    "STOP": "Stopped",
    "EMERGENCY": "Emergency stop",
    "ALIGN": "Aligning the arm",
    "ALIGNED": "Aligned; waiting for you",
    "DRILL": "Drilling",
    "PAUSED": "Paused for the second shot",
    "DONE": "Drilled",
    "GUIDE": "Holding the drill guide",
    "RETRACT": "Retracting the wire",
}
RETRACT = "Retract: if the wire is to stay in the bone, open the chuck first. Is it open?"
GUIDE_BACK = "Draw the guide back along the wire, 60 mm. Is the drill off the wire?"
ALIGN_QUESTION = (
    "Align: the wire retracts into its sleeve, then the whole arm moves. Is its path clear of people, table and C-arm?"
)
ALIGN_GUIDE_QUESTION = (
    "Align: the arm moves to the line without a wire, then along it. Is the block off, and is its path clear of "
    "people, table and C-arm?"
)
HOLD = "Hold the guide"
HOLD_QUESTION = (
    "Hold the guide while a person drills through it. Does the confirmation shot show the guide on the plan?"
)
DRILL_QUESTION = (
    "Drill: the wire rotates and advances into the bone, to {left:.0f} mm before its planned depth. Does the sleeve "
    "stand on the bone, and does the confirmation shot show the guide on the plan?"
)
DRILLED_BY_HAND = "Drilled by hand; the robot does not know how deep. Verify the wire in two check images."
SEND = "Send the plan"
ALIGN = "Align"
DRILL = "Drill"
DRILL_ON = "Continue drilling"
SHOT_HEADINGS = {"ALIGNED": "Confirmation shot", "PAUSED": "Second shot"}
SHOT_MEASURING = "Measuring the wire …"
FRAME_IS_ON = ("The frame is on the arm again", "The frame is fixed to the patient")
FRAME_ON_QUESTIONS = (
    "Is the frame on its mount on the robot again, as at the planning images?",
    "Was the frame of the plan taken off the robot and fixed to the patient? It must stay at rest from the first to "
    "the second image of each shot.",
)
SHOT_NOT_WAITING = (
    "take the shot while the robot waits, aligned or at the pause, with a block or a frame fixed to the patient; send "
    "a depth only at GO"
)
CHECK_IMAGE = "{image}: {state}"
CHECK_VERDICT = (  # word and sentence, of a failed and of a passed one
    ("FAILED", "The check shot did not pass."),
    ("PASSED", "The check shot passed: the wire lies as planned."),
)
STOP_IS_NO_EMERGENCY_STOP = (
    "In an emergency press the red button at the robot. STOP and the space bar only ask the robot's program to stop."
)
ZEROS = {"plan": "plan", "contact": "contact", "shot": "second shot"}  # sources of the zero of depth
NO_ROBOT = (
    "Take the images through a robot's link, or rehearse on the demo case: these images carry no robot pose, so the "
    "bone's position in robot coordinates is unknown."
)
CHANGED_AFTER_SENDING = "Send the plan again, or undo the change: it was changed after it was sent."
CLOSE = "Close"
REPORT = "Save the report"
EXPORT = "Export"
EXPORTED = (
    "{file} is in the case and was sent to this browser: report, plan, picks, frame and images, without the patient's "
    "name. Look at the images before you hand it on: writing in them stays{found}."
)
CASES = "Cases"
CASE_OPEN = "Open"


def sentence(check: Check, kind: str = "", views: Sequence[str] = ()) -> str:
    """Return the sentence of a check, with the names of its views as a person writes them: "PA" for "pa", and zeros
    without a sign. It begins with the `views` that it is said of, by default its own, as the procedure `kind`, if
    given, calls them."""
    of = views or ((check.view,) if check.view else ())
    names = [spoken(view, kind_of(kind) if kind else None) for view in of]
    of_view = titled(DISPLAY_AND.join(names)) + ": " if names else ""
    return of_view + _PA.sub("PA", unsigned(check.sentence.removeprefix(f"{check.view}: ")))


def unsigned(text: str) -> str:
    """Return a text whose zeros have no sign: "0.0" for "-0.0"."""
    return _NEGATIVE_ZERO.sub(r"\1", text)


def titled(text: str) -> str:
    """Return a text that begins with a capital."""
    return text[:1].upper() + text[1:]


def in_progress(work: str) -> str:
    """Return a note that work is in progress."""
    return f"{titled(work)} …"


def image_name(image: str, kind: str) -> str:
    """Return the name of an image of a procedure, by its key, as in a sentence: "PA image", "inlet check image"."""
    return f"{_view(image, kind)} {_IMAGE_OF[ImageSlot.read(image).purpose]}"


def image_label(image: str, kind: str) -> str:
    """Return the name of an image as on a label: "PA image", "Inlet check image"."""
    return titled(image_name(image, kind))


def image_short(image: str, kind: str) -> str:
    """Return the name of an image's view where there is little room: "PA", "lat", "inlet"."""
    view = _view(image, kind)
    return {"lateral": "lat", "oblique": "obl"}.get(view, view)


def in_image(image: str, kind: str) -> str:
    """Return the name of an image as in an instruction: "PA", "INLET CHECK"."""
    return f"{_view(image, kind)} {ImageSlot.read(image).purpose}".strip().upper()


def _view(image: str, kind: str) -> str:
    """Return an image's view as the procedure calls it."""
    return spoken(ImageSlot.read(image).view, kind_of(kind))
