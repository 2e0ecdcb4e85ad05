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
    "edit_lost": "The last change of {name} did not reach the server, and the plan has changed since: make it again.",
    "load_failed": "The image could not be loaded: reload the page.",
    "readout": "column {u}, row {v}: {value}",
    "outside": "–",
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
NOT_A_DEVICE = "Research software, not a medical device."
STOP_IS_NO_EMERGENCY_STOP = (
    "STOP and the space bar ask the robot's program to stop. Neither is an emergency stop: "
    "that is the red button at the robot."
)
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
