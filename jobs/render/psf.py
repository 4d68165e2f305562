"""Point-spread functions: the Euclid optics from their pupil, and a seeing disc for ground cameras.

Frame: a PSF is held in the *detector's own axes* (x along columns, y along rows), without the pixel, centred on the
chief ray (coma moves the centroid by a few mas).

vis_psf, ground_psf   -> Psf;  sampled : the same of any planes
spectrum_of           the Fourier transform of a PSF without planes
pupil, wavefront      the parts of the Euclid model
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import galsim
import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.ndimage import maximum, uniform_filter

from jobs import cache, sums
from jobs.compiling import jit
from jobs.fluxes.passbands import Passband
from jobs.render import edges
from jobs.render.chromatic import sub_bands
from jobs.render.edges import Edges
from jobs.render.focal_plane import Detector, detectors
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]
Array = npt.NDArray[Any]

# Samples a pixel: the finest optical detail (lambda / D at 540 nm) is 2.8 samples wide; cycles a sample that are more.
SAMPLES, _DETAIL = 3, 0.4
# Side of the plane, pixels, and of the largest stamp of a point; what lies outside (VIS: 0.2 %) is drawn for bright
# stars alone (edges.py).
SIDE = 512
# Side of the optical transform, samples; the 0.15 % of the light beyond its border is absent.
_TRANSFORM = 2048
# The same for what changes across a detector: the core alone.
_CORE_TRANSFORM, _CORE_SIDE = 768, 160
# Of the drift, by the number of positions: degree in place of the mean PSF, and of its slope with wavelength.
DEGREES = {1: (0, 0), 4: (1, 0), 9: (2, 1), 25: (4, 2)}
# Side and samples a pixel of the drawing that tells the width.
_CORE, _FINE = 243, 9
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class Planes:
    """A PSF by wavelength and place, in samples of 1 / SAMPLES pixel, centred on the middle sample.

    PSF(source) = sum_w photons_w images_w + sum_j x^a_j y^b_j redder^c_j drift_j, (a, b, c) = powers, redder the mean
    wavelength of its photons above that of the planes, A.

    wavelength : float64[w] A;  images : float32[w, s, s] of unit flux over the whole sky, at the detector's centre
    drift      : float32[d, t, t]; d = 0 for one PSF a detector
    powers     : [d] of x, y and redder
    half       : (columns, rows) half the detector: the unit of x and y
    """

    wavelength: Float
    images: Float32
    drift: Float32
    half: tuple[float, float]
    powers: tuple[tuple[int, int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Psf:
    """A point-spread function with what the choice of a stamp's size needs.

    profile     : galsim object, arcsec, detector axes, without the pixel, for flat f_nu at the detector's centre; its
                  flux is what the model keeps of 1
    pixel_scale : arcsec
    surface     : float64[SIDE / 2] fraction of the flux in a pixel at a distance of r pixels (azimuthal mean)
    rim         : float64[SIDE / 2] the largest fraction in a pixel at r pixels or more along columns or rows: spikes of
                  the pupil's bars rise above the mean
    outside     : float64[SIDE / 2] fraction of the flux beyond r pixels
    fwhm        : arcsec, pixel included
    planes      : by wavelength and place; None where `profile` is all
    intra_pixel : how much less a pixel's edges see than its centre (effects/intra_pixel), 0 = nothing; None: the PSF
                  has the pixel in it already
    edges       : what shines beyond the planes; None: nothing does
    """

    profile: galsim.GSObject
    pixel_scale: float
    surface: Float
    rim: Float
    outside: Float
    fwhm: float
    planes: Planes | None = None
    intra_pixel: float | None = 0.0
    edges: Edges | None = None


def vis_psf(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """The Euclid PSF of a VIS detector: optics, pointing jitter, charge diffusion.

    positions : where it is computed, one of DEGREES; polynomials lie between
    Error     : second moments 2e-4 from the number of wavelengths; across the detector as measured (psf_positions.csv)
    Ref       : pupil, Liaudat et al. 2023; wavefront and diffusion, the mission database
    """
    found = sampled(_vis_planes(detector, band, mission, positions), detector.pixel_scale, has_pixel=False)
    return replace(found, edges=vis_edges(detector, band, mission))


def of_colours(spread: Psf, colours: int) -> Psf:
    """The same PSF of so many wavelengths at most: each the mean of neighbours, which are of as many photons."""
    planes = spread.planes
    if planes is None or len(planes.wavelength) <= colours:
        return spread
    if len(planes.wavelength) % colours:
        raise BadInput(f"{len(planes.wavelength)} wavelengths of a PSF are not a multiple of {colours}")
    wavelength = planes.wavelength.reshape(colours, -1).mean(axis=1)
    images = planes.images.reshape(colours, -1, *planes.images.shape[1:]).mean(axis=1)
    return replace(spread, planes=replace(planes, wavelength=wavelength, images=images))


def vis_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """What shines beyond the planes of the Euclid PSF."""
    parts = sub_bands(band)
    waves = np.concatenate([part.wavelength for part in parts])
    blur = float(np.sqrt(np.mean(_blur_variances(detector, float(waves.mean()), mission))))
    return edges.of_pupil(parts, blur, detector.pixel_scale, _TRANSFORM / SAMPLES, mission)


def galsim_profile(image: Array, pixel_scale: float, exact: bool = False) -> galsim.GSObject:
    """A plane as a galsim object, arcsec.

    exact : for the reference, between samples all but their Fourier series: what galsim's quintic makes of them is
            1e-4 wrong in the middle of steep bulges
    """
    sampled = galsim.Image(np.asarray(image, float), scale=pixel_scale / SAMPLES)
    # A plane that is empty at its border needs little padding; its extent in real and Fourier space is known.
    return galsim.InterpolatedImage(
        sampled,
        x_interpolant=galsim.Lanczos(31) if exact else None,
        pad_factor=2.0,
        flux=float(image.sum(dtype=float)),
        _force_stepk=2 * np.pi / (len(image) * sampled.scale),
        _force_maxk=np.pi / sampled.scale,
    )


def ground_psf(seeing: float, beta: float, pixel_scale: float) -> Psf:
    """A round Moffat profile.

    seeing : FWHM, arcsec;  beta : exponent, > 1;  pixel_scale : arcsec
    """
    # galsim ends it where 1e-5 of the light is left; of bright stars that is seen.
    far = galsim.GSParams(xvalue_accuracy=1e-12)
    return _tabulated(galsim.Moffat(beta=beta, fwhm=seeing, gsparams=far), pixel_scale)


def sampled(planes: Planes, pixel_scale: float, has_pixel: bool) -> Psf:
    """A PSF of planes; has_pixel : the detector's pixel is in them."""
    mean = planes.images.mean(axis=0, dtype=float)
    return _tabulated(galsim_profile(mean, pixel_scale), pixel_scale, planes, has_pixel)


def _tabulated(
    profile: galsim.GSObject, pixel_scale: float, planes: Planes | None = None, has_pixel: bool = False
) -> Psf:
    """With azimuthal means, and the largest values, of the profile sampled on pixels."""
    image = profile.drawImage(nx=SIDE + 1, ny=SIDE + 1, scale=pixel_scale, method="no_pixel", dtype=float).array
    grid = np.arange(SIDE + 1) - SIDE // 2
    ring = np.rint(np.hypot(*np.meshgrid(grid, grid))).astype(int)
    inside = ring < SIDE // 2
    total = np.bincount(ring[inside], image[inside])
    surface = np.maximum(total / np.bincount(ring[inside]), 0.0)
    square = np.maximum(*np.meshgrid(np.abs(grid), np.abs(grid)))
    around = np.asarray(maximum(image, square, np.arange(SIDE // 2)))
    rim = np.maximum(np.maximum.accumulate(around[::-1])[::-1], 0.0)
    outside = np.maximum(profile.flux - np.cumsum(total), 0.0)
    core = profile.drawImage(nx=_CORE, ny=_CORE, scale=pixel_scale / _FINE, method="no_pixel", dtype=float)
    with_pixel = core.array if has_pixel else uniform_filter(core.array, _FINE)
    # About the middle of the core: a user's PSF may lie off the source's place.
    bright = with_pixel > 0.5 * with_pixel.max()
    y, x = (float(at[bright].mean()) + 1.0 for at in np.indices(with_pixel.shape))
    fwhm = float(galsim.Image(with_pixel, scale=pixel_scale / _FINE).calculateFWHM(center=galsim.PositionD(x, y)))
    return Psf(profile, pixel_scale, surface, rim, outside, fwhm, planes, None if has_pixel else 0.0)


def spectrum_of(psf: Psf, size: int, reach: int) -> Array:
    """Fourier transform of `profile` on the grid of a stamp of `size` pixels, without the pixel.

    returns : complex[2 reach + 1, reach + 1], [iy, ix] at (ix, iy) times 2 pi / size radian / pixel
    """
    profile = psf.profile.dilate(1.0 / psf.pixel_scale)
    image = galsim.ImageCD(galsim.BoundsI(0, reach, -reach, reach), scale=2 * np.pi / size)
    # The half plane is all that a real image needs; galsim's public call draws both halves.
    profile._drawKImage(image)
    return np.asarray(np.roll(image.array, -reach, axis=0))


# ------------------------------------------------------------------------------------------------ the optics


def pupil(x: Float, y: Float, softness: float, mission: MissionConfiguration) -> Float:
    """Transmission of the entrance pupil: aperture stop, decentred central stop, three spider bars.

    x, y     : [...] mm;  softness : width of the edges, mm (one sample: an edge then covers its pixels by
               area)
    returns  : [...] 0 .. 1
    """
    radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
    stop, stop_y = mission.value("plm.pupil.stop_radius", "mm"), mission.value("plm.pupil.stop_y", "mm")
    clear = _step(radius - np.hypot(x, y), softness) * _step(np.hypot(x, y - stop_y) - stop, softness)
    width = mission.value("plm.pupil.spider_width", "mm")
    reach = mission.value("plm.pupil.spider_half_length", "mm")
    for bar in ("spider1", "spider2", "spider3"):
        bar_x, bar_y = mission.value(f"plm.pupil.{bar}.x", "mm"), mission.value(f"plm.pupil.{bar}.y", "mm")
        angle = mission.value(f"plm.pupil.{bar}.angle", "rad")
        # Normal form: no singular angle.
        across = np.abs(-np.sin(angle) * (x - bar_x) + np.cos(angle) * (y - bar_y))
        blocked = _step(width / 2 - across, softness) * _step(reach - np.hypot(x - bar_x, y - bar_y), softness)
        clear = clear * (1.0 - blocked)
    return np.asarray(clear)


def _step(depth: Float, softness: float) -> Float:
    return np.clip(0.5 + depth / softness, 0.0, 1.0)


def wavefront(x: float, y: float, mission: MissionConfiguration) -> Float:
    """Zernike coefficients at a field position: index = Noll number, nm rms.

    x, y : -1 .. 1 across the focal plane
    """
    terms = mission.numbers("vis.psf.wavefront")
    nm = np.zeros(1 + int(max(term[0] for term in terms)))
    for noll, x_power, y_power, coefficient in terms:
        nm[int(noll)] += coefficient * x**x_power * y**y_power
    return nm * mission.value("vis.psf.wavefront_scale")


def _vis_planes(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Planes:
    parts = sub_bands(band)
    # Second moments of diffraction go with the square of the wavelength.
    waves = np.array([np.sqrt(np.average(p.wavelength**2, weights=p.response / p.wavelength)) for p in parts])
    nodes, powers = _nodes(positions), _powers(positions)
    coefficients = [wavefront(*_field(detector, *place, mission), mission) for place in ((0.0, 0.0), *nodes)]
    sampling = detector.pixel_scale / SAMPLES
    blurs = [_blur_variances(detector, float(wavelength), mission) for wavelength in waves]
    optics = [p for p in mission.parameters if p.key.startswith("plm.")]
    key = cache.content_key(
        Path(__file__).read_bytes(),
        np.array(coefficients),
        waves,
        repr([(p.key, p.value, p.unit) for p in optics]),
        repr((sampling, *blurs)),
    )

    def make() -> dict[str, Array]:
        centre = [
            _plane(coefficients[0], w, _TRANSFORM, SIDE, sampling, blur, mission)
            for w, blur in zip(waves, blurs, strict=True)
        ]
        # Of the drift, a part in a hundred of the light, the mean's blur is blur enough.
        blur = tuple(np.mean(blurs, axis=0).tolist())
        return {
            "images": np.stack(centre).astype(np.float32),
            "drift": _drift(coefficients, positions, waves, sampling, blur, mission).astype(np.float32),
        }

    arrays = cache.cached_arrays("vis_psf", key, make)
    turned = slice(None, None, -1 if detector.upside_down else 1)
    # Upside down, both the planes and the places that the drift is written in are turned.
    sign = np.array([(-1) ** (i + j) for i, j, _ in powers], np.float32)[:, None, None]
    drift = arrays["drift"][:, turned, turned] * (sign if detector.upside_down else np.float32(1.0))
    half = ((detector.nx - 1) / 2, (detector.ny - 1) / 2)
    return Planes(waves, arrays["images"][:, turned, turned], drift, half, powers)


def _field(detector: Detector, x: float, y: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Field coordinates, -1 .. 1 over the focal plane's outer edges, of a place in half sides from the centre."""
    everything = detectors("vis", mission)
    half_x, half_y = (n * detector.pixel_scale / 2 for n in (detector.nx, detector.ny))
    reach_x, reach_y = (max(abs(getattr(d, axis)) for d in everything) for axis in ("x", "y"))
    whole = everything[0]
    reach_x, reach_y = reach_x + whole.nx * whole.pixel_scale / 2, reach_y + whole.ny * whole.pixel_scale / 2
    return (detector.x + x * half_x) / reach_x, (detector.y + y * half_y) / reach_y


def _blur_variances(detector: Detector, wavelength: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Variance along x and y, arcsec2: pointing jitter, and charge diffusion.

    Charge spreads wider of blue light (A), and the wider the thicker the detector is.
    """
    redder = 0.1 * wavelength / mission.value("vis.diffusion_wavelength", "nm")
    wider = redder ** mission.value("vis.diffusion_slope") * _thickness(detector, mission)
    diffusion = wider * mission.value("vis.diffusion_sigma", "pix") * detector.pixel_scale
    jitter_x, jitter_y = (mission.value(f"svm.aocs.jitter_{axis}", "arcsec") for axis in ("x", "y"))
    return jitter_x**2 + diffusion**2, jitter_y**2 + diffusion**2


def _thickness(detector: Detector, mission: MissionConfiguration) -> float:
    """A detector's diffusion length over the mission's."""
    if "vis.diffusion_detectors" not in mission:
        return 1.0
    thicker = {row["detector"]: float(row["diffusion"]) for row in mission.rows("vis.diffusion_detectors")}
    return max(1.0 + mission.value("vis.diffusion_spread", "") * thicker.get(detector.name, 0.0), 0.0)


def _nodes(positions: int) -> tuple[tuple[float, float], ...]:
    """Where the PSF is computed across a detector, in half sides from its centre."""
    axis = np.linspace(-1.0, 1.0, math.isqrt(positions)).tolist() if positions > 1 else []
    return tuple((x, y) for y in axis for x in axis)


def _powers(positions: int) -> tuple[tuple[int, int, int], ...]:
    """Planes.powers of the drift: of the mean PSF, then of its slope with wavelength."""
    return tuple(
        (degree - j, j, colour)
        for colour, most in enumerate(DEGREES[positions])
        for degree in range(1, most + 1)
        for j in range(degree + 1)
    )


def _drift(
    coefficients: Sequence[Float],
    positions: int,
    waves: Float,
    sampling: float,
    blur: tuple[float, float],
    mission: MissionConfiguration,
) -> Float:
    """Planes of Planes.drift in the focal plane's axes, by least squares; coefficients: of the centre and the nodes."""
    powers, weights = _powers(positions), _weights_of(blur, sampling)
    side = _CORE_SIDE * SAMPLES + 1
    if not powers:
        return np.zeros((0, side, side))
    side += 2 * _margin(weights)
    mean, slope = np.zeros((2, len(coefficients), side, side))
    redder = (waves - waves.mean()) / np.sum((waves - waves.mean()) ** 2)
    for wavelength, tilt in zip(waves, redder, strict=True):
        optics = _optics(float(wavelength), sampling, mission, _CORE_TRANSFORM)
        for i, nm in enumerate(coefficients):
            image = _diffracted(nm, optics, side)
            mean[i] += image / len(waves)
            slope[i] += image * tilt
    x, y = np.array(_nodes(positions)).T
    changes = []
    for order, images in enumerate((mean, slope)):
        terms = [x**i * y**j for i, j, colour in powers if colour == order]
        if terms:
            from_nodes = sums.least_squares(np.stack(terms, axis=1), np.eye(len(x)))
            change = sums.product(from_nodes, (images[1:] - images[0]).reshape(len(x), -1)).reshape(-1, side, side)
            # The blur is the same for all, and linear.
            changes += [_blurred(image, weights) for image in change]
    return np.stack(changes)


def _plane(
    nm: Float, wavelength: float, transform: int, side: int, sampling: float, blur: tuple[float, float],
    mission: MissionConfiguration,
) -> Float32:  # fmt: skip
    """One wavelength's PSF: [side * SAMPLES + 1] square, in the focal plane's axes."""
    weights = _weights_of(blur, sampling)
    optics = _optics(wavelength, sampling, mission, transform)
    return _blurred(_diffracted(nm, optics, side * SAMPLES + 1 + 2 * _margin(weights)), weights)


def _blurred(image: Array, weights: tuple[Float, Float]) -> Float32:
    """Diffracted light -> blurred by weights along x and y, without a margin.

    On the image: of a transform's rounding the bright core would cover the wings.
    """
    across, along = (w.astype(np.float32) for w in weights)
    return _summed(image.astype(np.float32), across, along, len(image) - 2 * _margin(weights))


@jit
def _summed(image: Float32, across: Float32, along: Float32, side: int) -> Float32:
    """The middle [side, side] of an image, summed with weights [odd] along columns (across) and rows (along)."""
    margin, reach_x, reach_y = (len(image) - side) // 2, len(across) // 2, len(along) // 2
    out = np.zeros((side, side), np.float32)
    line = np.empty(len(image), np.float32)
    for r in range(side):
        line[:] = 0.0
        for j in range(len(along)):
            weight, row = along[j], image[r + margin + j - reach_y]
            for c in range(len(row)):
                line[c] += weight * row[c]
        for j in range(len(across)):
            weight, some = across[j], line[margin + j - reach_x : margin + j - reach_x + side]
            for c in range(side):
                out[r, c] += weight * some[c]
    return out


def _margin(weights: tuple[Float, Float]) -> int:
    return max(len(w) // 2 for w in weights)


def _weights_of(blur: tuple[float, float], sampling: float) -> tuple[Float, Float]:
    across, along = (_weights(float(np.sqrt(variance)) / sampling) for variance in blur)
    return across, along


@lru_cache(maxsize=64)
def _weights(sigma: float) -> Float:
    """float64[odd]: a Gaussian of sigma samples, for images without detail finer than _DETAIL; their sum is 1.

    Error : of the transfer function, 1e-7
    """
    k = np.linspace(0.0, 2 * np.pi * _DETAIL, 400)
    lost, half = 1.0 - np.exp(-0.5 * (sigma * k) ** 2), 0
    while True:
        half += 1
        basis = 1.0 - np.cos(k[:, None] * np.arange(1, half + 1))
        outer = sums.least_squares(basis, lost)
        if np.abs(sums.product(basis, outer) - lost).max() < 1e-7:
            return np.concatenate([outer[::-1] / 2, [1.0 - outer.sum()], outer / 2])


@dataclass(frozen=True, slots=True)
class _Optics:
    """The pupil as light of a wavelength samples it.

    transmission : [n, n];  x, y : [lit samples] of its radius;  wavelength : A
    """

    transform: int
    transmission: Float
    x: Float
    y: Float
    wavelength: float


def _optics(wavelength: float, sampling: float, mission: MissionConfiguration, transform: int) -> _Optics:
    """The pupil's sampling follows the wavelength, so that the image's does not; its edges are one sample wide."""
    step = wavelength * 1e-7 / (transform * sampling * _ARCSEC)
    radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
    n = 2 * (int(np.ceil(radius / step)) + 1)
    axis = (np.arange(n) - n // 2) * step
    x, y = np.meshgrid(axis, axis)
    transmission = pupil(x, y, step, mission)
    lit = transmission > 0
    return _Optics(transform, transmission, x[lit] / radius, y[lit] / radius, wavelength)


def _diffracted(nm: Float, optics: _Optics, side: int | None = None) -> Float32:
    """|FFT of the pupil|^2 of unit flux over the whole sky, the soft edges' loss made good: [side, side].

    nm   : by Noll number;  side : samples about the middle, side // 2; None: the whole transform's
    Error : 5e-4 of what is in a sample, 5e-6 in the core: it is in single precision
    """
    transmission, transform = optics.transmission, optics.transform
    side = transform if side is None else side
    lit = transmission > 0
    phase = galsim.zernike.Zernike(nm * (2 * np.pi / (optics.wavelength / 10.0)))(optics.x, optics.y).astype(np.float32)
    field = np.zeros(transmission.shape, np.complex64)
    field.real[lit] = transmission[lit] * np.cos(phase)
    field.imag[lit] = transmission[lit] * np.sin(phase)
    middle = (np.arange(side) - side // 2) % transform
    # First along the rows that have light; then the columns that are wanted.
    lines = scipy.fft.ifft(field, transform, axis=1, overwrite_x=True)[:, middle]
    parts = scipy.fft.ifft(lines, transform, axis=0, overwrite_x=True)[middle].view(np.float32)
    parts *= parts
    power = parts[:, 0::2] + parts[:, 1::2]
    power *= _edge_gain(transform, side)
    power *= np.float32(transform**2 / transmission.sum())
    return np.asarray(power)


@lru_cache(maxsize=4)
def _edge_gain(transform: int, side: int) -> Float32:
    """One over what the soft edges of `pupil` leave of the diffracted light, by angle: sinc^2(angle / side)."""
    angle = (np.arange(side) - side // 2) / transform
    return np.asarray(np.sinc(np.hypot(angle[:, None], angle)) ** -2.0, np.float32)
