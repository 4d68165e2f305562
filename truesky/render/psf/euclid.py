"""PSF of Euclid's cameras VIS and NISP: diffraction at the pupil with aberrations, pointing jitter, charge diffusion.

The PSF of a source is a sum of images (planes), whose weights depend on the spectrum of the source and on its position.
The images are stored in the axes of the detector (x along columns, y along rows) and are not averaged over a pixel.
They are centred on the centroid of the light of the whole band in a Gaussian window, because astrometry is calibrated
with centroids. Coma moves the centroid from the chief ray, the ray through the centre of the pupil, by a few mas (VIS)
or tens of mas (NISP), and by 1 (VIS) or 1.5 mas (NISP) more if the window is wider by 0.01 arcsec.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lake_schema.arrays import Array, Float, Float32
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes.passbands import Passband
from truesky.numerics import cache, cache_labels, matrices
from truesky.numerics.code_fingerprints import code_key
from truesky.numerics.compiling import jit
from truesky.render.camera.detectors import Detector, detectors
from truesky.render.psf import centroids, model, spikes
from truesky.render.psf.diffraction import diffraction_image, optics_of
from truesky.render.psf.model import DETAIL, SAMPLES, SIDE, Planes, Psf
from truesky.render.psf.spikes import ARCSEC, Edges
from truesky.render.psf.sub_bands import sub_bands


@dataclass(frozen=True, slots=True)
class Sampling:
    """Sizes and sampling of the PSF images of a camera.

    Attributes
    ----------
    samples : int
        Samples per pixel of the detector.
    side : int
        Side of the PSF images, pixels.
    transform : int
        Side of the Fourier transform from the pupil to the image, samples. Light outside it is missing (0.15 % for
        VIS).
    core_transform, core_side : int
        Side of the transform (samples) and of the images (pixels) for the changes of the PSF across a detector. They
        are smaller, because only the core of the PSF changes noticeably.
    """

    samples: int
    side: int
    transform: int
    core_transform: int
    core_side: int


VIS = Sampling(SAMPLES, SIDE, 2048, 768, 160)
# Sampling of NISP, with five samples per pixel. In band Y the optics transmit spatial frequencies up to 1.84 cycles per
# pixel, or 0.37 cycles per sample.
NISP = Sampling(5, 256, 2048, 768, 96)
# Name of the light of all wavelengths of the grisms, in keys of the mission database and labels of the cache.
_SPECTRA = "spectra"
# Allowed numbers of positions on a detector at which the PSF is computed. The values are the degrees of two polynomials
# in position. The first describes the change of the PSF averaged over the wavelengths, and the second the change of the
# PSF's derivative with wavelength. Degree 0 stands for no change.
DEGREES = {1: (0, 0), 4: (1, 0), 9: (2, 1), 25: (4, 2)}
# Noll number of defocus, its index in a list of Zernike coefficients. Each list is long enough to have this element.
_DEFOCUS = 4
# Half side of the square in which the centroid of a PSF in a Gaussian window is measured, in units of the window's rms;
# two pixels are added.
_WINDOWS = 7.0


def vis_psf(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """Return the PSF of a VIS detector: diffraction with aberrations, pointing jitter, charge diffusion.

    Parameters
    ----------
    detector : Detector
        A detector of VIS.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    positions : int
        Number of positions on the detector at which the PSF is computed: 1, 4, 9 or 25 (keys of DEGREES). Polynomials
        describe the changes between them; with 1 the PSF is the same everywhere.

    Returns
    -------
    Psf
        The PSF at eight wavelengths in the band, not averaged over a pixel.

    Notes
    -----
    The number of wavelengths causes relative errors of 2e-4 of the second moments. Errors across the detector are
    measured in psf_positions.csv.

    References
    ----------
    Liaudat et al. 2023 (shape of the pupil); the mission database (wavefront and diffusion).
    """
    return _psf(VIS, detector, band, mission, positions)


def nisp_psf(detector: Detector, band: Passband, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """Return the PSF of a NISP detector: diffraction with aberrations, and one Gaussian for jitter and all other blur.

    Parameters
    ----------
    detector : Detector
        A detector of NISP.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    positions : int
        Number of positions on the detector at which the PSF is computed: 1, 4, 9 or 25 (keys of DEGREES). Polynomials
        describe the changes between them; with 1 the PSF is the same everywhere.

    Returns
    -------
    Psf
        The PSF at eight wavelengths in the band, not averaged over a pixel.

    Notes
    -----
    The number of wavelengths causes relative errors of 4e-4 of the second moments. Errors across the detector are
    measured in psf_positions_nisp.csv.

    References
    ----------
    Liaudat et al. 2023 (shape of the pupil); the mission database (wavefront).
    """
    return _psf(NISP, detector, band, mission, positions)


def nisp_psf_at(detector: Detector, waves: Float, mission: MissionConfiguration, positions: int = 9) -> Psf:
    """Return the PSF of a NISP detector at given wavelengths, without light beyond the border of the PSF images.

    Parameters
    ----------
    detector : Detector
        A detector of NISP.
    waves : float array, shape (w,)
        Wavelengths, Angstrom.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    positions : int
        Number of positions on the detector at which the PSF is computed: 1, 4, 9 or 25 (keys of DEGREES). Polynomials
        describe the changes between them; with 1 the PSF is the same everywhere.

    Returns
    -------
    Psf
        The PSF.
    """
    planes = _planes(NISP, detector, waves, mission, positions, _SPECTRA)
    psf = model.from_planes(planes, detector.pixel_scale, has_pixel=False, side=NISP.side)
    return replace(psf, window=centroid_window(detector.section, _SPECTRA, mission))


def centroid_window(section: str, light: str, mission: MissionConfiguration) -> float:
    """Return the rms of the Gaussian window in which positions of stars are centroids, arcsec.

    Parameters
    ----------
    section : str
        Prefix of the camera's parameters in the mission database, "vis" or "nisp".
    light : str
        Name of the passband, or "spectra".
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    float
        The parameter <section>.<light>.psf.window, or <section>.psf.window if the mission database has no such
        parameter. For spectra it is <section>.traces.psf.window.
    """
    key = f"{section}.{'traces' if light == _SPECTRA else light}.psf.window"
    return mission.value(key if key in mission else f"{section}.psf.window", "arcsec")


def vis_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """Return the edges of the pupil that diffract light beyond the border of the VIS PSF images.

    Parameters
    ----------
    detector : Detector
        A detector of VIS.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    Edges
        Edges of the pupil, from which rings and spikes far from a star are computed.
    """
    return _edges(VIS, detector, band, mission)


def nisp_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """Return the edges of the pupil that diffract light beyond the border of the NISP PSF images.

    Parameters
    ----------
    detector : Detector
        A detector of NISP.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    Edges
        Edges of the pupil, from which rings and spikes far from a star are computed.
    """
    return _edges(NISP, detector, band, mission)


def _psf(sampling: Sampling, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Psf:
    # The PSF of each sub-band of the passband is computed at one wavelength, the root mean square of its photons'
    # wavelengths. The second moments of a diffraction image are proportional to the square of the wavelength, so they
    # have their correct mean over the sub-band.
    parts = sub_bands(band)
    waves = np.array([np.sqrt(np.average(p.wavelength**2, weights=p.response / p.wavelength)) for p in parts])
    planes = _planes(sampling, detector, waves, mission, positions, band.name)
    psf = model.from_planes(planes, detector.pixel_scale, has_pixel=False, side=sampling.side)
    window = centroid_window(detector.section, band.name, mission)
    return replace(psf, edges=_edges(sampling, detector, band, mission), window=window)


def _edges(sampling: Sampling, detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    parts = sub_bands(band)
    waves = np.concatenate([part.wavelength for part in parts])
    blur = float(np.sqrt(np.mean(_blur_variances(detector, float(waves.mean()), mission))))
    return spikes.from_euclid_pupil(parts, blur, detector.pixel_scale, sampling.transform / sampling.samples, mission)


def wavefront(x: float, y: float, section: str, mission: MissionConfiguration, key: str = "") -> Float:
    """Return the Zernike coefficients of the wavefront at a position in the focal plane.

    Parameters
    ----------
    x, y : float
        Position in the focal plane along its axes. For VIS and NISP, each coordinate runs from -1 to 1 between the
        outer edges of the detectors. For a ground camera, the unit is the distance of the farthest corner of a detector
        from the centre.
    section : str
        Prefix of the camera's parameters in the mission database, such as "vis".
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    key : str, optional
        Name of the table of the wavefront in the mission database, such as that of a band. If the database has no such
        table, that of the camera is used.

    Returns
    -------
    float array, shape (highest Noll number + 1,)
        Coefficients, nm rms; the index is the Noll number, and element 0 is 0.
    """
    terms = mission.numbers(key if key in mission else f"{section}.psf.wavefront")
    nm = np.zeros(1 + int(max(term[0] for term in terms)))
    for noll, x_power, y_power, coefficient in terms:
        nm[int(noll)] += coefficient * x**x_power * y**y_power
    nm *= mission.value(f"{section}.psf.wavefront_scale")
    if (key := f"{section}.psf.defocus") in mission:
        nm[_DEFOCUS] += mission.value(key, "nm")
    return nm


def _planes(
    camera_sampling: Sampling,
    detector: Detector,
    waves: Float,
    mission: MissionConfiguration,
    positions: int,
    light: str,
) -> Planes:
    """Return the images whose weighted sum is the PSF of a detector, at the wavelengths `waves` [w], Angstrom.

    `positions` is the number of positions on the detector at which the PSF is computed, a key of DEGREES. `light` is
    the name of the passband, or "spectra", by which forecasts find the images. They are computed once and then read
    from a cache on disc.
    """
    section = detector.section
    nodes, powers = _nodes(positions), _powers(positions)
    places = [_field_position(detector, *place, mission) for place in ((0.0, 0.0), *nodes)]
    sampling = detector.pixel_scale / camera_sampling.samples
    wavefronts = np.array([wavefront(*place, section, mission) for place in places])
    blurs = [_blur_variances(detector, float(wavelength), mission) for wavelength in waves]
    window = centroid_window(section, light, mission)
    optics = [p for p in mission.parameters if p.key.startswith("plm.")]
    key = cache.content_key(
        code_key(__name__),
        wavefronts,
        waves,
        repr([(p.key, p.value, p.unit) for p in optics]),
        repr((camera_sampling, sampling, window, *blurs)),
    )

    def make() -> dict[str, Array]:
        # Jitter and charge diffusion blur the PSF by a Gaussian that depends on wavelength. The changes of the PSF
        # across the detector are only one per cent of its light, so the variances averaged over the wavelengths are
        # accurate enough for them.
        blur = tuple(np.mean(blurs, axis=0).tolist())
        # The trace of a spectrum states a position for each wavelength, so each wavelength is centred. In an image,
        # the light of the whole band is centred, and the centroid depends on the colour of the source.
        groups = waves[:, None] if light == _SPECTRA else waves[None]
        tilted = [
            [centre_wavefront(nm, group, camera_sampling, (sampling, window), blur, mission) for group in groups]
            for nm in wavefronts
        ]
        coefficients = np.array([np.resize(nm, (len(waves), nm.shape[-1])) for nm in np.array(tilted)])
        centre = [
            _plane(nm, w, camera_sampling, sampling, own_blur, mission)
            for nm, w, own_blur in zip(coefficients[0], waves, blurs, strict=True)
        ]
        return {
            "images": np.stack(centre).astype(np.float32),
            "drift": _drift(coefficients, positions, waves, camera_sampling, sampling, blur, mission).astype(
                np.float32
            ),
        }

    label = cache_labels.label_psf(section, detector.name, light, positions, mission.parameters)
    arrays = cache.cached_arrays(f"{section}_psf", key, make, label)
    axis_order = slice(None, None, -1 if detector.upside_down else 1)
    # PSF images are computed in the axes of the focal plane. For a detector that is mounted upside down, images are
    # rotated by 180 deg. The change of the PSF across the detector (drift) is a polynomial of the position (x, y). Both
    # coordinates have the opposite sign on this detector, so images of terms of odd degree are multiplied by -1.
    sign = np.array([(-1) ** (i + j) for i, j, _ in powers], np.float32)[:, None, None]
    drift = arrays["drift"][:, axis_order, axis_order] * (sign if detector.upside_down else np.float32(1.0))
    half = ((detector.nx - 1) / 2, (detector.ny - 1) / 2)
    return Planes(waves, arrays["images"][:, axis_order, axis_order], drift, half, powers, camera_sampling.samples)


def _field_position(detector: Detector, x: float, y: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Convert a position on a detector to a position in the focal plane.

    `x` and `y` are measured from the centre of the detector along the axes of the focal plane, in units of half the
    sides of the detector. Each coordinate of the result runs from -1 to 1 between the outer edges of the camera's
    detectors.
    """
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
    """Return the variances of the blur by pointing jitter and charge diffusion along x and y, arcsec^2.

    x and y are the axes of the focal plane. Charge diffusion depends on the `wavelength` (Angstrom) and on the
    detector. If the mission database contains one rms width for all blur of the camera (<section>.psf.jitter, where
    <section> is the prefix of the camera's parameters), only this width is used.
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
    """Return the width (rms) of charge diffusion in this detector, divided by that in a typical detector of the camera.

    The ratio is 1 for a detector that is not in the mission database's table of charge diffusion, or if there is no
    such table. It is never negative.
    """
    key = f"{detector.section}.diffusion_detectors"
    if key not in mission:
        return 1.0
    thicker = {row["detector"]: float(row["diffusion"]) for row in mission.rows(key)}
    return max(1.0 + mission.value(f"{detector.section}.diffusion_spread", "") * thicker.get(detector.name, 0.0), 0.0)


def _nodes(positions: int) -> tuple[tuple[float, float], ...]:
    """Return the positions (x, y) at which the PSF is computed, from -1 to 1 between the edges of a detector.

    The `positions` positions form a square grid that includes the edges. If `positions` is 1, the result is empty,
    since the PSF is then computed at the centre only.
    """
    axis = np.linspace(-1.0, 1.0, math.isqrt(positions)).tolist() if positions > 1 else []
    return tuple((x, y) for y in axis for x in axis)


def _powers(positions: int) -> tuple[tuple[int, int, int], ...]:
    """Return the powers (of x, y and wavelength) of the polynomials for changes of the PSF across a detector.

    x and y are the position from the detector's centre. `positions`, a key of DEGREES, determines the degrees. Terms of
    the PSF averaged over wavelengths (power 0 of wavelength) come first, then terms of its derivative with wavelength
    (power 1). The terms without x and y are not included, since the polynomials are 0 at the centre.
    """
    return tuple(
        (degree - j, j, colour)
        for colour, max_degree in enumerate(DEGREES[positions])
        for degree in range(1, max_degree + 1)
        for j in range(degree + 1)
    )


def _drift(
    coefficients: Float,
    positions: int,
    waves: Float,
    camera_sampling: Sampling,
    sampling: float,
    blur: tuple[float, float],
    mission: MissionConfiguration,
) -> Float:
    """Return one image per term of the polynomials that describe how the PSF changes across a detector.

    The images, `Planes.drift`, are in the axes of the focal plane. `coefficients`, shape (places, wavelengths, z), are
    the wavefronts (Zernike coefficients in nm by Noll number) at the detector's centre and then at the positions of
    `_nodes`. The polynomials are fitted to the PSFs at these positions by least squares. `waves` are the wavelengths in
    Angstrom, `sampling` is the spacing of the image's samples in arcsec, and `blur` are the variances of the blur along
    x and y in arcsec^2.
    """
    powers, weights = _powers(positions), _blur_weights(blur, sampling)
    side = camera_sampling.core_side * camera_sampling.samples + 1
    if not powers:
        return np.zeros((0, side, side))
    side += 2 * _margin(weights)
    mean, slope = np.zeros((2, len(coefficients), side, side))
    redder = (waves - waves.mean()) / np.sum((waves - waves.mean()) ** 2)
    for w, (wavelength, tilt) in enumerate(zip(waves, redder, strict=True)):
        optics = optics_of(float(wavelength), sampling, mission, camera_sampling.core_transform)
        for i, nm in enumerate(coefficients[:, w]):
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
            # The blur is linear and the same for all images. It is applied to the images of the fitted polynomial,
            # which are fewer than the computed images.
            changes += [_blur_image(image, weights) for image in change]
    return np.stack(changes)


def centre_wavefront(
    nm: Float,
    waves: Float,
    camera_sampling: Sampling,
    widths: tuple[float, float],
    blur: tuple[float, float],
    mission: MissionConfiguration,
) -> Float:
    """Add a tilt to a wavefront, so that the centroid of the PSF lies on the middle sample of its image.

    The centroid is measured in a Gaussian window on the blurred image with pixels. It is the mean over positions within
    a pixel (psf/centroids.py).

    Parameters
    ----------
    nm : float array, shape (z,)
        Zernike coefficients of the wavefront, nm rms; the index is the Noll number.
    waves : float array, shape (w,)
        Wavelengths with equal numbers of photons, Angstrom.
    camera_sampling : Sampling
        Sampling of the camera's PSF images.
    widths : (float, float)
        Spacing of the samples of the image, and rms of the window, arcsec.
    blur : (float, float)
        Variances of the blur by jitter and charge diffusion along x and y, arcsec^2.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    float array, shape (z,)
        Zernike coefficients with the tilt. The error of the centroid is 0.1 mas.
    """
    sampling, window_rms = widths
    # The centroid of the light in the whole band is approximated by that of the sum of the images at two wavelengths,
    # one standard deviation of the wavelengths below and above their mean.
    off = float(waves.std())
    optics = [
        optics_of(float(waves.mean()) + part, sampling, mission, camera_sampling.core_transform)
        for part in sorted({-off, off})
    ]
    weights = _blur_weights(blur, sampling)
    samples = camera_sampling.samples
    pixel = sampling * samples
    side = 2 * samples * (math.ceil(_WINDOWS * window_rms / pixel) + 2) + 1

    light = np.sum([diffraction_image(nm, each, side + 2 * _margin(weights)) for each in optics], axis=0)
    position = pixel * centroids.mean_centroid(_blur_image(light, weights), samples, window_rms / pixel)
    # A tilt of 1 nm rms moves the whole image by -2 nm per radius of the pupil, at any wavelength.
    radius_nm = 0.5e6 * mission.value("plm.aperture_diameter", "mm")
    tilted_nm = nm.copy()
    tilted_nm[2:4] += position * ARCSEC * radius_nm / 2.0
    return tilted_nm


def _plane(
    nm: Float, wavelength: float, camera_sampling: Sampling, sampling: float, blur: tuple[float, float],
    mission: MissionConfiguration,
) -> Float32:  # fmt: skip
    """Return the image of the PSF at one wavelength (Angstrom) in the axes of the focal plane.

    Each side of the image has `camera_sampling.side` times `camera_sampling.samples` plus 1 samples. `nm` are the
    Zernike coefficients of the wavefront in nm rms by Noll number, `sampling` is the spacing of samples in arcsec, and
    `blur` are the variances of the Gaussian blur along x and y in arcsec^2.
    """
    weights = _blur_weights(blur, sampling)
    optics = optics_of(wavelength, sampling, mission, camera_sampling.transform)
    return _blur_image(
        diffraction_image(nm, optics, camera_sampling.side * camera_sampling.samples + 1 + 2 * _margin(weights)),
        weights,
    )


def _blur_image(image: Array, weights: tuple[Float, Float]) -> Float32:
    """Convolve a PSF image with two kernels, `weights` along x and along y, and remove the border of the result.

    The removed border is half as wide as the longer kernel: there, the convolution would need light outside the image.
    The convolution is a sum over samples. With Fourier transforms, rounding errors from the bright core of the PSF
    would be larger than its faint wings.
    """
    across, along = (w.astype(np.float32) for w in weights)
    return _convolve_separable(image.astype(np.float32), across, along, len(image) - 2 * _margin(weights))


@jit
def _convolve_separable(image: Float32, across: Float32, along: Float32, side: int) -> Float32:
    """Convolve a square image with a separable kernel, and return the middle [side, side] of the result.

    `across` are the weights along x (from column to column), and `along` those along y. Both have odd lengths. The
    image must be wider than `side` by at least the longer kernel minus 1.
    """
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
    """Return the weights of a convolution with a Gaussian of rms `sigma` samples; their sum is 1.

    The number of weights is odd. They are not samples of a Gaussian: they are fitted so that their Fourier transform
    equals that of the Gaussian, with an error of 1e-7, up to DETAIL (0.4) cycles per sample. They must be used only for
    images without higher spatial frequencies.
    """
    k = np.linspace(0.0, 2 * np.pi * DETAIL, 400)
    lost, half = 1.0 - np.exp(-0.5 * (sigma * k) ** 2), 0
    while True:
        half += 1
        basis = 1.0 - np.cos(k[:, None] * np.arange(1, half + 1))
        outer = matrices.least_squares(basis, lost)
        if np.abs(matrices.matmul(basis, outer) - lost).max() < 1e-7:
            return np.concatenate([outer[::-1] / 2, [1.0 - outer.sum()], outer / 2])
