"""Draw random numbers in compiled code, each from a 64-bit key: the same key always gives the same number.

A key is a uint64, for example of a source. `child_key` derives further keys from it, for its properties or draws, by a
step of the generator SplitMix64.

References
----------
Steele, Lea & Flood 2014 (SplitMix64). Wichura 1988, Applied Statistics 37, 477 (AS 241). Marsaglia & Tsang 2000, ACM
TOMS 26, 363.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.rng import GOLDEN, mix_bits

# Coefficients of the inverse normal distribution function (AS 241, PPND16) in its middle, its tails and its far tails.
# Each is a ratio of two polynomials: (numerator, denominator), lowest power first.
_MIDDLE = (
    (
        3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3, 1.3731693765509461125e4,
        4.5921953931549871457e4, 6.7265770927008700853e4, 3.3430575583588128105e4, 2.5090809287301226727e3,
    ),
    (
        1.0, 4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3,
        2.1213794301586595867e4, 3.9307895800092710610e4, 2.8729085735721942674e4, 5.2264952788528545610e3,
    ),
)  # fmt: skip
_TAIL = (
    (
        1.42343711074968357734e0, 4.63033784615654529590e0, 5.76949722146069140550e0, 3.64784832476320460504e0,
        1.27045825245236838258e0, 2.41780725177450611770e-1, 2.27238449892691845833e-2, 7.74545014278341407640e-4,
    ),
    (
        1.0, 2.05319162663775882187e0, 1.67638483018380384940e0, 6.89767334985100004550e-1,
        1.48103976427480074590e-1, 1.51986665636164571966e-2, 5.47593808499534494600e-4, 1.05075007164441684324e-9,
    ),
)  # fmt: skip
_FAR_TAIL = (
    (
        6.65790464350110377720e0, 5.46378491116411436990e0, 1.78482653991729133580e0, 2.96560571828504891230e-1,
        2.65321895265761230930e-2, 1.24266094738807843860e-3, 2.71155556874348757815e-5, 2.01033439929228813265e-7,
    ),
    (
        1.0, 5.99832206555887937690e-1, 1.36929880922735805310e-1, 1.48753612908506148525e-2,
        7.86869131145613259100e-4, 1.84631831751005468180e-5, 1.42151175831644588870e-7, 2.04426310338993978564e-15,
    ),
)  # fmt: skip
# Largest mean for which a Poisson number is drawn at once, since exp(-mean) must not underflow. A number with a larger
# mean is the sum of several numbers with smaller means.
_LARGEST_MEAN = 600.0
_S12 = np.uint64(12)

_mix_bits = exact_jit(mix_bits)


@exact_jit
def child_key(key: Any, number: Any) -> Any:
    """Derive the key number `number` (an integer, 0 or more) from the uint64 `key`, for example for one more draw.

    Different numbers give different, statistically independent keys.
    """
    return _mix_bits(key + (np.uint64(number) + np.uint64(1)) * GOLDEN)


@exact_jit
def uniform(key: Any) -> Any:
    """Return a uniform number in (0, 1) from a uint64 key.

    It has the form (k + 1/2) 2^-52 with an integer k, which is never rounded to 0 or 1.
    """
    return (np.float64(key >> _S12) + 0.5) * 2.0**-52


@exact_jit
def normal(key: Any) -> Any:
    """Return a standard normal deviate from a uint64 key, by inversion of the cumulative distribution.

    The relative error of the inversion is 1e-15.
    """
    u = uniform(key)
    q = u - 0.5
    if abs(q) <= 0.425:
        return q * _ratio(_MIDDLE, 0.180625 - q * q)
    r = np.sqrt(-np.log(u if q < 0.0 else 1.0 - u))
    x = _ratio(_TAIL, r - 1.6) if r <= 5.0 else _ratio(_FAR_TAIL, r - 5.0)
    return -x if q < 0.0 else x


@exact_jit
def _ratio(coefficients: Any, x: Any) -> Any:
    numerator, denominator = coefficients[0][7], coefficients[1][7]
    for i in range(6, -1, -1):
        numerator = numerator * x + coefficients[0][i]
        denominator = denominator * x + coefficients[1][i]
    return numerator / denominator


@exact_jit
def poisson(key: Any, mean: Any) -> Any:
    """Return a Poisson number from a uint64 key, by inversion; `mean` is 0 or more, which is not checked.

    The time grows in proportion to the mean.
    """
    pieces = int(mean / _LARGEST_MEAN) + 1
    part_mean = mean / pieces
    total = 0
    for piece in range(pieces):
        u = uniform(child_key(key, piece))
        probability = np.exp(-part_mean)
        cumulative, count = probability, 0
        # Also stop if `probability` underflows to 0: for u very close to 1, rounding keeps the sum below u.
        while u > cumulative and probability > 0.0:
            count += 1
            probability *= part_mean / count
            cumulative += probability
        total += count
    return total


@exact_jit
def gamma(key: Any, shape: Any) -> Any:
    """Return a standard gamma deviate from a uint64 key, by the rejection method of Marsaglia & Tsang 2000.

    `shape` is the shape parameter, above 0, which is not checked.
    """
    d = (shape if shape >= 1.0 else shape + 1.0) - 1.0 / 3.0
    c = 1.0 / np.sqrt(9.0 * d)
    trial = 1
    while True:
        x = normal(child_key(key, trial))
        v = (1.0 + c * x) ** 3
        if v > 0.0 and np.log(uniform(child_key(key, trial + 1))) < 0.5 * x * x + d - d * v + d * np.log(v):
            break
        trial += 2
    return d * v if shape >= 1.0 else d * v * uniform(child_key(key, 0)) ** (1.0 / shape)


@exact_jit
def uniforms(keys: Any, number: Any, out: Any) -> None:
    """Fill `out` with one uniform number in (0, 1) per source.

    Parameters
    ----------
    keys : uint64 array, shape (n,)
        Key of each source.
    number : int
        Number of the draw, 0 or more: the number is drawn from `child_key(key, number)`.
    out : float64 array, shape (n,)
        Output: the numbers.
    """
    for i in range(keys.size):
        out[i] = uniform(child_key(keys[i], number))


@exact_jit
def normals(keys: Any, number: Any, out: Any) -> None:
    """Fill `out` with one standard normal deviate per source.

    Parameters
    ----------
    keys : uint64 array, shape (n,)
        Key of each source.
    number : int
        Number of the draw, 0 or more: the deviate is drawn from `child_key(key, number)`.
    out : float64 array, shape (n,)
        Output: the deviates.
    """
    for i in range(keys.size):
        out[i] = normal(child_key(keys[i], number))


@exact_jit
def gammas(keys: Any, number: Any, shapes: Any, out: Any) -> None:
    """Fill `out` with one standard gamma deviate per source.

    Parameters
    ----------
    keys : uint64 array, shape (n,)
        Key of each source.
    number : int
        Number of the draw, 0 or more: the deviate is drawn from `child_key(key, number)`.
    shapes : float64 array, shape (n,)
        Shape parameter of each source's distribution, above 0, which is not checked.
    out : float64 array, shape (n,)
        Output: the deviates.
    """
    for i in range(keys.size):
        out[i] = gamma(child_key(keys[i], number), shapes[i])
