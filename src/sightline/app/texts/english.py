"""All texts of the page, in English. Other languages have files with the same keys (`languages.py`)."""

STEPS = {"images": "Images", "calibrate": "Calibrate", "plan": "Plan", "drill": "Drill", "verify": "Verify"}
IMAGE_LABELS = {
    "pa": "PA image",
    "lateral": "Lateral image",
    "oblique": "Oblique image",
    "check-pa": "PA check image",
    "check-lateral": "Lateral check image",
    "shot-pa": "PA shot",
    "shot-lateral": "Lateral shot",
}
IMAGE_OF_VIEW = {"": "{view} image", "check": "{view} check image", "shot": "{view} shot"}  # of other views
IMAGE_NAMES = {
    name: label.replace("Lateral", "lateral").replace("Oblique", "oblique") for name, label in IMAGE_LABELS.items()
}
DROP_HERE = "Drop the {image} here"
DROP_OR = "or"
DROP_CHOOSE = "Choose a file"
DROP_ANOTHER = "Load another image"
DROP_AND = " and the "
DROP_READING = "reading {file}"
DROP_TOO_MANY = "at most {count} images at a time"
DROP_TOO_LARGE = "{file} has more than {size} MB; export a single image"
DROP_LOST = "the image did not reach the app; is it still running?"
DROP_REFUSED = "refused ({status})"
DROP_LABELS = {**IMAGE_LABELS, "oblique": "Oblique image (optional)"}
LIVE_LABELS = {"pa": "PA, live", "lateral": "Lateral, live"}
LIVE_UNKNOWN = "Live, view unknown"
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
    "placing": "Click to place: {name}, or steer by arrow keys and press Enter. Escape cancels.",
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
    "ticks": "mm along the line of sight of the other image, a tick every 10 mm",
}
ORIENTATION = {
    "right": "Right side: +Y of the frame points to the feet.",
    "left": "Left side: +Y of the frame points to the head.",
}
SPACE_LABEL = "3-D scene: frame, views, wire, robot"
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
SPACE_FOCUS = "focal point, {view}"
SPACE_ERROR_UNKNOWN = "the error of the wire's ends is unknown"
SPACE_ELLIPSOIDS = "Ellipsoids hold 95 % of the error of entry and tip, {times:g} times as large"
SPACE_GROUPS = {
    "frame": "frame",
    "views": "focal points and images",
    "sights": "lines of sight",
    "points": "landmarks",
    "bone": "bone",
    "wire": "planned wire",
    "drilled": "drilled wire",
    "robot": "robot",
    "sides": "sides",
}

# The steps, with the reason for each status.
DOING = "{doing}."
DROP_MISSING = "Drop the {images} onto the page."
LOAD_ANOTHER = "Load another {image}: this one cannot be used."
CONFIRM_BOTH = "Confirm the patient's side and the frame's serial."
STATE_WHETHER_MIRRORED = "State whether writing in the images reads backwards."
STATE_WHEN_TAKEN = "State when the images without a recorded time were taken."
IMAGES_DONE = "Both images are loaded; side and frame are confirmed."
IMAGES_FIRST = "Load both images first."
SAME_VIEW = "Load another image: both show the same view."
CALIBRATED = "Both views are calibrated, and every check passed."
CALIBRATE_FIRST = "Calibrate both views first."
PLACE_WIRE = "Place in both images: {points}."
PLAN_DONE = "GO: every check passed."
DRILL_DONE = "Drilling is done."
LINK_LOST = "The link to the robot is lost: if the robot still moves, press its red button. Then start it again."
ROBOT_IN = "{state}."
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
CAN_START = "Start the robot, then send the plan."
CAN_SEND = "Send the plan to the robot."
NO_ROBOT_IN_IMAGES = "These images carry no robot pose: the plan cannot be sent to a robot. Save its report."
VERIFIED = "The wire was measured in two check images and lies as planned."
NOT_DRILLED = "Nothing has been drilled yet."
GO_ON_VERIFYING = "This wire lies as planned: go on with the next one."
TAKE_TWO_MORE = "Take two check images with the wire in the bone."

# Images.
IMAGES_HEADING = "Images"
PUT_WHERE_IT_BELONGS = "By its markers this is the {image}; it was loaded there."
NO_IMAGE = "{image}: none yet"
NO_OBLIQUE = "{image}, optional, taken last: none yet. It shows movements of the patient that two images do not show."
SLOT_TELLS_THE_VIEW = "A block looks alike in every view: each image is the view under whose name you load it."
SHOW_OBLIQUE = "Show the oblique image on the right"
IMAGE_SIZE = "{image}: {width} × {height}"
IMAGE_BEADS = "{image}: {width} × {height}, {beads} beads found"
REHEARSING = "This case rehearses on a simulated patient."
TAKE_AGAIN = "Take both images again"
TAKE_OBLIQUE = "Take the oblique image"
SIDE_HEADING = "Patient's side"
SIDE_HINT = "Which side? Check the marker in the image, or the patient:"
SIDES = {"right": "Right side", "left": "Left side"}
SERIAL_HEADING = "Frame's serial"
SERIAL_CONFIRMED = "Confirmed: {serial}"
SERIAL_UNKNOWN = "Type the serial engraved on the frame, or “none” if there is none. The frame file states none."
SERIAL_KNOWN = "Type the serial engraved on the frame. It must match the frame file."
SERIAL_FIELD = "Serial on the frame"
SERIAL_CONFIRM = "Confirm serial"
SERIAL_REFUSED = "type the serial as engraved on the frame, or “none” if there is none"
TAKEN_HEADING = "When the images were taken"
TAKEN_UNKNOWN = "{image}: time unknown. The file states none, or one after its arrival; then compare the clocks."
TAKEN_FIELD = "{image}: taken, minutes ago"
TAKEN_CONFIRM = "Confirm the time"
TAKEN_REFUSED = "enter the minutes since the image was taken, 0 or more"
MIRRORED_HEADING = "Mirrored displays"
MIRRORED_HINT = (
    "Both images show the frame mirrored. Either the displays are mirrored, or the frame file is wrong and so is every "
    "point. Look at writing in an image, as this page shows it, and answer for at least one image:"
)
MIRRORED_FIELD = "{image}: writing reads"
MIRRORED_ANSWERS = ("forwards", "backwards")
MIRRORED_SAID = ("{image}: the file shows it unmirrored", "{image}: the file shows it mirrored")
MIRRORED_REFUSED = "wait until the image is calibrated, then answer"
DISPLAY_HEADING = "Display"
DISPLAY_SHOWN = "{image}: {how}"
DISPLAY_AND = " and "

# Calibrate.
ALL_PASSED = "All {count} checks passed"
SHOW_REJECTED = "Show rejected candidates, with the reason"
DROP_FIRST = "Drop an image onto the page."
BEADS_USED = "beads used / left out"
RESIDUAL = "residual, rms"
FOCAL_POINT = "focal point, mm"

# Plan.
POINT_GROUPS = {
    "wire": "Wire",
    "landmark": "Landmarks: did the bone move?",
    "aid": "Aids",
    "robot": "Where is the robot?",
}
IMAGES_SHORT = {"pa": "PA", "lateral": "lat", "oblique": "obl"}
KIND_FIELD = "Procedure"
SNAP = "Snap points of the wire to their curves"
BY_BORDERS = "Draw axes by both borders of the bone"
SHOW_BEADS = "Show the beads"
PLACE_WHAT = "Place {what}"
REMOVE_WHAT = "Remove {what}"
PROPOSE = "Propose wire"
PROPOSE_WHAT = "Propose a wire from the drawn aids"
PROPOSE_NEEDS = "To propose a wire, draw these aids too:"
PROPOSE_OTHERS = "Propose the other wires"
FIT_HEAD = "Fit head"
FIT_HEAD_WHAT = "Fit the drawn circles of the femoral head to its edges in both images"
FIT_HEAD_FIRST = "click three points on the head's rim in both calibrated images first"
FIT_HEAD_AGAIN = "fit the head again: its drawing or an image has changed meanwhile"
HEAD_FITTED = "Head fitted: radius {radius:.1f} ± {radius_error:.1f} mm, centre ± {centre_error:.1f} mm (95 %)."
FIT_AXIS = "Fit"
FIT_SHAFT_WHAT = "Fit the drawn borders of the shaft to its edges in both images"
FIT_SHAFT_FIRST = "click two points on each border of the shaft in both calibrated images first"
FIT_SHAFT_AGAIN = "fit the shaft again: its drawing or an image has changed meanwhile"
SHAFT_FITTED = "Shaft ± {direction_error:.1f}°, ± {place_error:.1f} mm (95 %)."
FIT_NECK_WHAT = "Fit the neck's axis, from the head's centre, to the neck's edges in both images"
FIT_NECK_HEAD = (
    "click three points on the head's rim in both calibrated images first: the neck's axis begins at its centre"
)
FIT_NECK_FIRST = (
    "click two points on each border of the neck in both calibrated images first, from the head past "
    "its narrowest place"
)
FIT_NECK_AGAIN = "fit the neck again: its drawing, the head or an image has changed meanwhile"
NECK_FITTED = "Neck ± {direction_error:.1f}°, ± {place_error:.1f} mm (95 %)."
KEPT_AS_DRAWN = "{image}: kept as drawn; {why}."
WIRES_LABEL = "Wires of the procedure"
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
WIRE_SUFFIX = " wire"  # of a wire's name, which its button leaves out
WIRES_THEN = ", then the "
DRILLING_ORDER = "Drill the {wires}: so the wires in the bone hide the fewest beads."
NEXT_WIRE = "Next: {wire}"
RELATIONS_HEADING = "The wires to each other"
PROPOSE_UNCALIBRATED = "calibrate both views before a wire can be proposed"
COUNTER = "{number} of {count}"
IN_IMAGE = {
    "pa": "PA",
    "lateral": "LATERAL",
    "oblique": "OBLIQUE",
    "check-pa": "PA CHECK",
    "check-lateral": "LATERAL CHECK",
    "shot-pa": "PA SHOT",
    "shot-lateral": "LATERAL SHOT",
}
IN_IMAGE_OF_VIEW = {"check": "{view} CHECK", "shot": "{view} SHOT"}  # of other views
NAIL_FIELD = "Nail"
NAIL_NONE = "No nail: points by hand"
NAIL_CHOICE = "Nail: {name}"
NAIL_OTHER = "Nail: {mm:g} mm, {material}, of this case"
NAIL_SIZE = "{diameter_mm:g} mm, {material}"
NAIL_IMPLANTED = "The simulated patient has this nail: {name}."
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
NAIL_FIRST = "Choose the nail on the right. Or by hand: {said}"
NAIL_FIRST_OF = "Choose the nail on the right; the simulated patient has {name}. Or by hand: {said}"
NAIL_EDGE_FOUND = "the nail's edge, as found in the image"
NAIL_AXIS = "axis of the nail"
RIM_FOUND = "rim of the hole, as found in the image"
TURNS = "Perfect circle, turn the C-arm: {turns}."
TURN = "{image} orbit {orbit:+.0f}°, tilt {tilt:+.0f}°"
SEARCHING_NAIL = "Searching the nail in both images."
PLACE_WHERE = "{point}: {sentence}"
PLACE_ON_CURVE = "{point}: slide along its curve and click"
PLACE_IN_OBLIQUE = "{point}: click where this image shows it; the cross is where the other two expect it"
RULER_LENGTH = "{value:.1f}{off} mm"
RULER_ANGLE = "{value:.1f}°{off}"
RULER_PLANE = (
    "Measured in the plane of the wire, parallel to the image: {percent:.1f} % more or less for each 10 mm before or "
    "behind it. Error: 95 %."
)
RULER_PLANE_ANGLE = "Measured between lines parallel to the image. Error: 95 %."
RULER_SPACE = "Measured in space, from both images. Error: 95 %."
RULER_NEEDS_WIRE = "Place the wire first: the ruler measures in its plane."
DEVIATION_OF = ("entry", "tip")
DEVIATION = "{name} {mm:.2f} ± {error:.2f} mm off"
DEVIATION_TITLE = "{deviation} its plan; the arrow is drawn {times} times as long"
CURVE_TITLE = "where the {name} point may lie"
CURVE_NAMES = {"entry": "entry", "end": "end"}
BEAD_USED = "{name}: residual {mm:.3f} mm"
BEAD_LEFT_OUT = "{name}: left out, it contradicts the others by {mm:.2f} mm"
WIRE_SEEN = "the wire as this image shows it"
TIP_SEEN = "its tip"
PLAN_THERE = "the plan"
IMPLANT_TITLE = "{implants}: {length:g} mm from the entry point, {diameter:g} mm thick"
EXPECTED_HERE = "{point}: expected here by the other two images"
METRICS_HEADING = "Measurements"
METRIC_COLUMNS = ("", "± 95 %", "")
ENTRY_ERROR = "entry, 95 % error"
TIP_ERROR = "tip, 95 % error"
DIRECTION_ERROR = "direction, 95 % error"
SIDE_FOR_METRICS = "Confirm the patient's side on the step Images to see measurements of the implant."
GAP_OF = "gap of {point}"
GAP_ENDS = ("entry", "tip")
GAP_NOT_TESTED = "not tested (snapped)"

# The verdict.
VERDICTS = {"go": "GO", "no-go": "NO-GO", "incomplete": "INCOMPLETE"}
EVERY_CHECK = "Every check passed. A person decides."
MORE = "(and {count} more: Details)"
LEFT = "To do: {what}."
LEFT_CALIBRATION = "two calibrated images"
LEFT_SIDE = "patient's side"
LEFT_SERIAL = "frame's serial"
CHECK_STATUS = {"passed": "passed", "failed": "failed"}
ALL_CHECKS = "All {count} checks"
FIGURES = {  # by the name of the check that states them; of a procedure's own ones the first that it has
    "entry error": "Entry, 95 % error",
    "end error": "Tip, 95 % error",
    "direction error": "Direction, 95 % error",
    "tip in head": "Tip to joint",
    "tip behind front": "Tip to front",
    "tip in sacral corridor": "Tip in corridor",
    "wire in sacral corridor": "Wire in corridor",
    "wire in pedicle": "Wire in pedicle",
    "wire in neck": "Wire in neck",
    "tip to bone nearest": "Tip to bone",
    "movement": "Bone movement",
}
FIGURE_AT_MOST = "at most {limit}"
FIGURE_AT_LEAST = "at least {limit}"
FIGURE_ITS_ERROR = "± {limit} (95 %)"  # of a value that must exceed its error
FIGURE_MOVED = ("seen", "none seen")  # of a movement between three images, which has no single value in mm
FIGURE_PASSED, FIGURE_FAILED = "within its limit", "beyond its limit"

# The top row.
TITLE = "Sightline: planning and drilling of a wire"
STEPS_LABEL = "Steps"
PANEL_LABEL = "Verdict, figures and what to do"
UNDO = ("Undo", "Undo (Ctrl+Z)")  # name, and tooltip
REDO = ("Redo", "Redo (Ctrl+Y)")
TIME_UNDER = {"left": "min left", "expired": "expired", "done": "drilled", "unknown": "min left"}
TIME_TOLD = {
    "left": "The images are {age} min old. The plan expires ten minutes after the older one was taken.",
    "expired": "Take both images again (step Images): the plan has expired.",
    "done": "The images were {sent} min old when the plan was sent; the wire is drilled.",
    "unknown": "The time left is known once both images and their times are.",
}
LINKS = {"none": "no robot", "open": "connected", "lost": "link lost"}
CONTINUE_TO = "Continue to {step}"
BACK_TO = "Back to {step}"
DETAILS = "Details"
SPACE = "3-D"
SHARES_HEADING = "Where the error comes from"
SHARES_LABEL = "Root mean square of each source, and its share of the mean square"
SHARES_OF = {"entry": "entry", "end": "tip", "direction": "direction"}
SHARES_SOURCE = "source"
SHARES_WHOLE = "together"

# Drill.
ROBOT_HEADING = "Robot"
ROBOT_NAMES = ("robot", "simulated robot")  # the latter for a simulated patient
STARTING_ROBOT = "starting the simulated robot"
START_ROBOT = "Start the simulated robot"
ROBOT_OFF = "The robot is not started."
TARGET_HEADING = "The plan in the robot"
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
DEPTH_MARKS = ("cortex", "pause", "tip", "limit")
DEPTH = "{value:.1f} mm"
DEPTH_SIDES = ("beyond the entry", "before the entry")
DRILLED_TITLE = "the wire, drilled so far"
READING_DEPTH = "{error} (zero: {zero})"
READING = "Depth {depth} · thrust {force}"
FAULT = "Fault {number}: {what}"
RESET_FAULT = "Reset the fault"
SEND = "Send the plan"
ALIGN = "Align"
DRILL = "Drill"
DRILL_ON = "Continue drilling"
RETRACT = "Retract"
CANCEL = "Cancel"
DRILLED = "Drilled to the planned depth. Verify the wire in two check images."
DRILLED_SHORT = (
    "Drilled through the far cortex, {short:.1f} mm short of the planned depth. Verify the wire in two check images."
)
SHOT_HEADING = "Depth in the second shot"
SHOT_HEADINGS = {"ALIGNED": "Confirmation shot", "PAUSED": "Second shot"}
TAKE_SHOT = "Take the shot"
SHOT_DROP = "Drop both images of the shot onto the page, with the block on its mount again."
SHOT_DROP_ON_PATIENT = "Drop both images of the shot onto the page, with the frame on the patient."
SHOT_NEEDS_LANDMARKS = (
    "Find {count} landmarks of the plan or more in both images; the plan has {known}. They alone tell where a frame on "
    "the patient is."
)
SHOT_MEASURING = "Measuring the wire …"
SHOT_LEFT = "Place the points that are asked for in both images."
FRAME_ON_PATIENT = "The frame is fixed to the patient, as a person stated."
FRAME_IS_ON = ("The frame is on the arm again", "The frame is fixed to the patient")
FRAME_ON_QUESTIONS = (
    "Is the frame on its mount on the robot again, as at the planning images?",
    "Was the frame of the plan taken off the robot and fixed to the patient? It must stay at rest from the first to "
    "the second image of each shot.",
)
SHOT_ON_PLAN = "The wire is on the plan. A person decides."
SHOT_DECISIONS = {"GO": "GO", "STOP": "STOP", "INCOMPLETE": "INCOMPLETE"}
SHOT_COLUMNS = ("", "measured", "± 95 %")
SHOT_ROWS = ("entry, perpendicular", "end, drilled on", "direction", "depth of the tip")
SEND_MEASURED = "Send the measured depth"
SHOT_SAYS_STOP = "The shot says STOP: {why}"
SHOT_NOT_WAITING = (
    "take the shot while the robot waits, aligned or at the pause, with a block or a frame fixed to the patient; send "
    "a depth only at GO"
)
SHOT_OUT_OF_FIELD = (
    "Decide by eye: this shot cannot be measured, because the field of the simulated C-arm does not show the robot's "
    "wire and all landmarks together."
)
SHOT_DEPTH = "Depth of the tip, mm"
SHOT_ERROR = "Its 95 % error, ± mm"
SEND_DEPTH = "Send the depth"
THRUST_HEADING = "Thrust over depth"
EVENT_COLUMNS = ("event", "depth", "thrust")
LIVE_HEADING = "Live image"
LIVE_WAITING = "Waiting for the first image …"
LIVE_SHOW = "Show the live image"
LIVE_END = "End the live image"
LIVE_AT_REST = "I checked: nothing moved"

# Verify.
CHECK_HEADING = "Check shot"
TAKE_CHECK = "Take both check images"
CHECK_TAKES_TWO = "load the check image as one of the first two: a check shot takes no third image"
DRILL_FIRST = "Drill the wire first."
DROP_CHECK = "Drop both check images onto the page, with the frame in the same place."
CHECK_IMAGE = "{image}: {state}"
WIRE_FOUND = "wire found"
CALIBRATED_ONLY = "calibrated"
FOUND_AGAIN_HEADING = "Landmarks, found again"
NOT_IN_PLAN = "{point} (not in the plan)"
PLACE_LANDMARKS = "Place landmarks"
AGAINST_PLAN_HEADING = "Wire compared with the plan"
DEVIATION_COLUMNS = ("", "measured", "± 95 %")
DEVIATIONS = ("entry, perpendicular", "tip", "direction")
BENT = "The wire is bent by up to {bow_mm:.2f} mm."
DEVIATION_NOT_JUDGED = "{name}, not judged"
JUDGED_AT_HOLES = "Judged at both holes of the nail, and by how far the tip lies beyond the far one."
CHECK_VERDICT = (  # word and sentence, of a failed and of a passed one
    ("FAILED", "The check shot did not pass."),
    ("PASSED", "The check shot passed: the wire lies as planned."),
)

# Software, robot and safety.
FOOT = "Research software, not a medical device. Case {case}"
STOP_IS_NO_EMERGENCY_STOP = (
    "In an emergency press the red button at the robot. STOP and the space bar only ask the robot's program to stop."
)
DEAD = (
    "Use the red button: the program does not respond. STOP does not reach the robot, and this page may be out of date."
)
RED_BUTTON = "use the red button"
LEAVE_QUESTION = "Leave this page? The plan stays in the case, but STOP is not available without the page."
STAY = "Stay"
LEAVE = "Leave"
REACHABLE = "Other machines can reach this page; anyone with its address and token can move the robot."
SEND_QUESTION = "Send this plan to the robot?"
SEND_FRAME = ("the frame without a serial", "frame {serial}")
SIDE_WORDS = {"right": "right", "left": "left"}
SEND_WHAT = (
    "The {robot} receives a wire of {length:.1f} mm on the {side} side, in the coordinates of {frame}. "
    "Nothing moves yet. “Align” will then move the arm until the wire's guide points along the plan, "
    "20 mm before the bone."
)
ALIGN_QUESTION = (
    "Align: the wire retracts into its sleeve, then the whole arm moves. Is its path clear of people, table and C-arm?"
)
DRILL_QUESTION = (
    "Drill: the wire rotates and advances into the bone, to {left:.0f} mm before its planned depth. "
    "Does the sleeve stand on the bone, and does the confirmation shot show the guide on the plan?"
)
DRILL_ON_QUESTION = "Continue drilling: the last {left:.0f} mm. Does the second shot show the wire on the plan?"
ZEROS = {"plan": "plan", "contact": "contact", "shot": "second shot"}  # sources of the zero of depth
SHOT_QUESTION = "Send this depth to the robot? It counts the last {left:.0f} mm from it. A depth can be sent only once."
SHOT_UNMEASURED = (
    "If you measured the tip's depth beyond the planned entry point in the second shot, enter it here. Sightline "
    "does not measure this shot, because the frame has moved away with the arm. Without it the depth "
    "rests on the {zero}, {error}."
)
SHOT_TOLD = "The depth of the second shot was sent. The depth now rests on the {zero}, {error}."
RETRACT_QUESTION = "Retract: if the wire is to stay in the bone, open the chuck first. Is it open?"
RESET_QUESTION = "Have you checked the robot and dealt with the fault?"
ROBOT_REFUSED = "The robot refused: {why}."
NO_ROBOT = (
    "Take the images through a robot's link, or rehearse on the demo case: these images carry no robot pose, so the "
    "bone's position in robot coordinates is unknown."
)
CHANGED_SINCE_SENT = (
    "Send the plan again: the plan that was sent is no longer reproduced exactly, perhaps by another version of the "
    "software, and is not restored."
)
CHANGED_AFTER_SENDING = "Send the plan again, or undo the change: it was changed after it was sent."
OTHER_WIRE_HELD = "The robot holds the plan of the {wire}: choose that wire, or send the plan of this one."
ROBOT_WIRE_HELPS = (
    "{refused} Click tip and middle of the robot's wire in both images, on the step Plan: they register the robot more "
    "accurately than its encoders."
)
NO_DEPTH_LIMIT = (
    "Place the rim of the femoral head in both images, which gives the distance to the joint: the depth limit of the "
    "wire is unknown."
)
BUG = "Reload the page and report this: something in Sightline failed ({kind}). The plan is unchanged."

# Shortcuts, cases and report.
CLOSE = "Close"
SHORTCUTS = "Keyboard and mouse"
SHORTCUTS_BUTTON = "Shortcuts (?)"
SHORTCUT_COLUMNS = ("to", "do")
SHORTCUT_ROWS = (
    ("stop the robot", "space bar"),
    ("undo, redo", "Ctrl+Z, Ctrl+Y"),
    ("place a point", "click, or Enter at the cross-hair"),
    ("move a point", "drag, or arrow keys: 1 pixel, with Shift 0.1"),
    ("remove a point", "Delete"),
    ("cancel", "Escape"),
    ("zoom, pan", "wheel or pinch; drag the background"),
    ("brightness and contrast", "drag with the right button"),
    ("next, previous control", "Tab, Shift+Tab"),
    ("this sheet", "?"),
)
REPORT = "Save the report"
WRITING_REPORT = "writing the report"
CASES = "Cases"
CASE_COLUMNS = ("case", "newest entry, UTC", "reached", "folder")
CASE_HERE = "{number} (this one)"
CASE_REACHED = {"acquired": "images", "planned": "planned", "drilled": "drilled", "verified": "verified"}
CASE_OPEN = "Open"
CASE_QUESTION = "Open case {number}? All that was done in this case is saved; it can be opened again."
CASE_ROBOT = "The link to the robot is closed: it stops and forgets its plan."
CASE_BUSY = "open the other case when this is done: {doing}"
CASE_MOVING = "stop the robot, or wait until its motion has ended, then open the other case"
