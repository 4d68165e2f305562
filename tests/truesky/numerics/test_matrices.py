"""Products and solutions without BLAS: the bits of the definition, the values of numpy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.numerics import compiled_products, matrices


def slow(one, other):
    """One term after the other, each product and each sum rounded."""
    terms = np.multiply(one[:, :, None], other[None], dtype=float)
    return np.cumsum(np.concatenate([np.zeros_like(terms[:, :1]), terms], axis=1), axis=1)[:, -1]


@given(
    n=st.integers(1, 20),
    k=st.integers(1, 40),
    m=st.integers(1, 40),
    kinds=st.tuples(*[st.sampled_from([np.float32, np.float64])] * 2),
    seed=st.integers(0, 99),
)
def test_a_product_has_the_bits_of_its_definition(n, k, m, kinds, seed):
    rng = np.random.default_rng(seed)
    # Numbers have very different sizes, so that another order of summation changes the result.
    one = (rng.normal(size=(n, k)) * 10.0 ** rng.uniform(-8, 8, (n, k))).astype(kinds[0])
    other = (rng.normal(size=(k, m)) * 10.0 ** rng.uniform(-8, 8, (k, m))).astype(kinds[1])
    wanted = slow(one, other)
    for layout in (np.ascontiguousarray, np.asfortranarray):
        assert np.array_equal(matrices.matmul(layout(one), layout(other)), wanted)
    assert np.array_equal(matrices.matmul(one[0], other), wanted[0])
    assert np.array_equal(matrices.matmul(one, other[:, 0]), wanted[:, 0])
    assert matrices.matmul(one[0], other[:, 0]) == wanted[0, 0]
    assert np.array_equal(matrices.matmul(one.reshape(1, n, k), other), wanted[None])
    for loop, right in (
        (compiled_products.multiply_rows, other),
        (compiled_products.multiply_transposed, np.ascontiguousarray(other.T)),
    ):
        out = np.empty((n, m))
        loop(one, right, out)
        assert np.array_equal(out, wanted)


def test_a_wide_product_in_blocks():
    rng = np.random.default_rng(2)
    one, other = rng.normal(size=(3, 50)), rng.normal(size=(50, 1300))
    assert np.array_equal(matrices.matmul(one, other), slow(one, other))


def test_stacks_of_small_matrices():
    rng = np.random.default_rng(1)
    one, other = rng.normal(size=(2, 50, 2, 2))
    assert matrices.matmul(one, other) == pytest.approx(one @ other, rel=1e-13, abs=1e-14)
    assert matrices.matmul(one[0], other) == pytest.approx(one[0] @ other, rel=1e-13, abs=1e-14)
    assert matrices.inverse(one) == pytest.approx(np.linalg.inv(one), rel=1e-11, abs=0.0)


def test_factors_with_different_numbers_of_terms_are_refused():
    with pytest.raises(ValueError, match="do not match"):
        matrices.matmul(np.ones((2, 3)), np.ones((2, 3)))


@pytest.mark.parametrize("shape", [(5, 5), (40, 7), (30, 1)])
def test_least_squares(shape):
    rng = np.random.default_rng(3)
    basis, values = rng.normal(size=shape), rng.normal(size=(shape[0], 4))
    wanted = np.linalg.lstsq(basis, values)[0]
    assert matrices.least_squares(basis, values) == pytest.approx(wanted, rel=1e-11, abs=1e-13)
    assert matrices.least_squares(basis, values[:, 0]) == pytest.approx(wanted[:, 0], rel=1e-11, abs=1e-13)
    assert matrices.least_squares(basis, np.eye(shape[0])) == pytest.approx(np.linalg.pinv(basis), rel=1e-11, abs=1e-14)


@pytest.mark.parametrize("count", [1, 2, 5, 24, 101])
def test_quadrature(count):
    nodes, weights = matrices.gauss_legendre(count)
    assert nodes == pytest.approx(np.polynomial.legendre.leggauss(count)[0], rel=1e-13, abs=1e-15)
    # Of 101, by 60 digits: ours are right within 2e-13, numpy's within 8.4e-12.
    assert weights == pytest.approx(np.polynomial.legendre.leggauss(count)[1], rel=1e-11, abs=0.0)
    for power in range(min(2 * count, 40)):
        assert np.sum(weights * nodes**power) == pytest.approx((1 + (-1) ** power) / (power + 1), rel=1e-13, abs=1e-15)
