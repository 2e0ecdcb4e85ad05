"""Every word of the page, in one place."""

STEPS = ("Images", "Calibrate", "Plan", "Drill", "Verify")
IMAGE_LABELS = {
    "pa": "PA image",
    "lateral": "Lateral image",
    "check-pa": "PA check image",
    "check-lateral": "Lateral check image",
}
LIVE_LABELS = {"pa": "PA, live", "lateral": "Lateral, live"}
LIVE_UNKNOWN = "Live, view unknown"
STALE = "This image is {age:.1f} s old: it does not show what is now. The plan over it is hidden."
STANDING = {"done": "done", "open": "to do", "attention": "needs attention", "blocked": "blocked"}
XRAY = {
    "fit": "Show the whole image",
    "window": "Brightness and contrast: drag on the image",
    "invert": "Invert black and white",
    "flip": "Mirror the display",
    "rotate": "Turn the display by a quarter",
    "reset": "Reset the display",
    "maximise": "Enlarge this image",
    "restore": "Show both images",
    "point": "{name}: column {u}, row {v}",
    "snapped": "on the matching curve",
    "placing": "Click to place: {name}. Escape cancels.",
    "mirrored": "mirrored",
    "rotated": "turned {degrees}°",
    "stale": "Plan hidden: the image is out of date",
    "edit_lost": "The last change of {name} was not taken: the image or the plan has changed since. Make it again.",
    "load_failed": "The image could not be loaded: reload the page.",
    "readout": "column {u}, row {v}: {value}",
    "outside": "–",
    "off_field": "X-rays do not reach this place: click inside the field.",
}
ORIENTATION = {
    "right": "Right hip: +Y of the frame points to the feet.",
    "left": "Left hip: +Y of the frame points to the head.",
}
SPACE_LABEL = "The set-up in space: frame, views, wire, robot"
SPACE_GROUPS = {
    "frame": "frame",
    "views": "focal points and images",
    "sights": "lines of sight",
    "points": "landmarks",
    "bone": "femur",
    "wire": "planned wire",
    "drilled": "drilled wire",
    "robot": "robot",
    "sides": "sides",
}

# The steps, and why each is where it is.
DOING = "{doing}."
DROP_MISSING = "Drop the {images} onto the page."
CONFIRM_BOTH = "Confirm the patient's side and the frame's serial."
STATE_WHETHER_MIRRORED = "Say whether writing in the images reads backwards."
STATE_WHEN_TAKEN = "State when the images were taken that do not say it."
IMAGES_DONE = "Both images are here; side and frame are confirmed."
IMAGES_FIRST = "Both images are needed first."
SAME_VIEW = "The two images show the same view; a PA and a lateral image are needed."
CALIBRATED = "Both views are calibrated from their own beads, and every check passed."
CALIBRATE_FIRST = "Both views must be calibrated first."
PLACE_WIRE = "Place in both images: {points}."
PLAN_DONE = "GO: every check passed."
DRILL_DONE = "The wire is drilled to the planned depth."
LINK_LOST = "The link to the robot is lost."
ROBOT_IN = "The robot is in {state}."
ONLY_GO = "Only a plan that is GO can be sent."
CAN_SEND = "The plan can be sent to the robot."
VERIFIED = "The wire in the bone was measured in two more images, and lies where it was planned."
NOT_DRILLED = "Nothing was drilled yet."
TAKE_TWO_MORE = "Take two more images, with the wire in the bone."

# Images.
IMAGES_HEADING = "Images"
PUT_WHERE_IT_BELONGS = "This is the {image}, as its markers tell; it was put there."
NO_IMAGE = "{image}: none yet"
IMAGE_SIZE = "{image}: {width} × {height}"
IMAGE_BEADS = "{image}: {width} × {height}, {beads} beads found"
REHEARSING = "This case rehearses on a simulated patient."
TAKE_AGAIN = "Take both images again"
SIDE_HEADING = "Patient's side"
SIDE_HINT = "Look at both images, at the letters on the film or at the patient, and confirm:"
SIDES = {"right": "Right hip", "left": "Left hip"}
SERIAL_HEADING = "Frame's serial"
SERIAL_CONFIRMED = "Confirmed: {serial}"
SERIAL_UNKNOWN = "The frame file states none. Type what is engraved on the frame; “none” if nothing is."
SERIAL_KNOWN = "Type the serial that is engraved on the frame; it must be the frame file's."
SERIAL_FIELD = "Serial on the frame"
SERIAL_CONFIRM = "Confirm serial"
SERIAL_REFUSED = "type the serial as it is engraved on the frame, or “none” if there is none"
TAKEN_HEADING = "When the images were taken"
TAKEN_UNKNOWN = "{image}: unknown. The file does not say it, or says a time after its arrival: compare the clocks."
TAKEN_FIELD = "{image}: taken, minutes ago"
TAKEN_CONFIRM = "Confirm the time"
TAKEN_REFUSED = "give the minutes since the image was taken, a number from 0 on"
MIRRORED_HEADING = "Mirrored displays"
MIRRORED_HINT = (
    "Both images show the mirror image of the frame file. Either the displays are mirrored, or the file is left-handed "
    "and every point is wrong. Look at writing in an image, as this page shows it, and answer for one image at least:"
)
MIRRORED_FIELD = "{image}: writing reads"
MIRRORED_ANSWERS = {True: "backwards", False: "forwards"}
MIRRORED_SAID = {True: "{image}: the file shows it mirrored", False: "{image}: the file shows it unmirrored"}
MIRRORED_REFUSED = "say it once the image is calibrated"
DISPLAY_HEADING = "Display"
DISPLAY_SHOWN = "{image}: {how}"
DISPLAY_AND = " and "

# Calibrate.
SHOW_REJECTED = "Show candidates that are no beads, with the reason"
DROP_FIRST = "No image yet: drop one onto the page."
BEADS_USED = "beads used / left out"
RESIDUAL = "residual, rms per axis"
FOCAL_POINT = "focal point"

# Plan.
POINT_GROUPS = {"wire": "Wire", "landmark": "Landmarks: did the bone move?", "aid": "Aids"}
IMAGES_SHORT = {"pa": "PA", "lateral": "lat"}
KIND_FIELD = "Kind of trajectory"
SNAP = "Take lateral points of the wire to their curves"
SHOW_BEADS = "Show the beads"
PLACE = "Place"
PLACE_WHAT = "Place {what}"
REMOVE_WHAT = "Remove {what}"
PROPOSE = "Propose a wire from head and shaft"
PROPOSE_UNCALIBRATED = "both views must be calibrated before a wire can be proposed"
PLACE_WHERE = "Click in the {image}: {point}. {sentence}"
FIGURES_HEADING = "Figures"
FIGURE_COLUMNS = ("", "± 95 %", "")
ENTRY_ERROR = "entry, 95 % error"
TIP_ERROR = "tip, 95 % error"
DIRECTION_ERROR = "direction, 95 % error"
SIDE_FOR_FIGURES = "Confirm the patient's side on the step Images to see figures of the implant."
GAP_OF = "gap of {point}"
GAP_ENDS = ("entry", "tip")
GAP_NOT_TESTED = "not tested (snapped)"

# The verdict.
VERDICTS = {  # word and sentence
    "go": ("GO", "Every check passed. A person decides."),
    "no-go": ("NO-GO", "{failed} of {all} checks failed."),
    "incomplete": ("INCOMPLETE", "{failed} of {all} checks need something that is missing."),
}
ALL_CHECKS = "All {count} checks"
EXPIRES = "The images are {age} old; the plan expires in {left}."
SENT_AT = "The images were {age} old when the plan was sent; the wire is drilled."
EXPIRED = "The plan has expired: take both images again (step Images)."
MINUTES = "{minutes} min {seconds:02d} s"
SHARES_HEADING = "Where the error comes from"
SHARES_LABEL = "Each source's root mean square, and its share of the mean square"
SHARES_OF = {"entry": "entry", "end": "tip", "direction": "direction"}
SHARES_SOURCE = "source"
SHARES_WHOLE = "together"

# Drill.
ROBOT_HEADING = "Robot"
ROBOT_NAMES = {True: "simulated robot", False: "robot"}  # whether the patient is simulated
STARTING_ROBOT = "starting the simulated robot"
START_ROBOT = "Start the simulated robot"
FAULT = "Fault {number}: {what}"
RESET_FAULT = "Reset the fault"
SEND = "Send the plan"
ALIGN = "Align"
DRILL = "Drill"
DRILL_ON = "Drill on"
DRAW_BACK = "Draw back"
CANCEL = "Cancel"
DRILLED = "Drilled to the planned depth. Verify it in two more images."
SHOT_HEADING = "Second shot"
SHOT_DEPTH = "Depth of the tip, mm"
SHOT_ERROR = "Its 95 % error, ± mm"
TELL_ROBOT = "Tell the robot"
THRUST_HEADING = "Thrust over depth"
EVENT_COLUMNS = ("noticed", "depth", "thrust")
LIVE_HEADING = "Live image"
LIVE_BLIND = "What it cannot tell: {what}."
LIVE_WAITING = "Waiting for the first image …"
LIVE_SHOW = "Show the live image"
LIVE_END = "End the live image"
LIVE_AT_REST = "Nothing moved: I looked"

# Verify.
CHECK_HEADING = "Check shot"
TAKE_CHECK = "Take both check images"
DRILL_FIRST = "Drill the wire first."
DROP_CHECK = "Drop both check images onto the page: PA and lateral, the frame where it was."
CHECK_IMAGE = "{image}: {state}"
WIRE_FOUND = "wire found"
CALIBRATED_ONLY = "calibrated"
FOUND_AGAIN_HEADING = "Landmarks, found again"
NOT_IN_PLAN = "{point} (not in the plan)"
PLACE_LANDMARKS = "Place landmarks"
AGAINST_PLAN_HEADING = "The wire against its plan"
DEVIATION_COLUMNS = ("", "measured", "± 95 %", "")
DEVIATIONS = ("entry, across", "tip", "direction")
BENT = "The wire is bent by up to {bow_mm:.2f} mm."
CHECK_VERDICT = {True: "The check shot passed.", False: "The check shot did NOT pass."}

# What is said of software, reach and robot.
NOT_A_DEVICE = "Research software, not a medical device."
STOP_IS_NO_EMERGENCY_STOP = (
    "STOP and the space bar ask the robot's program to stop. Neither is an emergency stop: "
    "that is the red button at the robot."
)
DEAD = (
    "The program does not answer. What is shown may be out of date, and STOP does not reach the robot: "
    "use the red button."
)
RED_BUTTON = "use the red button"
LEAVE_QUESTION = "Leave this page? The plan stays in the case; STOP is gone with the page."
STAY = "Stay"
LEAVE = "Leave"
REACHABLE = "This page can be reached from other machines; who has its address and token can move the robot."
SEND_QUESTION = "Send this plan to the robot?"
SEND_WHAT = (
    "The {robot} will be told of a wire of {length:.1f} mm in a {side} hip, in the coordinates of frame {serial}. "
    "Nothing moves yet. After that, “Align” turns the arm until the wire's guide points along the plan, "
    "20 mm before the bone."
)
ALIGN_QUESTION = (
    "Align: the wire goes back into its sleeve, then the whole arm turns. Is its way clear of people, table and C-arm?"
)
DRILL_QUESTION = (
    "Drill: the wire turns and goes forward into the bone, to 10 mm short of the tip. "
    "Does the confirmation shot show the guide on the plan?"
)
DRILL_ON_QUESTION = "Drill on: the last 10 mm. Does the second shot show the wire on the plan?"
BY_PLAN, BY_CONTACT, BY_SHOT = "plan", "contact", "second shot"  # what tells where depth is counted from
SHOT_QUESTION = "Tell the robot this depth? The last 10 mm are then counted from it, and it can be told once only."
SHOT_UNMEASURED = (
    "Sightline does not measure the second shot: the frame has turned away with the arm. Who measured on it how far "
    "beyond the planned entry point the tip is may tell the robot here; otherwise it drills on by {zero}, to {error}."
)
SHOT_TOLD = "The robot was told of the second shot: it drills on by {zero}, to {error}."
RETRACT_QUESTION = "Draw back: open the chuck first, if the wire is to stay in the bone. Is it open?"
RESET_QUESTION = "Have you been at the robot and seen to the fault?"
NO_ROBOT = (
    "These images carry no pose of a robot, so no robot can be told where the bone is. "
    "Take the images through a robot's link, or rehearse on the demo case."
)
CHANGED_SINCE_SENT = (
    "The plan that was sent does not come out the same any more (other software?): it is not taken up again. "
    "Send the plan anew."
)
CHANGED_AFTER_SENDING = "The plan was changed after it was sent: send it again, or undo the change."
NO_DEPTH_LIMIT = (
    "How deep the wire may go is not known: place the rim of the femoral head in both images, which gives its distance "
    "to the joint."
)
BUG = "Something in Sightline failed ({kind}). The plan is as it was; reload the page, and report this."
