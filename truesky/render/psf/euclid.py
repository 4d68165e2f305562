"""The point-spread function of Euclid's cameras: the optics from their pupil, jitter and charge diffusion.

Frame: a PSF is held in the *detector's own axes* (x along columns, y along rows), without the pixel, centred on the
chief ray (coma moves the centroid by a few mas), that of NISP on its centroid.

vis_psf, nisp_psf     -> Psf;  vis_edges, nisp_edges : their diffraction far from a star
wavefront   of a field position;  centred : one whose light has its centroid at the source's place
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
    """How the PSF of a camera is computed.

    samples         : a pixel;  side : of its planes, pixels
    transform       : side of the optical transform, samples; the light beyond its border is absent (VIS: 0.15 %)
    core_transform, core_side : the same, samples and pixels, for what changes across a detector: the core alone
    window          : arcsec, rms of the Gaussian within which the centroid of the light lies at a source's place; 0 =
                      the chief ray lies there
    """

    samples: int
    side: int
    transform: int
    core_transform: int
    core_side: int
    window: float = 0.0


VIS = Sampling(SAMPLES, SIDE, 2048, 768, 160)
# The optics reach 1.84 cycles a pixel in Y: 0.37 a sample.
# Its coma would put centroids tens of mas from the chief ray, and astrometry is calibrated by centroids: the window is
# that of SourceExtractor for its light in a pixel.
NISP = Sampling(5, 256, 2048, 768, 96, window=0.2)
# Of the drift, by the number of positions: degree in place of the mean PSF, and of its slope with wavelength.
DEGREES = {1: (0, 0), 4: (1, 0), 9: (2, 1), 25: (4, 2)}
# Noll's number of defocus, which every wavefront has a coefficient of.
_DEFOCUS = 4
# Of its rms, as far as which a window is looked through.
_WINDOWS = 5.0


def vis_psf(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """The Euclid PSF of a VIS detector: optics, pointing jitter, charge diffusion.

    positions : where it is computed, one of DEGREES; polynomials lie between
    detector  : of VIS;  band : passband;  mission : the mission database
    Error     : second moments 2e-4 from the number of wavelengths; across the detector as measured (psf_positions.csv)
    Ref       : pupil, Liaudat et al. 2023; wavefront and diffusion, the mission database
    """
    return _psf(VIS, detector, band, mission, positions)


def nisp_psf(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """The Euclid PSF of a NISP detector: optics, and pointing jitter with what else blurs.

    detector, band, mission, positions : as of vis_psf
    Error     : second moments 4e-4 from the number of wavelengths; across the detector as psf_positions_nisp.csv
    Ref       : pupil, Liaudat et al. 2023; wavefront, the mission database
    """
    return _psf(NISP, detector, band, mission, positions)


def nisp_psf_at(detector: Detector, waves: Float, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """That of a NISP detector at wavelengths `waves` [w] A, without what lies beyond its planes.

    detector, mission, positions : as of vis_psf
    """
    planes = _planes(NISP, detector, waves, mission, positions)
    return model.from_planes(planes, detector.pixel_scale, has_pixel=False, side=NISP.side)


def vis_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """What shines beyond the planes of the PSF of VIS."""
    return _edges(VIS, detector, band, mission)


def nisp_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """What shines beyond the planes of the PSF of NISP."""
    return _edges(NISP, detector, band, mission)


def _psf(sampling: Sampling, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Psf:
    # Second moments of diffraction go with the square of the wavelength.
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
    """Zernike coefficients at a field position: index = Noll number, nm rms.

    x, y : -1 .. 1 across the focal plane;  section : of the mission database, of the camera
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
    """Of wavelengths [w] A."""
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
        # Of the drift, a part in a hundred of the light, the mean's blur is blur enough.
        blur = tuple(np.mean(blurs, axis=0).tolist())
        return {
            "images": np.stack(centre).astype(np.float32),
            "drift": _drift(coefficients, positions, waves, camera_sampling, sampling, blur, mission).astype(
                np.float32
            ),
        }

    arrays = cache.cached_arrays(f"{section}_psf", key, make)
    axis_order = slice(None, None, -1 if detector.upside_down else 1)
    # Upside down, both the planes and the places that the drift is written in are turned.
    sign = np.array([(-1) ** (i + j) for i, j, _ in powers], np.float32)[:, None, None]
    drift = arrays["drift"][:, axis_order, axis_order] * (sign if detector.upside_down else np.float32(1.0))
    half = ((detector.nx - 1) / 2, (detector.ny - 1) / 2)
    return Planes(waves, arrays["images"][:, axis_order, axis_order], drift, half, powers, camera_sampling.samples)


def _field_position(detector: Detector, x: float, y: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Field coordinates, -1 .. 1 over the focal plane's outer edges, of a place in half sides from the centre."""
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
    """Variance along x and y, arcsec2: pointing jitter, and charge diffusion.

    Charge spreads wider of blue light (A), and the wider the thicker the detector is. Where the database has one width
    for all that blurs the optics' image, no charge spreads.
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
    """A detector's diffusion length over the mission's."""
    key = f"{detector.section}.diffusion_detectors"
    if key not in mission:
        return 1.0
    thicker = {row["detector"]: float(row["diffusion"]) for row in mission.rows(key)}
    return max(1.0 + mission.value(f"{detector.section}.diffusion_spread", "") * thicker.get(detector.name, 0.0), 0.0)


def _nodes(positions: int) -> tuple[tuple[float, float], ...]:
    """Where the PSF is computed across a detector, in half sides from its centre."""
    axis = np.linspace(-1.0, 1.0, math.isqrt(positions)).tolist() if positions > 1 else []
    return tuple((x, y) for y in axis for x in axis)


def _powers(positions: int) -> tuple[tuple[int, int, int], ...]:
    """Planes.powers of the drift: of the mean PSF, then of its slope with wavelength."""
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
    """Planes of Planes.drift in the focal plane's axes, by least squares; coefficients: of the centre and the nodes."""
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
            # The blur is the same for all, and linear.
            changes += [_blur_image(image, weights) for image in change]
    return np.stack(changes)


def centre_wavefront(
    nm: Float, waves: Float, camera_sampling: Sampling, sampling: float, mission: MissionConfiguration
) -> Float:
    """A wavefront with the tilt that puts the windowed centroid of its light in a pixel at the middle sample.

    nm : by Noll number;  waves : [w] A;  sampling : arcsec;  sampled, mission : of the camera
    Error : 0.1 mas
    """
    if not camera_sampling.window:
        return nm
    # Of a band two wavelengths tell the mean.
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
    """One wavelength's PSF: [side * samples + 1] square, in the focal plane's axes."""
    weights = _blur_weights(blur, sampling)
    optics = optics_of(wavelength, sampling, mission, camera_sampling.transform)
    return _blur_image(
        diffraction_image(nm, optics, camera_sampling.side * camera_sampling.samples + 1 + 2 * _margin(weights)),
        weights,
    )


def _blur_image(image: Array, weights: tuple[Float, Float]) -> Float32:
    """Diffracted light -> blurred by weights along x and y, without a margin.

    On the image: of a transform's rounding the bright core would cover the wings.
    """
    across, along = (w.astype(np.float32) for w in weights)
    return _convolve_separable(image.astype(np.float32), across, along, len(image) - 2 * _margin(weights))


@jit
def _convolve_separable(image: Float32, across: Float32, along: Float32, side: int) -> Float32:
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
    """float64[odd]: a Gaussian of sigma samples, for images without detail finer than _DETAIL; their sum is 1.

    Error : of the transfer function, 1e-7
    """
    k = np.linspace(0.0, 2 * np.pi * DETAIL, 400)
    lost, half = 1.0 - np.exp(-0.5 * (sigma * k) ** 2), 0
    while True:
        half += 1
        basis = 1.0 - np.cos(k[:, None] * np.arange(1, half + 1))
        outer = matrices.least_squares(basis, lost)
        if np.abs(matrices.matmul(basis, outer) - lost).max() < 1e-7:
            return np.concatenate([outer[::-1] / 2, [1.0 - outer.sum()], outer / 2])
