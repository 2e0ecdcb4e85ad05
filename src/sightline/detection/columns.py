"""Columns of a fit's answer, and how a fit can end."""

# Centre, px; radius, px; contrast of log light; blur in the image, px (these five are also where a fit starts);
# covariance of the centre, px²; variance of the contrast; chi-square per pixel; residual beyond noise over contrast;
# weakest sector's contrast in units of the whole's; how it ended.
U, V, RADIUS, CONTRAST, BLUR, CUU, CUV, CVV, CCC, CHI2, EXCESS, WEAKEST, STATUS = range(13)
COUNT = 13
FITTED, TOO_FEW_PIXELS, WANDERED, SINGULAR = 0, 1, 2, 3
