"""Columns of a fit's answer, and how a fit can end."""

# Centre, px; radius, px; contrast of log light; blur in the image, px; covariance of the centre, px²; variance of the
# contrast; chi-square per pixel; residual rms; weakest sector's contrast in units of the whole's; mean residual in the
# middle; how it ended; number of pixels; mean variance that the noise model expects of them.
U, V, RADIUS, CONTRAST, BLUR, CUU, CUV, CVV, CCC, CHI2, MISFIT, WEAKEST, HOLLOW, STATUS, PIXELS, NOISE = range(16)
FITTED, TOO_FEW_PIXELS, WANDERED, SINGULAR = 0, 1, 2, 3
