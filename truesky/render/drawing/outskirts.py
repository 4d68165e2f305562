"""Outer light of galaxies that are larger than the largest stamp, in real space.

A stamp is periodic. For a galaxy that exceeds it, the aliased light is removed from the stamp, and the light outside
the stamp is drawn pixel by pixel. The size of a galaxy is therefore not limited. At these distances the profile is
smooth on the scale of a pixel. A bulge is evaluated in closed form, and a disc from a table of its light integrated
along the line of sight. The effect of the PSF is small and even smoother; it is evaluated on blocks of pixels.

References
----------
van der Kruit & Searle 1981 (scale height of discs).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.signal import fftconvolve
from scipy.special import gammaincc, gammaln

from lake_schema.arrays import Array, Float, Int
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from truesky.numerics import matrices
from truesky.numerics.compiling import jit
from truesky.render.drawing import transfer
from truesky.render.drawing.kernels.frame import BULGE, BULGE_FORM, DISK, DISK_FORM, POWER
from truesky.render.psf.model import SAMPLES, Psf
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import Forms, Shapes
from truesky.render.sources.selection import FARTHEST

# Measured CPU time, s (2.5 GHz, one core), per pixel of the frame and of the stamp.
FRAME_S, STAMP_S = 6e-8, 4e-7
# Light of a galaxy is noticeable above this fraction of the pixel noise. The limit is lower than for effects, since the
# light is coherent over many pixels.
_NOTICED = 1e-2
# Spacing of the nodes for the effect of the PSF: largest and smallest, pixels; axis ratio from which the largest is
# sufficient; largest number of nodes from a galaxy to the end of its light for smaller spacings.
_BLOCK, _FINEST_BLOCK, _SLIM, _MOST_NODES = 8, 2, 0.025, 1536
# Periodic images of a galaxy are summed in rings around its stamp, at most this number. The sum ends when the number of
# the ring times its deviation from uniform light is below the second value, electrons per pixel.
_RINGS, _UNEVEN = 64, 0.05
# Spacing of the nodes in a ring: smallest, pixels; largest, in sides of a stamp; and as a fraction of the width of the
# ellipse at that distance.
_FINEST, _COARSEST, _SPACING_FRACTION = 4, 1.0 / 16.0, 0.2
# Radius up to which a PSF without planes is evaluated, pixels. For an atmosphere, 1e-5 of the light lies beyond it.
_MOFFAT = 128
# Table of a disc: nodes per axis; spacing of t, with u = sinh t; points along the line of sight; extent of the disc in
# scale lengths and in scale heights; smallest light.
_NODES, _STEP, _POINTS, _LENGTHS, _HEIGHTS, _DARK = 76, 1.0 / 16.0, 512, 45.0, 20.0, 1e-40
# Light below this is neglected, electrons per pixel.
_NEGLIGIBLE = 1e-4
# Smallest axis ratio of all sources, reached by bulges.
_THINNEST = 0.02
# Number of directions for the integral of a profile outside a square.
_DIRECTIONS = 1440


@dataclass(frozen=True, slots=True)
class Outskirts:
    """Light of one galaxy as a function of the pixel offset (x, y) from its middle.

    Attributes
    ----------
    light : float array, shape (11,)
        Row of `galaxy_shapes.real_space_profile`, electrons, with matrix and light of the disc seen face-on.
    disk : float array, shape (n, n)
        Logarithm of the disc's light at u = sinh and v = w sinh of the nodes.
    across : float
        Ratio w of v to the sinh of the nodes, see `surface_disk`.
    blurred : float array, shape (m, m)
        Light that the PSF adds to a pixel, at nodes `block` pixels apart with the galaxy in the middle.
    block : int
        Spacing of these nodes, pixels.
    """

    light: Float
    disk: Float
    across: float
    blurred: Float
    block: int


def from_galaxy(shape: Shapes, form: Forms, electrons: float, psf: Psf, weights: Float, farthest: float) -> Outskirts:
    """Compute the outskirts of a galaxy.

    Parameters
    ----------
    shape, form : Shapes, Forms
        Shape and form of one galaxy.
    electrons : float
        Expected electrons.
    psf : Psf
        PSF of the detector.
    weights : float array, shape (planes,)
        Weights of `transfer.basis_weights`.
    farthest : float
        Largest distance along columns or rows at which light is needed, pixels.

    Returns
    -------
    Outskirts
        The outer light.

    Notes
    -----
    The error next to the stamp is 1e-3 of the light there. For bulges thinner than 1 : 50 it is a few per cent along
    the major axis.
    """
    light = galaxy_shapes.real_space_profile(shape, form)[0].copy()
    inclination = float(shape.inclination[0])
    cosine, sine = np.cos(np.radians(inclination)), np.sin(np.radians(inclination))
    across = form.disk[0, :, 1] * cosine + form.thick[0] / (0.5 * np.pi * DISK_SCALE_HEIGHT) * sine
    matrix = np.column_stack([form.disk[0, :, 0], across])
    area = abs(float(matrices.determinant(matrix)))
    if light[DISK] > 0.0:
        light[DISK] = (1.0 - shape.bulge_fraction[0]) / area
        light[DISK_FORM : DISK_FORM + 4] = matrices.inverse(matrix).ravel()
    light[[BULGE, DISK]] *= electrons
    disk, wide = surface_disk(inclination)
    block = _block(slimness(light, wide), farthest)
    cells = _cells(psf, weights, block)
    half = int(np.ceil(farthest / block)) + 1 + len(cells) // 2
    unblurred = np.zeros((2 * half + 1, 2 * half + 1))
    _sample(light, disk, wide, float(half * block), float(half * block), float(block), unblurred)
    return Outskirts(light, disk, wide, fftconvolve(unblurred, cells, mode="valid"), block)


@lru_cache(maxsize=16)
def surface_disk(inclination: float) -> tuple[Float, float]:
    """Table of the light of an inclined disc of finite thickness, with scale length 1 and flux 1.

    Parameters
    ----------
    inclination : float
        Inclination, deg.

    Returns
    -------
    (float array, float)
        Logarithm of the light at u, v = (sinh t, w sinh t) along the major and minor axes, and w. The nodes of t start
        one step below 0, so that the table extends beyond its axes.

    Notes
    -----
    The light is the integral of exp(-R) sech^2(z / h) along the line of sight. The error is 1e-4. It is 3e-3 at the
    axes within half a scale length of the middle. It is 8e-3 within a fifth of a scale length of the cusp of a face-on
    disc, which lies inside the stamp.
    """
    cosine, sine = (float(f(np.radians(inclination))) for f in (np.cos, np.sin))
    wide = float(np.hypot(cosine, DISK_SCALE_HEIGHT))
    along = np.sinh(_STEP * np.abs(np.arange(-1, _NODES - 1)))
    u, v = along[:, None, None], wide * along[None, :, None]
    # Section of the line of sight inside the disc.
    thick = _HEIGHTS * DISK_SCALE_HEIGHT
    inverse = 1.0 / max(cosine, 1e-9), 1.0 / max(sine, 1e-9)
    first = np.maximum((-thick - v * sine) * inverse[0], (v * cosine - _LENGTHS) * inverse[1])
    last = np.minimum((thick - v * sine) * inverse[0], (v * cosine + _LENGTHS) * inverse[1])
    length = np.maximum(last - first, 0.0)
    s = first + length * (np.arange(_POINTS) + 0.5) / _POINTS
    height = np.abs(v * sine + s * cosine) / DISK_SCALE_HEIGHT
    # This form of sech^2 does not overflow.
    fading = np.exp(-2.0 * height)
    light = np.exp(-np.hypot(u, v * cosine - s * sine)) * 4.0 * fading / (1.0 + fading) ** 2
    total = light.sum(axis=2) * length[..., 0] / _POINTS / (4.0 * np.pi * DISK_SCALE_HEIGHT)
    return np.log(np.maximum(total, _DARK)), wide


def _block(slim: float, farthest: float) -> int:
    """Spacing of the nodes for the PSF's effect, pixels, for axis ratio `slim` and light up to `farthest` pixels."""
    block = _BLOCK
    while block > _FINEST_BLOCK and slim < _SLIM * block / _BLOCK and farthest <= _MOST_NODES * (block // 2):
        block //= 2
    return block


def _cells(psf: Psf, weights: Float, block: int) -> Float:
    """PSF minus a delta function, on nodes `block` pixels apart.

    Each of its samples is distributed to five nodes per direction, which preserves moments up to the fourth and
    includes the pixel.
    """
    if psf.planes is None:
        side = 2 * _MOFFAT * SAMPLES + 1
        drawn = psf.profile.drawImage(nx=side, ny=side, scale=psf.pixel_scale / SAMPLES, method="no_pixel")
        image = drawn.array / drawn.array.sum(dtype=float)
    else:
        image = np.asarray(transfer.image_of(psf.planes, weights), float)
    samples = SAMPLES if psf.planes is None else psf.planes.samples
    sides = [_shares(length, block, samples) for length in image.shape]
    out: Float = matrices.matmul(sides[0].T, matrices.matmul(image, sides[1]))
    out[len(out) // 2, len(out) // 2] -= 1.0
    return np.asarray(out)


def _shares(length: int, block: int, samples: int) -> Float:
    """Shares [length, nodes] of a line of samples in the nodes, about the middle, with `samples` per pixel."""
    place = (np.arange(length) - length // 2) / (samples * block)
    node = np.rint(place).astype(int)
    off, pixel = place - node, 1.0 / (12.0 * block**2)
    half = int(np.abs(node).max()) + 2
    out = np.zeros((length, 2 * half + 1))
    # Moments of a pixel about the node.
    first, second, third = off, off**2 + pixel, off**3 + 3.0 * off * pixel
    fourth = off**4 + 6.0 * off**2 * pixel + 1.8 * pixel**2
    for step, share in (
        (-2, (2.0 * first - second - 2.0 * third + fourth) / 24.0),
        (-1, (-4.0 * first + 4.0 * second + third - fourth) / 6.0),
        (0, 1.0 - (5.0 * second - fourth) / 4.0),
        (1, (4.0 * first + 4.0 * second - third - fourth) / 6.0),
        (2, (-2.0 * first - second + 2.0 * third + fourth) / 24.0),
    ):
        out[np.arange(length), node + half + step] = share
    return out


def remove_aliased(galaxy: Outskirts, stamp: Array, x: float, y: float) -> None:
    """Subtract the aliased light of a galaxy from its stamp.

    Parameters
    ----------
    galaxy : Outskirts
        Light of the galaxy.
    stamp : array, shape (N, N)
        Stamp, changed in place.
    x, y : float
        Position of the galaxy in the stamp, pixels.
    """
    size, middle = len(stamp), galaxy.block * (len(galaxy.blurred) // 2)
    aliased, blurred, pixels = (
        distant_image_light(galaxy, size, x, y),
        _spline(galaxy.blurred, galaxy.block),
        np.arange(size),
    )
    for up in (-size, 0, size):
        for right in (-size, 0, size):
            if up or right:
                aliased += blurred(pixels - y - up + middle, pixels - x - right + middle)
    _remove_aliased(galaxy.light, galaxy.disk, galaxy.across, aliased, x, y, stamp)


def distant_image_light(galaxy: Outskirts, size: int, x: float, y: float) -> Float:
    """Light in a stamp from all periodic images of a galaxy except those in the eight neighbouring stamps.

    Parameters
    ----------
    galaxy : Outskirts
        Light of the galaxy.
    size : int
        Side of the stamp, pixels; a power of two.
    x, y : float
        Position of the galaxy in the stamp, pixels.

    Returns
    -------
    float array, shape (size, size)
        Electrons, with an error of 0.05 electrons; 1e-3 of the light for axis ratio 0.02.

    Notes
    -----
    The images of an ellipse add up to uniform light only if they are wider than a stamp. This happens farther out for
    thinner ellipses.
    """
    slim, pixels = slimness(galaxy.light, galaxy.across), np.arange(size)
    out, ring_sum, step = np.zeros((size, size)), np.zeros((1, 1)), 0
    remaining = _light_outside_square(galaxy.light, galaxy.across, 1.5 * size) / size**2
    for ring in range(2, _RINGS + 1):
        ring_step = 2 ** int(np.log2(np.clip(_SPACING_FRACTION * slim * ring * size, _FINEST, _COARSEST * size)))
        if ring_step != step:
            if step:
                out += _spline(ring_sum, step)(pixels, pixels)
            step, ring_sum = ring_step, np.zeros((size // ring_step + 1, size // ring_step + 1))
        ring_light = np.zeros(ring_sum.shape)
        for up in range(-ring, ring + 1):
            for right in range(-ring, ring + 1) if abs(up) == ring else (-ring, ring):
                _sample(
                    galaxy.light, galaxy.disk, galaxy.across, x + right * size, y + up * size, float(step), ring_light
                )
        ring_sum += ring_light
        even, remaining = remaining, _light_outside_square(galaxy.light, galaxy.across, (ring + 0.5) * size) / size**2
        if ring * np.abs(ring_light - (even - remaining)).max() < _UNEVEN:
            break
    out += _spline(ring_sum + remaining, step)(pixels, pixels)
    return out


def _spline(values: Float, step: int) -> RectBivariateSpline:
    """Spline through nodes `step` apart in both directions, the first of them at 0."""
    nodes = step * np.arange(len(values))
    return RectBivariateSpline(nodes, nodes, values)


def slimness(light: Float, across: float) -> float:
    """Axis ratio of the thinner component on the pixels, for `light` and `across` of `Outskirts`."""
    out = 1.0
    for middle, first, width in ((BULGE, BULGE_FORM, 1.0), (DISK, DISK_FORM, across)):
        if light[middle] > 0.0:
            matrix = light[first : first + 4].reshape(2, 2) / np.array([[1.0], [width]])
            half, area = 0.5 * float((matrix**2).sum()), abs(float(matrices.determinant(matrix)))
            out = min(out, area / (half + np.sqrt(max(half**2 - area**2, 0.0))))
    return out


def add(
    galaxy: Outskirts, frame: Int, column: float, row: float, hole: tuple[int, int, int], unread_rows: tuple[int, int],
    unit: float,
) -> int:  # fmt: skip
    """Add a galaxy to a frame, except within its stamp.

    Parameters
    ----------
    galaxy : Outskirts
        Light of the galaxy.
    frame : int array, shape (ny, nx)
        Frame, changed in place.
    column, row : float
        Position of the galaxy, pixels.
    hole : (int, int, int)
        First column, first row and side of the stamp.
    unread_rows : (int, int)
        Rows that are not counted in the result, see `stamps.Tally`.
    unit : float
        Units of the frame per electron.

    Returns
    -------
    int
        Light on the counted rows, in units.
    """
    return int(
        _add_galaxy(
            galaxy.light,
            galaxy.disk,
            galaxy.across,
            galaxy.blurred,
            galaxy.block,
            frame,
            column,
            row,
            hole,
            unread_rows,
            unit,
        )
    )


def reach(electrons: Float, shapes: Shapes, pixel_scale: float, noise: float, min_radius: float) -> Float:
    """Radius up to which galaxies are noticeable.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    shapes : Shapes
        Shapes of the n galaxies.
    pixel_scale : float
        Arcsec per pixel.
    noise : float
        Noise per pixel, electrons.
    min_radius : float
        Smallest radius, arcsec.

    Returns
    -------
    float array, shape (n,)
        Radius in arcsec, `min_radius` to FARTHEST in steps of 10 %.
    """
    out, remaining = np.full(len(electrons), min(min_radius, FARTHEST)), np.arange(len(electrons))
    while len(remaining):
        brightness = (
            galaxy_shapes.surface_brightness(shapes.take(remaining), out[remaining[:1]])[:, 0]
            * pixel_scale**2
            * electrons[remaining]
        )
        remaining = remaining[(brightness > _NOTICED * noise) & (out[remaining] < FARTHEST)]
        out[remaining] = np.minimum(1.1 * out[remaining], FARTHEST)
    return out


def min_noticeable_electrons(distance: float, pixel_scale: float, noise: float) -> float:
    """Smallest number of electrons of a galaxy that could be noticeable at a distance.

    Parameters
    ----------
    distance : float
        Distance from the galaxy, arcsec.
    pixel_scale : float
        Arcsec per pixel.
    noise : float
        Noise per pixel, electrons.

    Returns
    -------
    float
        Electrons. The limit uses that no profile rises outward.
    """
    return float(_NOTICED * noise * np.pi * _THINNEST * (distance / pixel_scale) ** 2)


def _light_outside_square(light: Float, across: float, half: float) -> float:
    """Electrons outside a centred square of a given half side in pixels, for a thin disc."""
    angle = 2 * np.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    ray = np.stack([np.cos(angle), np.sin(angle)])
    total = 0.0
    if light[BULGE] > 0.0:
        n, inverse = 0.5 / light[POWER], light[BULGE_FORM : BULGE_FORM + 4].reshape(2, 2)
        edge = half / np.abs(matrices.matmul(matrices.inverse(inverse), ray)).max(axis=0)
        bulge_light = light[BULGE] * np.exp(_log_bulge_total(n)) / abs(float(matrices.determinant(inverse)))
        total += bulge_light * float(gammaincc(2 * n, edge ** (1.0 / n)).mean())
    if light[DISK] > 0.0:
        inverse = light[DISK_FORM : DISK_FORM + 4].reshape(2, 2)
        edge = half / np.abs(matrices.matmul(matrices.inverse(inverse), ray * [[1.0], [across]])).max(axis=0)
        total += light[DISK] / abs(float(matrices.determinant(inverse))) * float(((1.0 + edge) * np.exp(-edge)).mean())
    return total


def _log_bulge_total(n: float) -> float:
    """Logarithm of a bulge's total light over that in the middle, for exp(-(u^2 + v^2)^p) with p = 1 / 2n."""
    return float(np.log(2 * np.pi * n) + gammaln(2 * n))


@jit
def _light(light: Float, disk: Float, across: float, x: float, y: float) -> Any:
    """Electrons in a pixel at an offset (x, y) from a galaxy's middle, without PSF."""
    out = 0.0
    if light[BULGE] > 0.0:
        u = light[BULGE_FORM] * x + light[BULGE_FORM + 1] * y
        v = light[BULGE_FORM + 2] * x + light[BULGE_FORM + 3] * y
        out += light[BULGE] * np.exp(-np.exp(light[POWER] * np.log(u * u + v * v + 1e-300)))
    if light[DISK] > 0.0:
        u = abs(light[DISK_FORM] * x + light[DISK_FORM + 1] * y)
        if light[DISK] * np.exp(-u) > _NEGLIGIBLE:
            v = abs(light[DISK_FORM + 2] * x + light[DISK_FORM + 3] * y) / across
            out += light[DISK] * _from_table(disk, np.log(u + np.sqrt(u * u + 1.0)), np.log(v + np.sqrt(v * v + 1.0)))
    return out


@jit
def _from_table(disk: Float, u: float, v: float) -> Any:
    """Interpolate the table of a disc (cubic in both directions) and return its exponential; 0 beyond the table."""
    # The axis is at node 1.
    a, b = u / _STEP + 1.0, v / _STEP + 1.0
    i, j = int(a), int(b)
    if i + 2 >= len(disk) or j + 2 >= len(disk):
        return 0.0
    a, b = a - i, b - j
    total = 0.0
    for r in range(4):
        line = disk[i - 1 + r]
        row_sum = 0.0
        for c in range(4):
            row_sum += _cubic(b, c) * line[j - 1 + c]
        total += _cubic(a, r) * row_sum
    return np.exp(total)


@jit
def _cubic(part: float, node: int) -> Any:
    """Weight of one of four nodes for cubic interpolation at the fraction `part` between the second and third."""
    if node == 0:
        return -part * (part - 1.0) * (part - 2.0) / 6.0
    if node == 1:
        return (part + 1.0) * (part - 1.0) * (part - 2.0) / 2.0
    if node == 2:
        return -(part + 1.0) * part * (part - 2.0) / 2.0
    return (part + 1.0) * part * (part - 1.0) / 6.0


@jit
def _bilinear(nodes: Float, x: float, y: float) -> Any:
    """Interpolate linearly between nodes at integer coordinates; 0 beyond them."""
    i, j = int(np.floor(y)), int(np.floor(x))
    if i < 0 or j < 0 or i + 1 >= nodes.shape[0] or j + 1 >= nodes.shape[1]:
        return 0.0
    up, right = y - i, x - j
    low = (1.0 - right) * nodes[i, j] + right * nodes[i, j + 1]
    return (1.0 - up) * low + up * ((1.0 - right) * nodes[i + 1, j] + right * nodes[i + 1, j + 1])


@jit
def _pixel_light(light: Float, disk: Float, across: float, blurred: Float, block: int, x: float, y: float) -> Any:
    """Electrons in a pixel at an offset (x, y) from a galaxy's middle."""
    middle = blurred.shape[0] // 2
    blur_light = _bilinear(blurred, x / block + middle, y / block + middle)
    return max(_light(light, disk, across, x, y) + blur_light, 0.0)


@jit
def _sample(light: Float, disk: Float, across: float, x: float, y: float, step: float, out: Float) -> None:
    """Add the light of a galaxy at (x, y) to nodes `step` pixels apart, the first of them at 0."""
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] += _light(light, disk, across, step * c - x, step * r - y)


@jit
def _remove_aliased(light: Float, disk: Float, across: float, aliased: Float, x: float, y: float, stamp: Any) -> None:
    size = stamp.shape[0]
    for r in range(size):
        for c in range(size):
            excess = aliased[r, c]
            for up in (-size, 0, size):
                for right in (-size, 0, size):
                    if up != 0 or right != 0:
                        excess += _light(light, disk, across, c - x - right, r - y - up)
            stamp[r, c] -= excess


@jit
def _add_galaxy(
    light: Float, disk: Float, across: float, blurred: Float, block: int, frame: Int, x: float, y: float,
    hole: tuple[int, int, int], unread_rows: tuple[int, int], unit: float,
) -> Any:  # fmt: skip
    ny, nx = frame.shape
    hole_x, hole_y, size = hole
    total = np.int64(0)
    for r in range(ny):
        inside = hole_y <= r < hole_y + size
        read = not unread_rows[0] <= r < unread_rows[1]
        for c in range(nx):
            if inside and hole_x <= c < hole_x + size:
                continue
            units = np.int64(np.rint(_pixel_light(light, disk, across, blurred, block, c - x, r - y) * unit))
            frame[r, c] += units
            if read:
                total += units
    return total
