from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from handover_marl.datasets.importing.float32_sums import fused_multiply_add, length, rotate_fused, rotate_plain

FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)
TAME = st.floats(-8.0, 8.0, width=32)


def rounded(exact: Fraction) -> np.float32:
    """The nearest float32, ties to even, by exact arithmetic."""
    guess = np.float32(float(exact))
    around = [np.nextafter(guess, np.float32(-np.inf)), guess, np.nextafter(guess, np.float32(np.inf))]
    finite = [value for value in around if np.isfinite(value)]
    apart = [abs(Fraction(float(value)) - exact) for value in finite]
    nearest = [value for value, gap in zip(finite, apart, strict=True) if gap == min(apart)]
    return min(nearest, key=lambda value: int(value.view(np.int32)) & 1)


def fused(a: np.float32, b: np.float32, c: np.float32) -> np.float32:
    exact = Fraction(float(a)) * Fraction(float(b)) + Fraction(float(c))
    return rounded(exact) if exact else np.float32(0.0)


def one(a: float, b: float, c: float) -> np.float32:
    return fused_multiply_add(*(np.array([value], dtype=np.float32) for value in (a, b, c)))[0]


@settings(max_examples=1000, deadline=None)
@given(a=FLOATS, b=FLOATS, c=FLOATS)
def test_fused_sums_round_once(a: float, b: float, c: float) -> None:
    assume(abs(a * b + c) < 3e38)
    assert one(a, b, c) == fused(np.float32(a), np.float32(b), np.float32(c))


@settings(max_examples=1000, deadline=None)
@given(steps=st.integers(0, 2**23), shift=st.integers(1, 30), sign=st.sampled_from([-1.0, 1.0]))
def test_next_to_half_way(steps: int, shift: int, sign: float) -> None:
    """Half a unit in the last place of c and a very little more or less, which float64 alone cannot tell."""
    c = 1.0 + steps * 2.0**-23
    a, b = 2.0**-24 * (1.0 + 2.0**-shift) if shift <= 23 else 2.0**-24, sign * (1.0 - 2.0 ** -min(shift, 23))
    assert one(a, b, c) == fused(np.float32(a), np.float32(b), np.float32(c))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_where_rounding_twice_goes_wrong(sign: float) -> None:
    a, b, c = np.float32(2.0**-24 * (1 + 2.0**-15)), np.float32(1 - 2.0**-15), np.float32(1 + 2.0**-23)
    twice = np.float32(np.float64(a) * np.float64(b) + np.float64(c))
    assert twice == np.float32(1 + 2.0**-22)
    assert one(sign * a, b, sign * c) == sign * c == fused(sign * a, b, sign * c)


@settings(max_examples=100, deadline=None)
@given(entries=st.lists(TAME, min_size=9 + 6, max_size=9 + 6))
def test_products_with_matrices(entries: list[float]) -> None:
    matrix = np.array(entries[:9], dtype=np.float32).reshape(3, 3)
    columns = np.array(entries[9:], dtype=np.float32).reshape(1, 3, 2)
    found = rotate_fused(matrix, columns)
    assert found.shape == (1, 3, 2)
    for row in range(3):
        for column in range(2):
            total = rounded(Fraction(float(matrix[row, 0])) * Fraction(float(columns[0, 0, column])))
            for k in (1, 2):
                total = fused(matrix[row, k], columns[0, k, column], total)
            assert found[0, row, column] == total
    expected = [
        (matrix[row, 0] * columns[0, 0, 0] + matrix[row, 1] * columns[0, 1, 0]) + matrix[row, 2] * columns[0, 2, 0]
        for row in range(3)
    ]
    np.testing.assert_array_equal(rotate_plain(matrix, columns[0, :, 0]), np.array(expected, dtype=np.float32))


def test_length_rounds_products_then_the_sum() -> None:
    vectors = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    expected = []
    for vector in vectors:
        squares = [Fraction(float(rounded(Fraction(float(x)) ** 2))) for x in vector]
        expected.append(np.sqrt(rounded(sum(squares, Fraction()))))
    np.testing.assert_array_equal(length(vectors), np.array(expected))
    assert (length(vectors) != np.sqrt((vectors**2).sum(axis=1))).any()
