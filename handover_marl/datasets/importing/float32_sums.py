"""Sums in single precision whose last bit does not depend on the machine.

What a library's matrix product gives for float32 depends on whether the processor fuses multiplication and addition,
and on which kernel the library takes. The original's data was made with fused sums in one place and plain ones in
another, so both are written out: plain ones as elementwise operations, which every machine rounds alike, and fused
ones by means of float64.
"""

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]


def fused_multiply_add(a: Float32, b: Float32, c: Float32) -> Float32:
    """`a * b + c` rounded once, as the machine instruction does; arrays that broadcast, of any shape.

    The product of two float32 is exact in float64, so one sum is all that float64 rounds. Rounding that again to
    float32 would go wrong where the first rounding lands half-way between two float32, so the first one rounds to
    odd instead: a result that is not exact gets an odd last bit, which keeps it off every half-way point.
    """
    product = a.astype(np.float64) * b.astype(np.float64)
    addend = c.astype(np.float64)
    total = np.asarray(product + addend)
    # Knuth's sum: what rounding took away, exactly.
    part = total - product
    lost = (product - (total - part)) + (addend - part)
    even = (total.view(np.int64) & 1) == 0
    odd = np.where((lost != 0.0) & even, np.nextafter(total, np.copysign(np.inf, lost)), total)
    return odd.astype(np.float32)


def rotate_fused(matrix: Float32, columns: Float32) -> Float32:
    """Matrix product of `matrix` (3, 3) with `columns` (n, 3, k), by fused sums from left to right; (n, 3, k)."""
    rows = [matrix[:, k, None] for k in range(3)]
    parts = [columns[:, None, k, :] for k in range(3)]
    return fused_multiply_add(rows[2], parts[2], fused_multiply_add(rows[1], parts[1], rows[0] * parts[0]))


def rotate_plain(matrix: Float32, vector: Float32) -> Float32:
    """Product of `matrix` (3, 3) with `vector` (3,), every product and every sum rounded; (3,)."""
    products = matrix * vector
    total: Float32 = (products[:, 0] + products[:, 1]) + products[:, 2]
    return total


def length(vectors: Float32) -> Float32:
    """Lengths (n,) of vectors (n, 3) as BLAS gives them: float32 products, their sum in float64, rounded to float32."""
    squares = (vectors * vectors).astype(np.float64)
    total = (squares[:, 0] + squares[:, 1]) + squares[:, 2]
    return np.asarray(np.sqrt(total.astype(np.float32)))
