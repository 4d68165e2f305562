"""Point-spread functions: the Euclid optics from their pupil, and a seeing disc for ground cameras.

Frame: a PSF is held in the *detector's own axes* (x along columns, y along rows), in arcsec, without the
       pixel, centred on
the chief ray (coma moves the centroid by a few mas).  One PSF serves a whole detector.

vis_psf, ground_psf   -> Psf
pupil, wavefront      the parts of the Euclid model
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import galsim
import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.ndimage import uniform_filter

from jobs import cache
from jobs.fluxes.passbands import Passband
from jobs.render.focal_plane import Detector, detectors
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import read_table

Float = npt.NDArray[np.float64]

# Monochromatic planes of equal photon number for flat f_nu; eight reproduce second moments to 2e-4.
_PLANES = 8
# Samples a pixel: the finest optical detail (lambda / D at 540 nm) is 2.8 samples wide.
_OVERSAMPLING = 3
# Side of the plane, pixels, and of the largest stamp of a point; what lies outside (VIS: 0.2 %) is lost.
SIDE = 512
# Side of the optical transform, samples; the 0.15 % of the light beyond its border is absent.
_TRANSFORM = 2048
# Side and samples a pixel of the drawing that tells the width.
_CORE, _FINE = 243, 9
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class Psf:
    """A point-spread function with what the choice of a stamp's size needs.

    profile     : galsim object, arcsec, detector axes, without the pixel; its flux is what the model keeps of
                  1
    pixel_scale : arcsec
    surface     : float64[SIDE / 2] fraction of the flux in a pixel at a distance of r pixels (azimuthal mean)
    outside     : float64[SIDE / 2] fraction of the flux beyond r pixels
    fwhm        : arcsec, pixel included
    """

    profile: galsim.GSObject
    pixel_scale: float
    surface: Float
    outside: Float
    fwhm: float


def vis_psf(detector: Detector, band: Passband, mission: MissionConfiguration) -> Psf:
    """The Euclid PSF at a VIS detector's centre, for flat f_nu: optics, pointing jitter, charge diffusion.

    Error : second moments 2e-4 from the number of planes; one position a detector (ellipticity varies by
            ~0.01 across it)
    Ref   : pupil, Liaudat et al. 2023; wavefront and diffusion, the mission database
    """
    plane = _vis_plane(detector, band, mission)
    image = galsim.Image(plane.astype(float), scale=detector.pixel_scale / _OVERSAMPLING)
    # A plane that is empty at its border needs little padding; its extent in real and Fourier space is known.
    focal = galsim.InterpolatedImage(
        image,
        pad_factor=2.0,
        flux=float(plane.sum(dtype=float)),
        _force_stepk=2 * np.pi / (len(plane) * image.scale),
        _force_maxk=np.pi / image.scale,
    )
    return _tabulated(focal.rotate(-detector.rotation * galsim.degrees), detector.pixel_scale)


def ground_psf(seeing: float, beta: float, pixel_scale: float) -> Psf:
    """A round Moffat profile.

    seeing : FWHM, arcsec;  beta : exponent, > 1;  pixel_scale : arcsec
    """
    return _tabulated(galsim.Moffat(beta=beta, fwhm=seeing), pixel_scale)


def _tabulated(profile: galsim.GSObject, pixel_scale: float) -> Psf:
    """With azimuthal means of the profile sampled on pixels."""
    image = profile.drawImage(nx=SIDE + 1, ny=SIDE + 1, scale=pixel_scale, method="no_pixel", dtype=float).array
    grid = np.arange(SIDE + 1) - SIDE // 2
    ring = np.rint(np.hypot(*np.meshgrid(grid, grid))).astype(int)
    inside = ring < SIDE // 2
    total = np.bincount(ring[inside], image[inside])
    surface = np.maximum(total / np.bincount(ring[inside]), 0.0)
    outside = np.maximum(profile.flux - np.cumsum(total), 0.0)
    core = profile.drawImage(nx=_CORE, ny=_CORE, scale=pixel_scale / _FINE, method="no_pixel", dtype=float)
    with_pixel = galsim.Image(uniform_filter(core.array, _FINE), scale=pixel_scale / _FINE)
    return Psf(profile, pixel_scale, surface, outside, float(with_pixel.calculateFWHM()))


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
    terms = read_table("vis_wavefront")
    nm = np.zeros(1 + int(max(term[0] for term in terms)))
    for noll, x_power, y_power, coefficient in terms:
        nm[int(noll)] += coefficient * x**x_power * y**y_power
    return nm * mission.value("vis.psf.wavefront_scale")


def _vis_plane(detector: Detector, band: Passband, mission: MissionConfiguration) -> npt.NDArray[np.float32]:
    """Focal-plane axes, _OVERSAMPLING samples a pixel, odd side, float32."""
    everything = detectors("vis", mission)
    reach_x, reach_y = (max(abs(getattr(d, axis)) for d in everything) for axis in ("x", "y"))
    # The model's field coordinates run over the outer edges of the focal plane.
    field_x = detector.x / (reach_x + detector.nx * detector.pixel_scale / 2)
    field_y = detector.y / (reach_y + detector.ny * detector.pixel_scale / 2)
    sampling = detector.pixel_scale / _OVERSAMPLING
    blur = _blur_variances(detector, mission)
    optics = [p for p in mission.parameters if p.key.startswith("plm.")]
    nm = wavefront(field_x, field_y, mission)
    key = cache.content_key(
        Path(__file__).read_bytes(),
        nm,
        band.wavelength,
        band.response,
        repr([(p.key, p.value, p.unit) for p in optics]),
        repr((sampling, *blur)),
    )
    arrays = cache.cached_arrays(
        "vis_psf",
        key,
        lambda: {"plane": _polychromatic(nm, band, sampling, blur, mission).astype(np.float32)},
    )
    return arrays["plane"]


def _blur_variances(detector: Detector, mission: MissionConfiguration) -> tuple[float, float]:
    """Variance along x and y, arcsec2: pointing jitter and charge diffusion."""
    diffusion = mission.value("vis.diffusion_sigma", "pix") * detector.pixel_scale
    jitter_x, jitter_y = (mission.value(f"svm.aocs.jitter_{axis}", "arcsec") for axis in ("x", "y"))
    return jitter_x**2 + diffusion**2, jitter_y**2 + diffusion**2


def _polychromatic(
    nm: Float, band: Passband, sampling: float, blur: tuple[float, float], mission: MissionConfiguration
) -> Float:
    total = np.zeros((_TRANSFORM, _TRANSFORM))
    for wavelength in _equal_photon_wavelengths(band):
        total += _monochromatic(nm, wavelength, sampling, mission) / _PLANES
    total /= _edge_loss()
    k = 2 * np.pi * scipy.fft.fftfreq(_TRANSFORM, sampling)
    transfer = np.exp(-0.5 * blur[1] * k[:, None] ** 2) * np.exp(-0.5 * blur[0] * k[None, : _TRANSFORM // 2 + 1] ** 2)
    total = scipy.fft.irfft2(scipy.fft.rfft2(total) * transfer, s=total.shape)
    total = scipy.fft.fftshift(total)
    half = SIDE * _OVERSAMPLING // 2
    kept = slice(_TRANSFORM // 2 - half, _TRANSFORM // 2 + half + 1)
    return np.asarray(total[kept, kept])


def _equal_photon_wavelengths(band: Passband) -> list[float]:
    """Mean wavelengths, A, of _PLANES parts of the band that give equal photon numbers for flat f_nu."""
    photons = band.response / band.wavelength
    rank = (np.cumsum(photons) - 0.5 * photons) / photons.sum()
    part = np.minimum((rank * _PLANES).astype(int), _PLANES - 1)
    return [float(np.average(band.wavelength[part == i], weights=photons[part == i])) for i in range(_PLANES)]


def _monochromatic(nm: Float, wavelength: float, sampling: float, mission: MissionConfiguration) -> Float:
    """|FFT of the pupil|^2, centred on [0, 0], of unit flux over the whole sky.

    The pupil's sampling follows the wavelength, so that the image's does not; its edges are one sample wide.
    """
    step = wavelength * 1e-7 / (_TRANSFORM * sampling * _ARCSEC)
    radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
    n = 2 * (int(np.ceil(radius / step)) + 1)
    axis = (np.arange(n) - n // 2) * step
    x, y = np.meshgrid(axis, axis)
    transmission = pupil(x, y, step, mission)
    lit = transmission > 0
    phase = np.zeros_like(x)
    zernike = galsim.zernike.Zernike(nm, R_outer=radius)
    phase[lit] = 2 * np.pi * zernike(x[lit], y[lit]) / (wavelength / 10.0)
    field = np.zeros((_TRANSFORM, _TRANSFORM), complex)
    field[:n, :n] = transmission * np.exp(1j * phase)
    amplitude = scipy.fft.ifft2(field, overwrite_x=True)
    return np.asarray((amplitude.real**2 + amplitude.imag**2) * (_TRANSFORM**2 / transmission.sum()))


def _edge_loss() -> Float:
    """What the soft edges of `pupil` leave of the diffracted light, by angle: sinc^2(angle / side)."""
    angle = scipy.fft.fftfreq(_TRANSFORM)
    return np.asarray(np.sinc(np.hypot(angle[:, None], angle)) ** 2)
