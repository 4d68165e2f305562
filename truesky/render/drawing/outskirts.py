"""Draw the outer light (outskirts) of galaxies that are larger than the largest stamp, in real space.

A stamp is a square image around one source, drawn by a Fourier transform and therefore periodic: light outside it is
aliased onto it. For a galaxy that exceeds the largest stamp, the aliased light is removed from the stamp, and the light
outside the stamp is drawn pixel by pixel. The size of a galaxy is therefore not limited. At these distances the profile
is smooth on the scale of a pixel. A bulge is evaluated in closed form, and a disc from a table of its light integrated
along the line of sight. The effect of the PSF is small and even smoother. It is evaluated on a coarse grid of nodes.

References
----------
van der Kruit & Searle 1981 (scale height of discs).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from truesky.numerics import matrices
from truesky.render.drawing import psf_on_nodes
from truesky.render.drawing.kernels import outer_light
from truesky.render.drawing.kernels.frame import BULGE, BULGE_FORM, DISK, DISK_FORM, POWER
from truesky.render.drawing.kernels.outer_light import STEP
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import Forms, Shapes
from truesky.render.sources.selection import FARTHEST

# Measured CPU time of drawing the light outside the stamp of one galaxy that exceeds the largest stamp, s per pixel of
# the detector (2.5 GHz, one core). An edge-on disc takes up to four times longer.
FRAME_S = 8e-9
# Measured CPU time of removing aliased light from the stamp of one galaxy that exceeds the largest stamp, s per pixel
# of the stamp (2.5 GHz, one core).
STAMP_S = 1e-7
# Light of a large galaxy is noticeable in a pixel above this fraction of the rms noise of the pixel. The limit is lower
# than the 10 % for effects of the detector, since the light extends smoothly over many pixels.
_NOTICED = 1e-2
# Largest spacing of the grid on which the change of a galaxy's outer light by the PSF is computed, pixels.
_BLOCK = 8
# Smallest spacing of the grid on which the change of a galaxy's outer light by the PSF is computed, pixels.
_FINEST_BLOCK = 2
# Galaxies with at least this axis ratio use the largest spacing (8 pixels) of the grid on which the change of their
# outer light by the PSF is computed. Galaxies thinner than this use 4 pixels, and below half this ratio 2 pixels.
_SLIM = 0.025
# The change of a galaxy's light by the PSF is computed on a grid up to the farthest pixel needed. The spacing of the
# grid is halved for a thin galaxy only if at most this number of grid points then lie between the galaxy and this pixel
# along a column or row.
_MOST_NODES = 1536
# A stamp is repeated periodically. The aliased light of the galaxy's copies is added up in square rings around its
# stamp, up to this number of rings. The light of all farther copies is added as uniform light.
_RINGS = 64
# The sum over rings of periodic copies ends when the light of a ring is nearly uniform over the stamp: when the number
# of the ring (1 for the eight stamps next to the galaxy's stamp), times the largest deviation from uniform light in
# electrons per pixel, is below this value.
_UNEVEN = 0.05
# Smallest spacing of the grid between whose nodes the light of pixels outside a stamp is interpolated, pixels.
_FINEST_STEP = 2
# Smallest spacing of the grid on which the light of a ring of periodic copies of a galaxy is computed, pixels.
_FINEST = 4
# Largest spacing of the grid on which the light of a ring of periodic copies of a galaxy is computed, as a fraction of
# the side of the galaxy's stamp.
_COARSEST = 1.0 / 16.0
# Largest spacing of a grid on which the light of a galaxy is computed, as a fraction of the width (minor axis) that the
# galaxy's ellipse has at the distance of the grid.
_SPACING_FRACTION = 0.2
# Largest spacing of a grid on which the light of a galaxy is computed, as a fraction of the smallest apparent scale of
# the disc. Unlike the width of an ellipse, the thickness of an edge-on disc does not grow with the
# distance.
_DISC_FRACTION = 0.25
# Number of nodes along the major axis, and along the minor axis, of the table of an inclined disc's light.
_NODES = 76
# Number of points along each line of sight through a galaxy's disc at which its light is summed up.
_POINTS = 512
# Largest distance from the major axis, in the plane of a galaxy's disc, up to which its light is integrated, in scale
# lengths of the disc.
_LENGTHS = 45.0
# Largest height above and below the plane of a galaxy's disc up to which its light is integrated, in scale heights.
_HEIGHTS = 20.0
# Smallest value of a disc's light in its table (fraction of the flux per squared scale length). Smaller values are
# replaced by it, because the table contains logarithms.
_DARK = 1e-40
# Smallest axis ratio (minor / major) of any bulge or disc; some bulges have it.
_THINNEST = 0.02
# Number of directions from the middle of a galaxy over which its light outside a square is averaged.
_DIRECTIONS = 1440


@dataclass(frozen=True, slots=True)
class Outskirts:
    """Outer light of one galaxy as a function of the offset (x, y) from its middle in pixels.

    Attributes
    ----------
    light : float array, shape (11,)
        Parameters of bulge and disc as in a row of `galaxy_shapes.real_space_profile`, electrons, with two differences:
        the matrix of the disc is that of the disc seen face-on, and the value for the light in the disc's middle is
        instead the factor by which the light in the table `disk` is multiplied.
    disk : float array, shape (n, n)
        Table of `surface_disk`: natural logarithm of the inclined disc's light at u = sinh t_i along the major axis and
        v = w sinh t_j along the minor axis, in scale lengths. The nodes t are equally spaced.
    across : float
        Factor w of the coordinate v, about the apparent axis ratio of the disc.
    blurred : float array, shape (rows, columns)
        Electrons by which the PSF changes a pixel (also negative), at nodes `block` pixels apart. Node (0, 0) is the
        middle of the galaxy, and may lie outside the array.
    block : int
        Spacing of the nodes of `blurred`, pixels.
    first : (int, int)
        Column and row of the first node of `blurred`, counted in nodes from the middle of the galaxy.
    """

    light: Float
    disk: Float
    across: float
    blurred: Float
    block: int
    first: tuple[int, int]


def from_galaxy(
    shape: Shapes, form: Forms, electrons: float, psf: Psf, weights: Float, region: tuple[float, float, float, float]
) -> Outskirts:
    """Compute the outer light of one galaxy.

    Parameters
    ----------
    shape, form : Shapes, Forms
        Bulge and disc parameters of one galaxy, and the sizes and orientations of both in pixels from
        `galaxy_shapes.forms`.
    electrons : float
        Expected electrons.
    psf : Psf
        PSF of the detector.
    weights : float array, shape (planes,)
        Weights of the PSF's planes (basis images) for this galaxy, from `transfer.basis_weights`.
    region : (float, float, float, float)
        First and last column, and first and last row, at which light is needed, pixels from the middle of the galaxy.

    Returns
    -------
    Outskirts
        The outer light.

    Notes
    -----
    The error next to the stamp is 1e-3 of the light there. Interpolation between the nodes of a grid adds at most about
    1e-4 of the light plus 1e-4 electrons per pixel. For bulges thinner than 1 : 50 it is a few per cent along
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
    block = _block(slimness(light, wide), max(map(abs, region)))
    cells = psf_on_nodes.change_by_psf(psf, weights, block)
    # Number of nodes before the region: cubic interpolation of its first pixels needs values farther out.
    extra = 2 * _BLOCK // block + 1
    first_x, first_y = (int(np.floor(start / block)) - extra for start in (region[0], region[2]))
    end_x, end_y = (int(np.ceil(end / block)) + extra + 2 for end in (region[1], region[3]))
    # Nodes around the region from which the PSF moves light into it.
    margin = len(cells) // 2
    unblurred = np.zeros((end_y - first_y + 2 * margin, end_x - first_x + 2 * margin))
    x, y = float((margin - first_x) * block), float((margin - first_y) * block)
    outer_light.sample(light, disk, wide, x, y, float(block), unblurred)
    blurred = psf_on_nodes.convolve_inside(unblurred, cells)
    return Outskirts(light, disk, wide, blurred, block, (first_x, first_y))


@lru_cache(maxsize=16)
def surface_disk(inclination: float) -> tuple[Float, float]:
    """Return a table of the light of an inclined disc of finite thickness, with scale length 1 and flux 1.

    Parameters
    ----------
    inclination : float
        Inclination, deg, 0 (face-on) to 90.

    Returns
    -------
    (float array, float)
        Table [i, j] of ln(light per squared scale length) at u = sinh t_i along the major axis and v = w sinh t_j along
        the minor axis, in scale lengths; and the factor w. The first node of t is one step below 0, so that cubic
        interpolation works at the axes.

    Notes
    -----
    The light is the integral of exp(-R) sech^2(z / h) along the line of sight, at the radius R in the plane and the
    height z; h is the scale height (DISK_SCALE_HEIGHT, in scale lengths). The relative error is 1e-4. On the axes
    within half a scale length of the middle it is 3e-3. Within a fifth of a scale length of the central cusp of a
    face-on disc, which lies inside the galaxy's stamp, it is 8e-3.
    """
    cosine, sine = (float(f(np.radians(inclination))) for f in (np.cos, np.sin))
    wide = float(np.hypot(cosine, DISK_SCALE_HEIGHT))
    along = np.sinh(STEP * np.abs(np.arange(-1, _NODES - 1)))
    u, v = along[:, None, None], wide * along[None, :, None]
    # First and last point of the part of each line of sight that lies inside the disc.
    thick = _HEIGHTS * DISK_SCALE_HEIGHT
    inverse = 1.0 / max(cosine, 1e-9), 1.0 / max(sine, 1e-9)
    first = np.maximum((-thick - v * sine) * inverse[0], (v * cosine - _LENGTHS) * inverse[1])
    last = np.minimum((thick - v * sine) * inverse[0], (v * cosine + _LENGTHS) * inverse[1])
    length = np.maximum(last - first, 0.0)
    s = first + length * (np.arange(_POINTS) + 0.5) / _POINTS
    height = np.abs(v * sine + s * cosine) / DISK_SCALE_HEIGHT
    # sech^2(x) is computed as 4 exp(-2 x) / (1 + exp(-2 x))^2, which does not overflow for large x.
    fading = np.exp(-2.0 * height)
    light = np.exp(-np.hypot(u, v * cosine - s * sine)) * 4.0 * fading / (1.0 + fading) ** 2
    total = light.sum(axis=2) * length[..., 0] / _POINTS / (4.0 * np.pi * DISK_SCALE_HEIGHT)
    return np.log(np.maximum(total, _DARK)), wide


def _block(slim: float, farthest: float) -> int:
    """Return the spacing (2, 4 or 8 pixels) of the grid on which the change of a galaxy's light by the PSF is computed.

    It is smaller for galaxies with a small axis ratio `slim`, unless the grid, which extends to `farthest` pixels from
    the galaxy, would then have too many points.
    """
    block = _BLOCK
    while block > _FINEST_BLOCK and slim < _SLIM * block / _BLOCK and farthest <= _MOST_NODES * (block // 2):
        block //= 2
    return block


def remove_aliased(galaxy: Outskirts, stamp: Array, x: float, y: float) -> None:
    """Subtract the aliased light of a galaxy from its stamp, the light that a Fourier transform moved onto it.

    Parameters
    ----------
    galaxy : Outskirts
        Light of the galaxy. Its grid `blurred` (change of the light by the PSF) must extend to the corners of the eight
        neighbouring stamps.
    stamp : array, shape (N, N)
        Image of the galaxy, electrons, changed in place. N is a power of two.
    x, y : float
        Position of the galaxy in the stamp, pixels.
    """
    size, half = len(stamp), 0.5 * len(stamp)
    shifts = [(right * size, up * size) for up in (-1, 0, 1) for right in (-1, 0, 1) if up or right]
    region = (-x, size - 1.0 - x, -y, size - 1.0 - y)
    # The nearest copy is at least as far from the stamp as the galaxy is from the stamp's border.
    nodes = _nodes(galaxy, np.array(shifts, float), region, half, (0.0, 0.0, 0.0, 0.0))
    distant = distant_image_light(galaxy, size, x, y)
    outer_light.subtract_copies(*_light_arguments(galaxy), *nodes, -x, -y, distant, stamp)


def _light_arguments(galaxy: Outskirts) -> tuple[Float, Float, float, Float, int, tuple[int, int]]:
    """Return the attributes of a galaxy that the compiled functions of `kernels.outer_light` take first."""
    return galaxy.light, galaxy.disk, galaxy.across, galaxy.blurred, galaxy.block, galaxy.first


def _nodes(
    galaxy: Outskirts,
    copies: Float,
    region: tuple[float, float, float, float],
    nearest: float,
    hole: tuple[float, float, float, float],
) -> tuple[Float, int, tuple[int, int], Float, Bool]:
    """Evaluate the light of a galaxy at the nodes of a grid, between which the light of pixels is interpolated.

    Parameters
    ----------
    galaxy : Outskirts
        Light of the galaxy.
    copies : float array, shape (m, 2)
        Columns and rows of the galaxy or of its periodic copies, pixels from the middle of the galaxy.
    region : (float, float, float, float)
        First and last column, and first and last row, of the pixels, from the middle of the galaxy.
    nearest : float
        Smallest distance of a pixel from the middle of a copy, pixels. It limits the spacing of the nodes.
    hole : (float, float, float, float)
        Columns and rows like `region`, between which no light is needed. The pixels can be closer than `nearest` there.

    Returns
    -------
    tuple
        `copies`, spacing of the nodes, first column and row of the nodes, light at the nodes, and mask of the cells
        whose pixels are evaluated directly; these are arguments of the functions of `kernels.outer_light`.
    """
    wide = _SPACING_FRACTION * slimness(galaxy.light, galaxy.across) * nearest
    limit = min(wide, _DISC_FRACTION * _disc_scale(galaxy.light, galaxy.across), galaxy.block)
    step = 2 ** int(np.log2(max(limit, _FINEST_STEP)))
    first_x, first_y = (int(np.floor(start / step)) - 1 for start in (region[0], region[2]))
    end_x, end_y = (int(np.floor(end / step)) + 3 for end in (region[1], region[3]))
    nodes = np.empty((end_y - first_y, end_x - first_x))
    direct = np.empty((nodes.shape[0] - 3, nodes.shape[1] - 3), bool)
    outer_light.sample_copies(*_light_arguments(galaxy), copies, step, (first_x, first_y), hole, nodes, direct)
    return copies, step, (first_x, first_y), nodes, direct


def distant_image_light(galaxy: Outskirts, size: int, x: float, y: float) -> Float:
    """Return the light in a stamp from the distant periodic copies of a galaxy.

    A stamp is repeated periodically. The copies in the eight neighbouring stamps are not included.

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
        Electrons in each pixel, with an error of 0.05 electrons, or of 1e-3 of the light for the axis ratio 0.02.

    Notes
    -----
    The light of the copies is computed ring by ring, in square rings around the stamp, until that of a ring is nearly
    uniform over the stamp. All light of copies farther out is then added as uniform light. For thinner galaxies, this
    is the case farther out.
    """
    slim, pixels = slimness(galaxy.light, galaxy.across), np.arange(size)
    coarsest = min(_COARSEST * size, max(_DISC_FRACTION * _disc_scale(galaxy.light, galaxy.across), _FINEST))
    out, ring_sum, step = np.zeros((size, size)), np.zeros((1, 1)), 0
    remaining = _light_outside_square(galaxy.light, galaxy.across, 1.5 * size) / size**2
    for ring in range(2, _RINGS + 1):
        ring_step = 2 ** int(np.log2(np.clip(_SPACING_FRACTION * slim * ring * size, _FINEST, coarsest)))
        if ring_step != step:
            if step:
                out += _spline(ring_sum, step)(pixels, pixels)
            step, ring_sum = ring_step, np.zeros((size // ring_step + 1, size // ring_step + 1))
        ring_light = np.zeros(ring_sum.shape)
        for up in range(-ring, ring + 1):
            for right in range(-ring, ring + 1) if abs(up) == ring else (-ring, ring):
                outer_light.sample(
                    galaxy.light, galaxy.disk, galaxy.across, x + right * size, y + up * size, float(step), ring_light
                )
        ring_sum += ring_light
        even, remaining = remaining, _light_outside_square(galaxy.light, galaxy.across, (ring + 0.5) * size) / size**2
        if ring * np.abs(ring_light - (even - remaining)).max() < _UNEVEN:
            break
    out += _spline(ring_sum + remaining, step)(pixels, pixels)
    return out


def _spline(values: Float, step: int) -> scipy.interpolate.RectBivariateSpline:
    """Return the bicubic spline through the values [y, x] at nodes `step` pixels apart, the first of which is at 0."""
    rows, columns = (step * np.arange(count) for count in values.shape)
    return scipy.interpolate.RectBivariateSpline(rows, columns, values)


def slimness(light: Float, across: float) -> float:
    """Return the smaller of the axis ratios, in pixels, of a galaxy's bulge and disc; 1 for a galaxy without light.

    `light` [11] (parameters of bulge and disc) and `across` (factor of the disc's minor axis) are attributes of
    `Outskirts`.
    """
    out = 1.0
    for middle, first, width in ((BULGE, BULGE_FORM, 1.0), (DISK, DISK_FORM, across)):
        if light[middle] > 0.0:
            matrix = light[first : first + 4].reshape(2, 2) / np.array([[1.0], [width]])
            half, area = 0.5 * float((matrix**2).sum()), abs(float(matrices.determinant(matrix)))
            out = min(out, area / (half + np.sqrt(max(half**2 - area**2, 0.0))))
    return out


def _disc_scale(light: Float, across: float) -> float:
    """Return the smallest apparent scale of a galaxy's disc (length or height) in pixels; infinite without a disc.

    `light` [11] (parameters of bulge and disc) and `across` (factor of the disc's minor axis) are attributes of
    `Outskirts`.
    """
    if not light[DISK] > 0.0:
        return np.inf
    matrix = light[DISK_FORM : DISK_FORM + 4].reshape(2, 2) / np.array([[1.0], [across]])
    half, area = 0.5 * float((matrix**2).sum()), float(matrices.determinant(matrix))
    # The inverse of the largest singular value of the matrix, in closed form.
    return float(1.0 / np.sqrt(half + np.sqrt(max(half**2 - area**2, 0.0))))


def add(
    galaxy: Outskirts, frame: Int, column: float, row: float, hole: tuple[int, int, int], unread_rows: tuple[int, int],
    unit: float,
) -> int:  # fmt: skip
    """Add the light of a galaxy to the image of a detector (frame), except within the stamp of the galaxy.

    Parameters
    ----------
    galaxy : Outskirts
        Light of the galaxy.
    frame : int array, shape (ny, nx)
        Frame, changed in place.
    column, row : float
        Position of the galaxy, 0-based pixels; it may lie outside the frame.
    hole : (int, int, int)
        First column, first row and side of the stamp, whose pixels are not changed.
    unread_rows : (int, int)
        First row that the detector does not read, and the row after the last of these rows. They are drawn, but not
        counted in the result.
    unit : float
        Factor from electrons to the integers of the frame.

    Returns
    -------
    int
        Light that was added on read rows, in the integers of the frame.
    """
    (ny, nx), (hole_x, hole_y, size) = frame.shape, hole
    region = (-column, nx - 1.0 - column, -row, ny - 1.0 - row)
    stamp = (hole_x - column, hole_x + size - 1.0 - column, hole_y - row, hole_y + size - 1.0 - row)
    nodes = _nodes(galaxy, np.zeros((1, 2)), region, _nearest_distance(region, stamp), stamp)
    return int(outer_light.add_galaxy(*_light_arguments(galaxy), *nodes, column, row, frame, hole, unread_rows, unit))


def _nearest_distance(region: tuple[float, float, float, float], hole: tuple[float, float, float, float]) -> float:
    """Return a lower limit of the distance in pixels from the middle of a galaxy to a pixel of a region outside a hole.

    `region` and `hole` are the first and last column, and the first and last row, from the middle of the galaxy.
    """
    in_hole = min(-hole[0], hole[1], -hole[2], hole[3])
    outside = max(region[0], -region[1], region[2], -region[3])
    return max(in_hole, outside, 0.0)


def reach(electrons: Float, shapes: Shapes, pixel_scale: float, noise: float, min_radius: float) -> Float:
    """Return the radius up to which the light of each of n galaxies is noticeable.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    shapes : Shapes
        Shapes of the n galaxies.
    pixel_scale : float
        Arcsec per pixel.
    noise : float
        Noise of a pixel, electrons rms. Light below 1 % of the noise is not noticeable.
    min_radius : float
        Smallest radius, arcsec; the result is not smaller, also for faint galaxies.

    Returns
    -------
    float array, shape (n,)
        Radius in arcsec, from `min_radius` in steps of 10 % to at most FARTHEST (1200 arcsec).
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
    """Return a lower limit of the electrons of a large galaxy that is noticeable at a given distance from its middle.

    Parameters
    ----------
    distance : float
        Distance from the galaxy, arcsec.
    pixel_scale : float
        Arcsec per pixel.
    noise : float
        Noise of a pixel, electrons rms. Light below 1 % of the noise is not noticeable.

    Returns
    -------
    float
        Total electrons of the galaxy. Fainter galaxies are not noticeable at this distance, since no profile rises
        outward and no axis ratio is below 0.02.
    """
    return float(_NOTICED * noise * np.pi * _THINNEST * (distance / pixel_scale) ** 2)


def _light_outside_square(light: Float, across: float, half: float) -> float:
    """Return the electrons of a galaxy outside a square centred on it; `half` is half of the square's side in pixels.

    The disc is treated as thin, an approximation. `light` [11] (parameters of bulge and disc) and `across` (factor of
    the disc's minor axis) are attributes of `Outskirts`.
    """
    angle = 2 * np.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    ray = np.stack([np.cos(angle), np.sin(angle)])
    total = 0.0
    if light[BULGE] > 0.0:
        n, inverse = 0.5 / light[POWER], light[BULGE_FORM : BULGE_FORM + 4].reshape(2, 2)
        edge = half / np.abs(matrices.matmul(matrices.inverse(inverse), ray)).max(axis=0)
        bulge_light = light[BULGE] * np.exp(_log_bulge_total(n)) / abs(float(matrices.determinant(inverse)))
        total += bulge_light * float(scipy.special.gammaincc(2 * n, edge ** (1.0 / n)).mean())
    if light[DISK] > 0.0:
        inverse = light[DISK_FORM : DISK_FORM + 4].reshape(2, 2)
        edge = half / np.abs(matrices.matmul(matrices.inverse(inverse), ray * [[1.0], [across]])).max(axis=0)
        total += light[DISK] / abs(float(matrices.determinant(inverse))) * float(((1.0 + edge) * np.exp(-edge)).mean())
    return total


def _log_bulge_total(n: float) -> float:
    """Return the logarithm of the integral of exp(-(u^2 + v^2)^p) over the (u, v) plane, the light of a bulge.

    The light in the bulge's middle is 1. The exponent is p = 1 / (2 n), where n is the Sersic index.
    """
    return float(np.log(2 * np.pi * n) + scipy.special.gammaln(2 * n))
