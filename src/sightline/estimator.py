"""The version of what is estimated: one number for detection, calibration and planning together."""

# Raise it whenever the same images and picks give other numbers than before, beyond rounding, and say what changed.
# A case records it with each entry; entries without one are of version 1.
CHANGES = {
    2: "the scatter under a ball follows the background's slope; a plan can be incomplete, and says what is missing",
    3: "labelling lists what it rejects; a view is checked by its balls' sizes and by the C-arm's distance",
}
FIRST = 1
ESTIMATOR = max(CHANGES)
