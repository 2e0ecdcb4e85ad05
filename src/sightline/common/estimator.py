"""The version of the estimator: detection, calibration and planning together."""

# Add an entry whenever the same images and picks give different results, beyond rounding.
# A case records the version with each entry; entries without one have version 1.
CHANGES = {
    2: "the scatter under a ball follows the background's slope; a plan can be incomplete, and says what is missing",
    3: "labelling lists what it rejects; a view is checked by its balls' sizes and by the C-arm's distance",
    4: "a strip of rows whose beads labelling dropped is sought; beads are expected wherever something was detected",
    5: "wires of iliosacral, pedicle and slipped epiphysis screws are checked against drawn borders and planes",
    6: "a hip screw's tip-apex distance is checked, and that its entry, or a cannulated screw's, is not in air",
    7: "a check shot's wire is measured where two fifths of its pieces are seen; before, half of them were asked",
    8: "a check shot leaves out beads that the view knows, its tip's error grows with light that is not explained; "
    "rims of a nail's hole are compared with light blurred in the image plane",
    9: "how far a point may be wrong along its line of sight counts the checks of borders and of the tip-apex distance",
    10: "with a block the directions of the views, and the side, are checked by the anatomy; "
    "errors that a wire found in the planning images shares with the planned ones cancel in their relations",
    11: "the second look knows size, shape and blur of a shadow from its plate; beads found predict those further out; "
    "rims before a clipped background state a larger error, and the second look finds them; "
    "a hole's error is larger where halves of its rims disagree, and a nail's images with a narrow lens are refused; "
    "calibration takes the centroids of shadows, which distortion shifts, to the images of the balls' centres",
    12: "whether a bead may be a false one in the place of a hidden one is judged by all places that are equally near; "
    "before, rounding chose among them; "
    "a fit's effective parameters are counted from neighbours in a row, and a window's level from every second row; "
    "clipped pixels are never data, also where the fill outside the field exceeded white by a rounding error",
    13: "a head fitted to edges states a larger error, as sampled on rendered heads",
    14: "a bead's fit starts from the depth of its shadow, not from the step at its rim, and ends when the steps to "
    "come are small; extrema of noise and texture are dropped before their rims are sought; "
    "the second look keeps a bead whose own rim is seen, however deep a smaller one lies in its shadow, uses pixels "
    "nearer to an overlap, and leaves out beads whose fits lie at one place or that hide one which is not fitted",
    15: "the shadow of a ball much larger than most has the profile of one of 5 mm; the stated error before a clipped "
    "background is smaller by that; the second look fits labelled beads again whose light was not explained, and metal "
    "in their windows; it takes blur and shape of the shadows from detection's own fits, before from a repetition of "
    "them, and predicts a bead's size from all neighbours that are equally near, among which rounding chose before; "
    "of readings of a lattice that fit equally well labelling tries the first by the beads' order, not a search tree's",
    16: "the second look fits a small ball jointly with a larger one whose shadow holds much of its own; before, it "
    "took the larger one for anatomy; a bead of whose rim another hides nearly all is not kept; "
    "the tip of a wire is fitted with the width that the wire has there, before with that of its last pieces, "
    "and with less of the background beyond it",
    17: "calibration computes with NumPy what kernels did, which rounds differently; the handedness of a solid's image "
    "is decided by the adjustment itself, with the errors of its balls, before by a camera of its own; "
    "sums of a bead's fit are added in one stated order, so that the last digits of centres and errors differ",
    18: "the tip of a wire that known beads hide is fitted together with them, before it was refused; a detected bead "
    "at the place of a known one hides no more of a wire than that one; "
    "a surround of any grey level lies outside the field, and areas of one level do not count as noise; "
    "a view is checked for an earlier frame that shines through, and for a blur of one direction",
    19: "of beads that are fitted together each stops its own share of the light",
}
FIRST = 1
ESTIMATOR = max(CHANGES)
