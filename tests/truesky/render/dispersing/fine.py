"""Spectra drawn finely: by Fourier series at every wavelength, and by GalSim at every tenth of a pixel."""

from dataclasses import dataclass, replace

import galsim
import numpy as np

from truesky.render.dispersing import images
from truesky.render.drawing import transfer
from truesky.render.drawing.kernels import fourier
from truesky.render.psf import model
from truesky.render.sources import galaxy_shapes, sersic

# Samples per pixel of the series; angstroms that share one PSF in galsim; wavelengths per batch.
FINE, BLOCK, TOGETHER = 3, 40.0, 512
# High accuracy, except for steep bulges, whose transforms do not end.
TIGHT = galsim.GSParams(folding_threshold=1e-4, maxk_threshold=1e-4, kvalue_accuracy=1e-7, maximum_fft_size=16384)


def weights_at(through, source, shape):
    """Return [b] weights of the planes for each wavelength of a PSF, at the position of a source.

    Positions outside the frame are replaced by the nearest position on it.
    """
    column, row = (np.clip(at, 0.0, n - 1.0) for at, n in ((source.column, shape[1]), (source.row, shape[0])))
    return [
        transfer.basis_weights(through, part[None], column, row)[0] for part in np.eye(len(through.planes.wavelength))
    ]


@dataclass(frozen=True, slots=True)
class Seen:
    """A PSF on a periodic frame.

    `planes` contains the transforms of its planes, including the pixel, complex[p, rows, columns]. The unit of `fx` and
    `fy` is cycles per pixel.
    """

    through: model.Psf
    shape: tuple[int, int]
    planes: np.ndarray
    fx: np.ndarray
    fy: np.ndarray

    @classmethod
    def of(cls, through, shape):
        (ny, nx), planes = shape, through.planes
        fy, fx = np.fft.fftfreq(ny * FINE, 1.0 / (ny * FINE)) / ny, np.arange(nx * FINE // 2 + 1) / nx
        spectra = []
        for image in (*planes.images, *planes.drift):
            at = (np.arange(len(image)) - len(image) // 2) / planes.samples
            left, right = np.exp(-2j * np.pi * np.outer(fy, at)), np.exp(-2j * np.pi * np.outer(at, fx))
            spectra.append(left @ image.astype(float) @ right * np.sinc(fx) * np.sinc(fy)[:, None])
        return cls(through, shape, np.array(spectra), fx, fy)


def series(source, spectrum, orders, seen):
    """Return the periodic frame [ny, nx] of a single source, from the Fourier series of all wavelengths.

    `spectrum` contains electrons [w] at the wavelengths of the orders.
    """
    ny, nx = seen.shape
    own = [np.tensordot(part, seen.planes, 1) for part in weights_at(seen.through, source, seen.shape)]
    total = np.zeros((len(seen.fy), len(seen.fx)), complex)
    for part in orders:
        for b, light in enumerate(_laid(source, spectrum, part, seen)):
            total += own[b] * light
    if source.shape[0] >= 0:
        total *= profile(source, seen.fx, seen.fy)
    return FINE**2 * np.fft.irfft2(total, s=(ny * FINE, nx * FINE))[::FINE, ::FINE]


def _laid(source, spectrum, part, seen):
    """Return the transforms [b] of the light of an order, one for each PSF."""
    fx, fy, nodes = seen.fx, seen.fy, seen.through.planes.wavelength
    some = np.flatnonzero(spectrum * part.response)
    x, y = part.trace.offsets(float(source.column[0]), float(source.row[0]), part.wavelength[some])
    x, y = x + source.column[0], y + source.row[0]
    light = (spectrum * part.response)[some, None] * images.shares(part.wavelength[some], nodes)
    out = np.zeros((len(nodes), len(fy), len(fx)), complex)
    for start in range(0, len(some), TOGETHER):
        here = np.s_[start : start + TOGETHER]
        up, along = (np.exp(-2j * np.pi * np.outer(f, at[here])) for f, at in ((fy, y), (fx, x)))
        for b in range(len(nodes)):
            out[b] += (up * light[here, b]) @ along.T
    return out


def profile(source, fx, fy):
    """Return the transform [rows, columns] of a single galaxy."""
    shapes = source.shapes.take(source.shape)
    form = galaxy_shapes.forms(shapes, source.jacobian)
    row, weights = sersic.interpolation_weights(shapes.sersic_index)
    table = np.empty(sersic.table().shape[1], np.float32)
    fourier.interpolate_sersic(sersic.table(), int(row[0]), weights[0], 0.0, 1e9, table)
    out, square = np.ones((len(fy), len(fx)), np.float32), np.empty(len(fx), np.float32)
    for line, f in zip(out, fy, strict=True):
        fourier.profile_at(
            float(shapes.bulge_fraction[0]), form.bulge[0], form.disk[0], form.thick[0], table,
            (2 * np.pi * fx).astype(np.float32), np.full(len(fx), 2 * np.pi * f, np.float32), square,
            square.view(np.int32), line,
        )  # fmt: skip
    return out


def by_galsim(source, spectrum, order, through, shape, side=48, step=0.1):
    """Return the frame of a single source and order, drawn by galsim at every `step` of a pixel along the trace.

    `through` is a PSF of many wavelengths; the light within a step is at its mean position. The added images have
    `side` pixels per side.
    """
    (ny, nx), waves, electrons = shape, order.wavelength, spectrum * order.response
    x, y = order.trace.offsets(float(source.column[0]), float(source.row[0]), waves)
    # The planes are cut to the size of the images.
    whole, wide = (n * through.planes.samples // 2 for n in (through.side, side))
    middle = np.s_[whole - wide : whole + wide + 1]
    planes = np.array(
        [transfer.image_of(through.planes, part)[middle, middle] for part in weights_at(through, source, shape)]
    )
    blocks, known = np.floor(waves / BLOCK), None
    image = galsim.ImageD(galsim.BoundsI(-side, nx - 1 + side, -side, ny - 1 + side), scale=1.0, init_value=0.0)
    for part in np.split(np.arange(len(waves)), np.flatnonzero(np.diff(np.floor(x / step))) + 1):
        if not electrons[part].any():
            continue
        at_x, at_y = (float(np.average(of[part], weights=electrons[part])) for of in (x, y))
        if blocks[part[0]] != known:
            known = blocks[part[0]]
            middle = np.clip((known + 0.5) * BLOCK, waves[0], waves[-1])
            share = images.shares(np.array([middle]), through.planes.wavelength)[0]
            whole = _through(source, np.tensordot(share, planes, 1), through.planes.samples)
        at = galsim.PositionD(source.column[0] + at_x, source.row[0] + at_y)
        left, low = (int(np.floor(place)) - side // 2 + 1 for place in (at.x, at.y))
        box = galsim.BoundsI(left, left + side - 1, low, low + side - 1) & image.bounds
        if box.isDefined():
            light = whole * float(electrons[part].sum())
            light.drawImage(image[box], center=at, method="no_pixel", add_to_image=True)
    return np.asarray(image[galsim.BoundsI(0, nx - 1, 0, ny - 1)].array)


def _through(source, plane, samples):
    """Return a single source of unit flux through a plane of a PSF and a pixel, by galsim in units of pixels."""
    parts = [model.galsim_profile(plane, 1.0 / samples, exact=True), galsim.Pixel(1.0)]
    if source.shape[0] >= 0:
        body = galaxy_shapes.profile(source.shapes, int(source.shape[0]), 1e-6)
        parts.append(galsim.JacobianWCS(*source.jacobian[0].ravel()).toImage(body))
    return galsim.Convolve(parts, gsparams=TIGHT)


def placed(source, column, row):
    """Return a single source at another position, with one unit of its spectrum."""
    moved = source.take(np.array([0]))
    return replace(moved, column=np.array([column]), row=np.array([row]), electrons=np.ones(1))
