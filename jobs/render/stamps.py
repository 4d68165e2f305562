"""Drawing sources: each on its own stamp, through its own PSF, in Fourier space, summed onto a frame.

A stamp's image is the inverse transform of profile(k) PSF(k) pixel(k) on the stamp's own k grid.  Light that
belongs outside a stamp comes in at its opposite edge: nothing is lost, nothing is rescaled.  A stamp is large
enough that what wraps is below the noise at its edge, and below the flux budget in the source's aperture.

Sources         what is drawn: galaxies (with a shape) and points
stamp_sizes     pixels, from flux, shape, PSF, noise and accuracy
draw            sources -> frame
reference       one source by galsim's own drawImage: what `draw` is held against
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import galsim
import numpy as np
import numpy.typing as npt
import scipy.fft

from jobs.accuracy import Accuracy
from jobs.render import kernel, profiles, sersic
from jobs.render import psf as psfs
from jobs.render.profiles import Shapes
from jobs.render.psf import SIDE, Psf, Transfer

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Array = npt.NDArray[Any]

# Sides whose transforms are fast; the last bounds memory (its k plane has 134 MB).
SIZES = np.array([32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048])
# The aperture in which wrapped light is held to the flux budget: this many PSF widths plus half-light radii.
_APERTURE_WIDTHS, _APERTURE_RADII = 2.0, 2.0
# Above this many electrons the rounding of single precision would show.
_BRIGHT = 1e7
# Larger stamps collapse the PSF's planes first: their planes would not fit into memory.
_SHARED = 256
# What galsim takes for a point in the reference, arcsec.
_POINT = 1e-6


@dataclass(frozen=True, slots=True)
class Sources:
    """n sources in the order in which they are drawn (ascending id).

    column, row : float64[n] 0-based pixel position
    jacobian    : float64[n, 2, 2] d(u, v) / d(column, row), arcsec
    electrons   : float64[n] expected
    shape       : row of `shapes`, -1 = a point
    photons     : float64[n, w] fraction of its photons in each sub-band of the PSF; None: flat f_nu
    """

    ids: Int
    column: Float
    row: Float
    jacobian: Float
    electrons: Float
    shape: Int
    shapes: Shapes
    photons: Float | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, chosen: npt.NDArray[np.bool_] | Int) -> Sources:
        """Some of the sources."""
        return Sources(
            self.ids[chosen],
            self.column[chosen],
            self.row[chosen],
            self.jacobian[chosen],
            self.electrons[chosen],
            self.shape[chosen],
            self.shapes,
            None if self.photons is None else self.photons[chosen],
        )


def stamp_sizes(electrons: Float, shape: Int, shapes: Shapes, psf: Psf, noise: float, accuracy: Accuracy) -> Int:
    """Side of each source's stamp, pixels.

    noise    : of a pixel, electrons
    accuracy : at the stamp's edge the surface brightness is below `background` of the noise, and of the light
               that wraps less than `flux` of the source falls into its aperture
    returns  : int64[n], one of SIZES
    """
    half = SIZES // 2
    radius = half * psf.pixel_scale
    inside = np.minimum(half, SIDE // 2 - 1)
    edge = np.where(half < SIDE // 2, psf.surface[inside], 0.0)
    beyond = psf.outside[inside]
    surface, lost = np.tile(edge, (len(shape), 1)), np.tile(beyond, (len(shape), 1))
    aperture = np.full(len(shape), _APERTURE_WIDTHS * psf.fwhm)
    is_galaxy = shape >= 0
    if is_galaxy.any():
        which = shape[is_galaxy]
        surface[is_galaxy] += profiles.surface(shapes, radius)[which] * psf.pixel_scale**2
        lost[is_galaxy] += profiles.outside(shapes, radius)[which]
        aperture[is_galaxy] += _APERTURE_RADII * profiles.half_light_radius(shapes)[which]
    covered = np.minimum(np.pi * aperture[:, None] ** 2 / (2 * radius) ** 2, 1.0)
    enough = (electrons[:, None] * surface < accuracy.background * noise) & (lost * covered < accuracy.flux)
    enough[:, -1] = True
    # A point has no light beyond the PSF's plane.
    enough[~is_galaxy, int(np.searchsorted(SIZES, SIDE)) :] = True
    return np.asarray(SIZES[np.argmax(enough, axis=1)])


def draw(
    sources: Sources,
    sizes: Int,
    psf: Psf,
    nx: int,
    ny: int,
    progress: Callable[[int], None] | None = None,
    floors: Float | None = None,
) -> Float:
    """Expected electrons of the sources alone.

    sizes    : int[n] from stamp_sizes;  floors : float[n] from `floors`, None: nothing is left out
    progress : called now and then with the number of sources drawn
    returns  : float64[ny, nx], to 5e-7 electrons a source; the same, bit by bit, in any order of the sources
    """
    frame = np.zeros((ny, nx), np.int64)
    weights = psfs.basis_weights(psf, sources.photons, sources.column, sources.row)
    bodies = _bodies(sources)
    left_out = np.zeros(len(sources)) if floors is None else floors
    shared: dict[int, Transfer] = {}
    # Stamps of one size follow each other, so that one size's planes are in memory.
    for count, i in enumerate(np.argsort(sizes, kind="stable")):
        size = int(sizes[i])
        bright = sources.electrons[i] > _BRIGHT
        dtype = np.float64 if bright else np.float32
        if bright or (size > _SHARED and psf.planes is not None):
            passed, share = psfs.collapsed(psf, weights[i], size, dtype), np.ones(1, dtype)
        else:
            if size not in shared:
                shared = {size: psfs.transfer(psf, size)}
            passed, share = shared[size], weights[i].astype(np.float32)
        x0, y0 = (int(np.rint(position[i])) - size // 2 for position in (sources.column, sources.row))
        zone = np.empty((size, size // 2 + 1), np.complex128 if bright else np.complex64)
        kernel.nyquist_zone(
            passed.planes, share, passed.low, passed.high, passed.envelope, psfs.ENVELOPE_STEP,
            *(part[i] for part in bodies), float(left_out[i]),
            sources.column[i] - x0, sources.row[i] - y0, float(sources.electrons[i]), zone,
        )  # fmt: skip
        kernel.accumulate(frame, scipy.fft.irfft2(zone, s=(size, size), overwrite_x=True), x0, y0)
        if progress is not None and count % 100 == 0:
            progress(count)
    return frame / kernel.FIXED_POINT


class _Bodies(NamedTuple):
    """The kernel's arguments of each source's profile, arrays [n]."""

    body: Array
    fraction: Float
    bulge: Float
    disk: Float
    thick: Float
    sersic: Sequence[Array]
    row: Int
    row_weights: Float


def _bodies(sources: Sources) -> _Bodies:
    n, table = len(sources), sersic.table()
    body = sources.shape >= 0
    out = _Bodies(
        body, np.zeros(n), np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2)), [table] * n,
        np.zeros(n, np.int64), np.zeros((n, 4)),
    )  # fmt: skip
    if body.any():
        shapes = sources.shapes.take(sources.shape[body])
        form = profiles.forms(shapes, sources.jacobian[body])
        out.fraction[body] = shapes.bulge_fraction
        out.bulge[body], out.disk[body], out.thick[body] = form.bulge, form.disk, form.thick
        out.row[body], out.row_weights[body] = sersic.row_of(shapes.sersic_index)
    return out


def reference(sources: Sources, i: int, psf: Psf, size: int, accuracy: float = 1e-4) -> Float:
    """Source i by galsim.Convolve and drawImage, tight thresholds: slow, with none of `draw`'s transforms.

    returns : float64[size, size], lower left pixel at round(position) - size / 2
    """
    settings = galsim.GSParams(
        folding_threshold=accuracy, maxk_threshold=accuracy, kvalue_accuracy=1e-7, maximum_fft_size=16384
    )
    weights = psfs.basis_weights(psf, sources.photons, sources.column, sources.row)[i]
    parts = [psfs.profile_of(psf, weights).dilate(1.0 / psf.pixel_scale), galsim.Pixel(1.0)]
    if sources.shape[i] >= 0:
        profile = profiles.profile(sources.shapes, int(sources.shape[i]), _POINT)
        # World frame, arcsec -> pixels, the flux kept.
        parts.append(galsim.JacobianWCS(*sources.jacobian[i].ravel()).toImage(profile))
    whole = galsim.Convolve(parts, gsparams=settings) * float(sources.electrons[i])
    x0, y0 = (int(np.rint(position[i])) - size // 2 for position in (sources.column, sources.row))
    centre = galsim.PositionD(sources.column[i] - x0, sources.row[i] - y0)
    image = galsim.ImageD(galsim.BoundsI(0, size - 1, 0, size - 1), scale=1.0)
    whole.drawImage(image, center=centre, method="no_pixel")
    return np.asarray(image.array)
