"""Cholesky factors within kernels, where a call of LAPACK would cost more than the factor of a hundred rows."""

from numba import njit

# As `detection.compiled.fast`: for kernels that Python calls, and inlined in these.
fast = njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy", forceinline=True)


@fast
def factor(n, matrix):
    """Replace the lower triangle of the first n rows and columns by its Cholesky factor; return whether it has one."""
    for j in range(n):
        own = matrix[j, j]
        for k in range(j):
            own -= matrix[j, k] * matrix[j, k]
        if not own > 0.0:
            return False
        matrix[j, j] = own**0.5
        for i in range(j + 1, n):
            other = matrix[i, j]
            for k in range(j):
                other -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = other / matrix[j, j]
    return True
