"""Cholesky factors within kernels, where a call of LAPACK would cost more than the factor of a hundred rows."""

import numpy as np

from sightline.kernels import exact_unchecked, fast

PIVOTS, STRIDE = 4, 16  # rows that `eliminate` takes at once, and columns of a vectorised step


@fast
def factor(n, matrix):
    """Replace the lower triangle of the first n rows and columns by its Cholesky factor; return whether it has one."""
    for j in range(n):
        own = matrix[j, j]
        for k in range(j):
            own -= matrix[j, k] * matrix[j, k]
        if not own > 0.0:
            return False
        matrix[j, j] = np.sqrt(own)
        for i in range(j + 1, n):
            other = matrix[i, j]
            for k in range(j):
                other -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = other / matrix[j, j]
    return True


# Without fastmath: its loops have no sums to be reordered, and kernels may call it without inlining it.
@exact_unchecked
def eliminate(n, dense, matrix):
    """Eliminate the first n rows of a symmetric matrix with columns beside it; return False if it is not positive.

    `matrix` (N, M), N >= n: [[A, B], [., C]], where A (n, n) and C are symmetric and only their upper triangles count.
    A becomes its upper Cholesky factor U, with A = U^T U; B becomes U^-T B, and C becomes C - B^T A^-1 B. The columns
    from `dense` on may be an identity (n, n), of which the zeros of U^-T are then not computed.
    n is a multiple of PIVOTS, N is even, M a multiple of STRIDE. What is below the diagonals is overwritten.
    """
    for first in range(0, n, PIVOTS):
        last = first + PIVOTS
        begin, end = first // STRIDE * STRIDE, min((dense + last + STRIDE - 1) // STRIDE * STRIDE, matrix.shape[1])
        for k in range(first, last):
            if not matrix[k, k] > 0.0:
                return False
            row, inverse = matrix[k, begin:end], 1.0 / np.sqrt(matrix[k, k])
            for j in range(len(row)):
                row[j] *= inverse
            for i in range(k + 1, last):
                one, p = matrix[i, begin:end], matrix[k, i]
                for j in range(len(one)):
                    one[j] -= p * row[j]
        for i in range(last, len(matrix), 2):  # two rows by four: fewer loads for each product
            k, begin = i + 1, i // STRIDE * STRIDE
            p, q, r, s = matrix[first, i], matrix[first + 1, i], matrix[first + 2, i], matrix[first + 3, i]
            t, u, v, w = matrix[first, k], matrix[first + 1, k], matrix[first + 2, k], matrix[first + 3, k]
            a, b, one = matrix[first, begin:end], matrix[first + 1, begin:end], matrix[i, begin:end]
            c, d, two = matrix[first + 2, begin:end], matrix[first + 3, begin:end], matrix[k, begin:end]
            for j in range(len(one)):
                x, y, z, o = a[j], b[j], c[j], d[j]
                one[j] -= p * x + q * y + r * z + s * o
                two[j] -= t * x + u * y + v * z + w * o
    return True
