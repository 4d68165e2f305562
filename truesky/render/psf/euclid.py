"""PSF of Euclid's cameras: optics from their pupil, jitter and charge diffusion.

A PSF is stored in the axes of the detector (x along columns, y along rows), without the pixel. For VIS it is centred on
the chief ray (coma moves the centroid by a few mas), and for NISP on its centroid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import uniform_filter

from lake_schema.arrays import Array, Float, Float32
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes.passbands import Passband
from truesky.numerics import cache, matrices
from truesky.numerics.code_fingerprints import code_key
from truesky.numerics.compiling import jit
from truesky.render.camera.detectors import Detector, detectors
from truesky.render.psf import model, spikes
from truesky.render.psf.diffraction import diffraction_image, optics_of
from truesky.render.psf.model import DETAIL, SAMPLES, SIDE, Planes, Psf
from truesky.render.psf.spikes import Edges
from truesky.render.psf.sub_bands import sub_bands


@dataclass(frozen=True, slots=True)
class Sampling:
    """Sampling of the PSF of a camera.

    Attributes
    ----------
    samples : int
        Samples per pixel.
    side : int
        Side of the planes, pixels.
    transform : int
        Side of the optical transform, samples. Light outside it is missing (0.15 % for VIS).
    core_transform, core_side : int
        Side of the transform (samples) and of the planes (pixels) for the drift across a detector, which needs only the
        core.
    window : float
        Rms of the Gaussian window in which the centroid of the light lies at the source's position, arcsec. With 0, the
        chief ray lies there.
    """

    samples: int
    side: int
    transform: int
    core_transform: int
    core_side: int
    window: float = 0.0


VIS = Sampling(SAMPLES, SIDE, 2048, 768, 160)
# In Y the optics reach 1.84 cycles per pixel, or 0.37 cycles per sample. Coma would move centroids tens of mas from the
# chief ray, but astrometry is calibrated with centroids. The window is SourceExtractor's for the light in a pixel.
NISP = Sampling(5, 256, 2048, 768, 96, window=0.2)
# Degrees of the polynomials in position, by the number of positions: for the drift of the mean PSF, and for that of its
# slope with wavelength.
DEGREES = {1: (0, 0), 4: (1, 0), 9: (2, 1), 25: (4, 2)}
# Noll number of defocus. All wavefronts have this coefficient.
_DEFOCUS = 4
# Half side of the region for a window, in units of its rms.
_WINDOWS = 5.0


def vis_psf(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """PSF of a VIS detector: optics, pointing jitter, charge diffusion.

    Parameters
    ----------
    detector : Detector
        A detector of VIS.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.
    positions : int
        Number of positions on the detector at which the PSF is computed, one of DEGREES; polynomials interpolate.

    Returns
    -------
    Psf
        The PSF.

    Notes
    -----
    The number of wavelengths causes errors of 2e-4 of the second moments. Errors across the detector are measured in
    psf_positions.csv.

    References
    ----------
    Liaudat et al. 2023 (pupil); the mission database (wavefront and diffusion).
    """
    return _psf(VIS, detector, band, mission, positions)


def nisp_psf(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """PSF of a NISP detector: optics, and pointing jitter together with all other blur.

    Parameters
    ----------
    detector : Detector
        A detector of NISP.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.
    positions : int
        Number of positions on the detector at which the PSF is computed, one of DEGREES; polynomials interpolate.

    Returns
    -------
    Psf
        The PSF.

    Notes
    -----
    The number of wavelengths causes errors of 4e-4 of the second moments. Errors across the detector are measured in
    psf_positions_nisp.csv.

    References
    ----------
    Liaudat et al. 2023 (pupil); the mission database (wavefront).
    """
    return _psf(NISP, detector, band, mission, positions)


def nisp_psf_at(detector: Detector, waves: Float, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """PSF of a NISP detector at given wavelengths, without the light beyond its planes.

    Parameters
    ----------
    detector : Detector
        A detector of NISP.
    waves : float array, shape (w,)
        Wavelengths, Angstrom.
    mission : MissionConfiguration
        Mission database.
    positions : int
        Number of positions on the detector at which the PSF is computed, one of DEGREES; polynomials interpolate.

    Returns
    -------
    Psf
        The PSF.
    """
    planes = _planes(NISP, detector, waves, mission, positions)
    return model.from_planes(planes, detector.pixel_scale, has_pixel=False, side=NISP.side)


def vis_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """Pupil edges for the light beyond the planes of the VIS PSF.

    Parameters
    ----------
    detector : Detector
        A detector of VIS.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Edges
        The edges.
    """
    return _edges(VIS, detector, band, mission)


def nisp_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """Pupil edges for the light beyond the planes of the NISP PSF.

    Parameters
    ----------
    detector : Detector
        A detector of NISP.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Edges
        The edges.
    """
    return _edges(NISP, detector, band, mission)


def _psf(sampling: Sampling, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Psf:
    # The second moments of diffraction are proportional to the square of the wavelength.
    parts = sub_bands(band)
    waves = np.array([np.sqrt(np.average(p.wavelength**2, weights=p.response / p.wavelength)) for p in parts])
    planes = _planes(sampling, detector, waves, mission, positions)
    psf = model.from_planes(planes, detector.pixel_scale, has_pixel=False, side=sampling.side)
    return replace(psf, edges=_edges(sampling, detector, band, mission))


def _edges(sampling: Sampling, detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    parts = sub_bands(band)
    waves = np.concatenate([part.wavelength for part in parts])
    blur = float(np.sqrt(np.mean(_blur_variances(detector, float(waves.mean()), mission))))
    return spikes.from_euclid_pupil(parts, blur, detector.pixel_scale, sampling.transform / sampling.samples, mission)


# ------------------------------------------------------------------------------------------------ the optics


def wavefront(x: float, y: float, section: str, mission: MissionConfiguration) -> Float:
    """Zernike coefficients of the wavefront at a field position.

    Parameters
    ----------
    x, y : float
        Position in the focal plane, -1 to 1.
    section : str
        Prefix of the camera in the mission database.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array
        Coefficients, nm rms; the index is the Noll number.
    """
    terms = mission.numbers(f"{section}.psf.wavefront")
    nm = np.zeros(1 + int(max(term[0] for term in terms)))
    for noll, x_power, y_power, coefficient in terms:
        nm[int(noll)] += coefficient * x**x_power * y**y_power
    nm *= mission.value(f"{section}.psf.wavefront_scale")
    if (key := f"{section}.psf.defocus") in mission:
        nm[_DEFOCUS] += mission.value(key, "nm")
    return nm


def _planes(
    camera_sampling: Sampling, detector: Detector, waves: Float, mission: MissionConfiguration, positions: int
) -> Planes:
    """Planes of the PSF at the wavelengths `waves` [w], Angstrom."""
    section = detector.section
    nodes, powers = _nodes(positions), _powers(positions)
    places = [_field_position(detector, *place, mission) for place in ((0.0, 0.0), *nodes)]
    sampling = detector.pixel_scale / camera_sampling.samples
    wavefronts = np.array([wavefront(*place, section, mission) for place in places])
    blurs = [_blur_variances(detector, float(wavelength), mission) for wavelength in waves]
    optics = [p for p in mission.parameters if p.key.startswith("plm.")]
    key = cache.content_key(
        code_key(__name__),
        wavefronts,
        waves,
        repr([(p.key, p.value, p.unit) for p in optics]),
        repr((camera_sampling, sampling, *blurs)),
    )

    def make() -> dict[str, Array]:
        coefficients = [centre_wavefront(nm, waves, camera_sampling, sampling, mission) for nm in wavefronts]
        centre = [
            _plane(coefficients[0], w, camera_sampling, sampling, blur, mission)
            for w, blur in zip(waves, blurs, strict=True)
        ]
        # The drift is only one per cent of the light, so the mean blur is accurate enough.
        blur = tuple(np.mean(blurs, axis=0).tolist())
        return {
            "images": np.stack(centre).astype(np.float32),
            "drift": _drift(coefficients, positions, waves, camera_sampling, sampling, blur, mission).astype(
                np.float32
            ),
        }

    arrays = cache.cached_arrays(f"{section}_psf", key, make)
    axis_order = slice(None, None, -1 if detector.upside_down else 1)
    # If the detector is upside down, both the planes and the coordinates of the drift are inverted.
    sign = np.array([(-1) ** (i + j) for i, j, _ in powers], np.float32)[:, None, None]
    drift = arrays["drift"][:, axis_order, axis_order] * (sign if detector.upside_down else np.float32(1.0))
    half = ((detector.nx - 1) / 2, (detector.ny - 1) / 2)
    return Planes(waves, arrays["images"][:, axis_order, axis_order], drift, half, powers, camera_sampling.samples)


def _field_position(detector: Detector, x: float, y: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Field coordinates, -1 to 1 between the focal plane's outer edges, of a position in half sides from the centre."""
    all_detectors = detectors(detector.section, mission)
    half_x, half_y = (n * detector.pixel_scale / 2 for n in (detector.nx, detector.ny))
    reach_x, reach_y = (max(abs(getattr(d, axis)) for d in all_detectors) for axis in ("x", "y"))
    first_detector = all_detectors[0]
    reach_x, reach_y = (
        reach_x + first_detector.nx * first_detector.pixel_scale / 2,
        reach_y + first_detector.ny * first_detector.pixel_scale / 2,
    )
    return (detector.x + x * half_x) / reach_x, (detector.y + y * half_y) / reach_y


def _blur_variances(detector: Detector, wavelength: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Variance of pointing jitter and charge diffusion along x and y, arcsec^2, at a wavelength in Angstrom.

    Charge diffuses farther for blue light and in thicker detectors. There is no separate diffusion if the mission
    database contains one width for the whole blur of the optics.
    """
    section = detector.section
    if f"{section}.psf.jitter" in mission:
        jitter = mission.value(f"{section}.psf.jitter", "arcsec")
        return jitter**2, jitter**2
    redder = 0.1 * wavelength / mission.value(f"{section}.diffusion_wavelength", "nm")
    wider = redder ** mission.value(f"{section}.diffusion_slope") * _thickness(detector, mission)
    diffusion = wider * mission.value(f"{section}.diffusion_sigma", "pix") * detector.pixel_scale
    jitter_x, jitter_y = (mission.value(f"svm.aocs.jitter_{axis}", "arcsec") for axis in ("x", "y"))
    return jitter_x**2 + diffusion**2, jitter_y**2 + diffusion**2


def _thickness(detector: Detector, mission: MissionConfiguration) -> float:
    """Diffusion length of a detector, divided by that of the mission."""
    key = f"{detector.section}.diffusion_detectors"
    if key not in mission:
        return 1.0
    thicker = {row["detector"]: float(row["diffusion"]) for row in mission.rows(key)}
    return max(1.0 + mission.value(f"{detector.section}.diffusion_spread", "") * thicker.get(detector.name, 0.0), 0.0)


def _nodes(positions: int) -> tuple[tuple[float, float], ...]:
    """Positions at which the PSF is computed across a detector, in half sides from its centre."""
    axis = np.linspace(-1.0, 1.0, math.isqrt(positions)).tolist() if positions > 1 else []
    return tuple((x, y) for y in axis for x in axis)


def _powers(positions: int) -> tuple[tuple[int, int, int], ...]:
    """Powers of the drift (`Planes.powers`): first for the mean PSF, then for its slope with wavelength."""
    return tuple(
        (degree - j, j, colour)
        for colour, max_degree in enumerate(DEGREES[positions])
        for degree in range(1, max_degree + 1)
        for j in range(degree + 1)
    )


def _drift(
    coefficients: Sequence[Float],
    positions: int,
    waves: Float,
    camera_sampling: Sampling,
    sampling: float,
    blur: tuple[float, float],
    mission: MissionConfiguration,
) -> Float:
    """Planes of the drift (`Planes.drift`) in the focal plane's axes, by least squares.

    The coefficients are the wavefronts of the centre and of the nodes.
    """
    powers, weights = _powers(positions), _blur_weights(blur, sampling)
    side = camera_sampling.core_side * camera_sampling.samples + 1
    if not powers:
        return np.zeros((0, side, side))
    side += 2 * _margin(weights)
    mean, slope = np.zeros((2, len(coefficients), side, side))
    redder = (waves - waves.mean()) / np.sum((waves - waves.mean()) ** 2)
    for wavelength, tilt in zip(waves, redder, strict=True):
        optics = optics_of(float(wavelength), sampling, mission, camera_sampling.core_transform)
        for i, nm in enumerate(coefficients):
            image = diffraction_image(nm, optics, side)
            mean[i] += image / len(waves)
            slope[i] += image * tilt
    x, y = np.array(_nodes(positions)).T
    changes = []
    for order, images in enumerate((mean, slope)):
        terms = [x**i * y**j for i, j, colour in powers if colour == order]
        if terms:
            from_nodes = matrices.least_squares(np.stack(terms, axis=1), np.eye(len(x)))
            change = matrices.matmul(from_nodes, (images[1:] - images[0]).reshape(len(x), -1)).reshape(-1, side, side)
            # The blur is linear and the same for all images.
            changes += [_blur_image(image, weights) for image in change]
    return np.stack(changes)


def centre_wavefront(
    nm: Float, waves: Float, camera_sampling: Sampling, sampling: float, mission: MissionConfiguration
) -> Float:
    """Add the tilt that moves the windowed centroid of the light, within a pixel, to the middle sample.

    Parameters
    ----------
    nm : float array
        Wavefront by Noll number, nm.
    waves : float array, shape (w,)
        Wavelengths, Angstrom.
    camera_sampling : Sampling
        Sampling for the camera. Without a window, the wavefront is returned unchanged.
    sampling : float
        Sampling of the image, arcsec.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array
        Wavefront by Noll number, nm, with an error of the centroid of 0.1 mas.
    """
    if not camera_sampling.window:
        return nm
    # Two wavelengths are sufficient for the mean over a band.
    off = 0.58 * 0.5 * (waves.max() - waves.min())
    optics = [
        optics_of(float(waves.mean() + part), sampling, mission, camera_sampling.core_transform) for part in (-off, off)
    ]
    side = 2 * round(_WINDOWS * camera_sampling.window / sampling) + 1
    axis = sampling * (np.arange(side) - side // 2)
    window = np.exp(-0.5 * (axis / camera_sampling.window) ** 2)

    def centroid(coefficients: Float) -> Float:
        light = np.sum(
            [diffraction_image(coefficients, pupil_optics, side) for pupil_optics in optics], axis=0, dtype=float
        )
        weighted = uniform_filter(light, camera_sampling.samples, mode="nearest") * window * window[:, None]
        return np.asarray(np.array([(weighted * axis).sum(), (weighted * axis[:, None]).sum()]) / weighted.sum())

    tilted_nm, step = nm.copy(), 10.0
    position = centroid(tilted_nm)
    tilted_nm[2:4] += step
    previous, position = position, centroid(tilted_nm)
    response = (position - previous) / step
    for _ in range(3):
        tilted_nm[2:4] -= position / response
        position = centroid(tilted_nm)
    return tilted_nm


def _plane(
    nm: Float, wavelength: float, camera_sampling: Sampling, sampling: float, blur: tuple[float, float],
    mission: MissionConfiguration,
) -> Float32:  # fmt: skip
    """PSF at one wavelength in the focal plane's axes, a square of side * samples + 1."""
    weights = _blur_weights(blur, sampling)
    optics = optics_of(wavelength, sampling, mission, camera_sampling.transform)
    return _blur_image(
        diffraction_image(nm, optics, camera_sampling.side * camera_sampling.samples + 1 + 2 * _margin(weights)),
        weights,
    )


def _blur_image(image: Array, weights: tuple[Float, Float]) -> Float32:
    """Blur diffracted light by weights along x and y, and cut the margin.

    The convolution is done on the image, since rounding errors of a transform of the bright core would hide the wings.
    """
    across, along = (w.astype(np.float32) for w in weights)
    return _convolve_separable(image.astype(np.float32), across, along, len(image) - 2 * _margin(weights))


@jit
def _convolve_separable(image: Float32, across: Float32, along: Float32, side: int) -> Float32:
    """Convolve an image with weights along columns (`across`) and rows (`along`); return the middle [side, side]."""
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
            weight, segment = across[j], line[margin + j - reach_x : margin + j - reach_x + side]
            for c in range(side):
                out[r, c] += weight * segment[c]
    return out


def _margin(weights: tuple[Float, Float]) -> int:
    return max(len(w) // 2 for w in weights)


def _blur_weights(blur: tuple[float, float], sampling: float) -> tuple[Float, Float]:
    across, along = (_gaussian_weights(float(np.sqrt(variance)) / sampling) for variance in blur)
    return across, along


@lru_cache(maxsize=64)
def _gaussian_weights(sigma: float) -> Float:
    """Weights of a Gaussian of `sigma` samples, for images without detail finer than DETAIL; their sum is 1.

    The number of weights is odd. The error of the transfer function is 1e-7.
    """
    k = np.linspace(0.0, 2 * np.pi * DETAIL, 400)
    lost, half = 1.0 - np.exp(-0.5 * (sigma * k) ** 2), 0
    while True:
        half += 1
        basis = 1.0 - np.cos(k[:, None] * np.arange(1, half + 1))
        outer = matrices.least_squares(basis, lost)
        if np.abs(matrices.matmul(basis, outer) - lost).max() < 1e-7:
            return np.concatenate([outer[::-1] / 2, [1.0 - outer.sum()], outer / 2])
