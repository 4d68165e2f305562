"""PSF of a ground telescope: turbulent air, and optics with aberrations.

A plane is the Fourier transform of the product of three functions of rho = wavelength x frequency::

    transfer(rho)       transfer function of the air (psf/atmosphere.py), for the seeing at this wavelength
    clear(rho)          overlap of an annular pupil without aberrations with itself after a shift by rho
    ratio(rho)          mean of exp(i phase difference) over that overlap: the aberrations of the optics

The air transmits nothing beyond a few Fried lengths, which is a small part of the pupil. There the ratio is smooth and
can be interpolated from a coarse lattice. Its phase at small rho is removed, since astrometry is calibrated with
centroids. The aureole, A / (r^2 + c^2) of a star's light per arcsec^2, and the spikes of the spider's vanes are added
to the planes. A plane contains the light of a star that photometry calls its flux; light beyond the plane is
additional.

References
----------
King 1971, PASP 83, 199, and Racine 1996, PASP 108, 699 (aureole).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from scipy.interpolate import make_interp_spline
from scipy.ndimage import map_coordinates

from lake_schema.arrays import Array, Complex, Float, Float32
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices
from truesky.randomness import rng
from truesky.render.camera.detectors import Detector, detectors
from truesky.render.psf import atmosphere, euclid, model, spikes
from truesky.render.psf.aberrations import FARTHEST, Telescope, TransferRatio, ideal_transfer
from truesky.render.psf.model import Planes, Psf
from truesky.render.psf.spikes import ARCSEC, LONG, STEP, Edges
from truesky.render.psf.sub_bands import N_SUB_BANDS, sub_bands

# Sides of the planes and of the drift across a detector, pixels. Beyond the planes the aureole dominates.
SIDE, _DRIFT_SIDE = 256, 64
# Smallest number of samples per FWHM: above their Nyquist frequency the air transmits less than 1e-7. Smallest and
# largest number of samples per pixel.
_SAMPLES_OF_FWHM, _LEAST_SAMPLES, _MOST_SAMPLES = 6.0, 2, 6
# Bands with a larger mean wavelength (Angstrom) use half the number of wavelengths, since refraction varies less there.
_REDDER = 5300.0
# Largest seeing that fits into the planes, arcsec.
_WORST = 10.0
# Number of steps of the radial table.
_TABLE = 4000
# FWHM of a Gaussian in units of its standard deviation.
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


@dataclass(frozen=True, slots=True)
class Air:
    """State of the air during an exposure, in the axes of a detector.

    Attributes
    ----------
    seeing : float
        FWHM at the mean wavelength of the band, arcsec.
    shear : (float, float)
        Ellipticity (e1, e2) caused by the air: along columns, and along the diagonal.
    slope : float
        Exponent of the seeing's dependence on wavelength.
    tan_zenith_distance : float
        Tangent of the zenith distance, times the correction for refraction.
    zenith : float
        Direction of the zenith, radian from x to y.
    height : float
        Height of the observatory, m.
    """

    seeing: float
    shear: tuple[float, float] = (0.0, 0.0)
    slope: float = 0.0
    tan_zenith_distance: float = 0.0
    zenith: float = 0.0
    height: float = 0.0


def exposure_air(exposure: ExposureRow, detector: Detector, mission: MissionConfiguration) -> Air:
    """State of the air during an exposure, with a random ellipticity that is the same for all detectors.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        Detector of its camera.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Air
        The state.
    """
    section = detector.section
    # The seeing already depends on the seed of the request.
    identity = (exposure.camera, exposure.band, *(x.hex() for x in (exposure.ra, exposure.dec, exposure.mjd)))
    rms = mission.value(f"{section}.psf.air_ellipticity", "")
    size, turn = rng.stream("psf.air", exposure.seeing.hex(), *identity).random(2)
    # The squared size of two normal components is exponentially distributed.
    size = min(rms * float(np.sqrt(-2.0 * np.log1p(-size))), 0.5)
    angle = 2.0 * (np.pi * float(turn) - np.radians(detector.rotation))
    shear = size * float(np.cos(angle)), size * float(np.sin(angle))
    slope = mission.value(f"{section}.psf.seeing_slope", "")
    if exposure.airmass is None or exposure.zenith is None:
        return Air(exposure.seeing, shear, slope)
    # At position angle 0 the focal plane's x axis points west.
    zenith = float(np.radians(90.0 + exposure.zenith - exposure.position_angle - detector.rotation))
    tan_zenith_distance = float(np.sqrt(max(exposure.airmass**2 - 1.0, 0.0))) * mission.value(
        f"{section}.psf.refraction", ""
    )
    return Air(exposure.seeing, shear, slope, tan_zenith_distance, zenith, mission.value(f"{section}.site.height", "m"))


def check(seeing: float, detector: Detector, band: Passband, mission: MissionConfiguration) -> None:
    """Refuse a seeing finer than a pixel or than turbulence allows, and a pupil with an impossible area.

    Parameters
    ----------
    seeing : float
        Seeing, arcsec.
    detector : Detector
        Detector of the camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Raises
    ------
    OutOfRange
        If the seeing, or the area of the pupil, is not allowed.
    """
    outer, slope = (
        Telescope.from_mission(detector.section, mission).outer,
        mission.value(f"{detector.section}.psf.seeing_slope"),
    )
    waves = _waves(band, Air(seeing, slope=slope, tan_zenith_distance=1.0))
    best = max(atmosphere.finest_seeing(wave, outer) * (wave / waves.mean()) ** -slope for wave in waves.tolist())
    if not max(best, detector.pixel_scale) <= seeing <= _WORST:
        name = f"seeing of {detector.section} through a turbulent atmosphere, arcsec"
        raise OutOfRange(name, seeing, max(best, detector.pixel_scale), _WORST)


def atmospheric_psf(air: Air, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Psf:
    """PSF of a detector of a ground camera.

    Parameters
    ----------
    air : Air
        State of the air.
    detector : Detector
        The detector.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.
    positions : int
        Number of positions at which the PSF is computed, one of `euclid.DEGREES`; polynomials interpolate.

    Returns
    -------
    Psf
        The PSF, with an error of 1e-3 of the peak because of the sampling of the pupil.

    Notes
    -----
    `check` raises OutOfRange if the seeing is not allowed.
    """
    check(air.seeing, detector, band, mission)
    scale = detector.pixel_scale
    waves = _waves(band, air)
    widths = air.seeing * (waves / waves.mean()) ** air.slope
    telescope = Telescope.from_mission(detector.section, mission)
    fried = [
        atmosphere.fried_length(width, wave, telescope.outer)
        for width, wave in zip(widths.tolist(), waves.tolist(), strict=True)
    ]
    samples = int(np.clip(np.ceil(_SAMPLES_OF_FWHM * scale / widths.min()), _LEAST_SAMPLES, _MOST_SAMPLES))
    grid = _Grid.from_pixels(SIDE, samples, scale)
    lifts = atmosphere.refraction(waves, air.height) * air.tan_zenith_distance
    middle, turn = _wavefront(detector, 0.0, 0.0, mission), float(np.radians(detector.rotation))
    images = []
    for wave, length, lift in zip(waves, fried, lifts - lifts.mean(), strict=True):
        ratio = TransferRatio.from_wavefront(middle, telescope, float(wave), length, turn)
        plane_transfer = grid.transfer(float(wave), length, telescope, air) * grid.interpolate_ratio(ratio, float(wave))
        if lift != 0.0:
            plane_transfer *= grid.phase_shift(lift * ARCSEC * np.cos(air.zenith), lift * ARCSEC * np.sin(air.zenith))
        images.append(grid.image(plane_transfer))
    pupil_edges, outer_light = _outer_light(air, detector, band, mission, samples)
    total = 1.0 + float(outer_light.sum())
    pupil_edges = _match_rings(pupil_edges, np.mean(images, axis=0), samples)
    planes = ((np.stack(images) + outer_light) / total).astype(np.float32)
    drift = _drift(air, detector, float(waves.mean()), positions, telescope, samples, mission) / total
    half = ((detector.nx - 1) / 2, (detector.ny - 1) / 2)
    psf_planes = Planes(waves, planes, drift.astype(np.float32), half, _powers(positions), samples)
    psf = model.from_planes(psf_planes, scale, has_pixel=False, side=SIDE)
    return replace(psf, edges=replace(pupil_edges, halo=(pupil_edges.halo[0] / total, pupil_edges.halo[1])))


def edges(air: Air, detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """Sources of light beyond the planes: rings of the pupil's circles, spikes of the spider, the aureole.

    Parameters
    ----------
    air : Air
        State of the air.
    detector : Detector
        The detector.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Edges
        The edges of the pupil, and the aureole.
    """
    section, telescope = detector.section, Telescope.from_mission(detector.section, mission)
    vanes = int(mission.value(f"{section}.pupil.vanes"))
    width = mission.value(f"{section}.pupil.vane_width", "mm")
    # On an altazimuth mount, the spider has a fixed angle to the zenith.
    turn = air.zenith if mission.value(f"{section}.pupil.altazimuth") == 1.0 else -np.radians(detector.rotation)
    first = mission.value(f"{section}.pupil.vane_angle", "rad") + turn
    length = 1e3 * (telescope.radius - telescope.inner)
    bars = np.array([(first + 2.0 * np.pi * i / vanes, width, length) for i in range(vanes)]).reshape(vanes, 3)
    area = 1e6 * np.pi * (telescope.radius**2 - telescope.inner**2)
    circles = 2e3 * np.pi * (telescope.radius + telescope.inner)
    halo = tuple(mission.value(f"{section}.psf.aureole{part}", unit) for part, unit in (("", ""), ("_core", "arcsec")))
    return Edges(
        spikes.wavelengths(sub_bands(band)), area, circles, bars, air.seeing / _FWHM, detector.pixel_scale, 0.0,
        (halo[0], halo[1]),
    )  # fmt: skip


def _waves(band: Passband, air: Air) -> Float:
    """Mean wavelengths [w] of sub-bands with equal photons for flat f_nu, Angstrom; one if the air is achromatic."""
    photons = band.response / band.wavelength
    mean = float((photons * band.wavelength).sum() / photons.sum())
    count = (
        1
        if air.slope == 0.0 and air.tan_zenith_distance == 0.0
        else N_SUB_BANDS // 2
        if mean > _REDDER
        else N_SUB_BANDS
    )
    parts = sub_bands(band, count)
    return np.array([np.average(p.wavelength, weights=p.response / p.wavelength) for p in parts])


def _wavefront(detector: Detector, x: float, y: float, mission: MissionConfiguration) -> Float:
    """Wavefront by Noll number, nm, at a position on a detector in half sides from its middle."""
    turn, scale = np.radians(detector.rotation), detector.pixel_scale
    u, v = x * detector.nx * scale / 2, y * detector.ny * scale / 2
    at = (detector.x + np.cos(turn) * u - np.sin(turn) * v, detector.y + np.sin(turn) * u + np.cos(turn) * v)
    reach = max(np.hypot(abs(d.x), abs(d.y)) + d.half_diagonal for d in detectors(detector.section[4:], mission))
    return euclid.wavefront(at[0] / reach, at[1] / reach, detector.section, mission)


# ------------------------------------------------------------------------------------------------ planes


@dataclass(frozen=True, slots=True)
class _Grid:
    """Frequencies of a plane, cycles per radian: across [n / 2 + 1] and along [n]."""

    across: Float
    along: Float

    @classmethod
    def from_pixels(cls, side: int, samples: int, scale: float) -> _Grid:
        """Grid of a plane of `side` pixels of `scale` arcsec, with `samples` per pixel."""
        step = scale * ARCSEC / samples
        n = side * samples
        return cls(np.asarray(np.fft.rfftfreq(n, step), float), np.asarray(np.fft.fftfreq(n, step), float))

    def transfer(self, wave: float, fried: float, telescope: Telescope, air: Air) -> Float:
        """Transfer function of the air and of perfect optics, for a wavelength in Angstrom and a Fried length in m."""
        farthest = FARTHEST * fried
        rho = np.linspace(0.0, farthest, _TABLE)
        table = atmosphere.transfer(rho, fried, telescope.outer) * ideal_transfer(
            rho, telescope.radius, telescope.inner
        )
        (e1, e2), metres = air.shear, wave * 1e-10
        x, y = metres * self.across, metres * self.along[:, None]
        distance = np.sqrt((1.0 + e1) * x * x + (1.0 - e1) * y * y + 2.0 * e2 * x * y)
        return np.interp(distance, rho, table, right=0.0)

    def interpolate_ratio(self, ratio: TransferRatio, wave: float) -> Complex:
        """Interpolate a ratio at a wavelength (Angstrom) between its lags; it is not needed beyond them."""
        count = (len(ratio.values) - 1) // 2
        lags = ratio.step * (np.arange(len(ratio.values)) - count)
        rows, columns = (_spline(np.asarray(lags, float), wave * 1e-10 * axis) for axis in (self.along, self.across))
        parts = [
            matrices.matmul(rows, matrices.matmul(part, columns.T)) for part in (ratio.values.real, ratio.values.imag)
        ]
        return np.asarray(parts[0] + 1j * parts[1])

    def phase_shift(self, x: float, y: float) -> Complex:
        """Transfer function of a shift by x and y radian."""
        return np.asarray(np.exp(-2j * np.pi * x * self.across) * np.exp(-2j * np.pi * y * self.along[:, None]))

    def image(self, plane_transfer: Array) -> Float:
        """Image [n + 1, n + 1] about the middle sample; the light on the border is shared by both sides."""
        n = len(self.along)
        centred_image = np.fft.fftshift(scipy.fft.irfft2(plane_transfer, (n, n)))
        out = np.pad(centred_image, ((0, 1), (0, 1)), mode="wrap")
        out[[0, -1]] *= 0.5
        out[:, [0, -1]] *= 0.5
        return np.asarray(out)


def _spline(lags: Float, at: Float) -> Float:
    """Weights [n, lags] of a cubic spline at the positions `at`; 0 beyond the lags."""
    inside = np.abs(at) <= lags[-1]
    out = np.zeros((len(at), len(lags)))
    out[inside] = make_interp_spline(lags, np.eye(len(lags)), k=3)(at[inside])
    return out


def _degree(positions: int) -> int:
    """Degree of the drift; degrees above 2 change sizes by less than 1e-5."""
    return min(euclid.DEGREES[positions][0], 2)


def _powers(positions: int) -> tuple[tuple[int, int, int], ...]:
    """Powers of the drift (`Planes.powers`), which does not depend on colour."""
    return tuple((k - j, j, 0) for k in range(1, _degree(positions) + 1) for j in range(k + 1))


def _nodes(positions: int) -> tuple[tuple[float, float], ...]:
    """Positions at which the optics are evaluated across a detector, in half sides from its middle."""
    axis = np.linspace(-1.0, 1.0, _degree(positions) + 1).tolist() if _degree(positions) else []
    return tuple((x, y) for y in axis for x in axis)


def _drift(
    air: Air, detector: Detector, wave: float, positions: int, telescope: Telescope, samples: int,
    mission: MissionConfiguration,
) -> Float:  # fmt: skip
    """Planes of the drift (`Planes.drift`) at the mean wavelength, by least squares of the ratios at the nodes."""
    powers, nodes = _powers(positions), _nodes(positions)
    grid = _Grid.from_pixels(_DRIFT_SIDE, samples, detector.pixel_scale)
    if not powers:
        return np.zeros((0, len(grid.along) + 1, len(grid.along) + 1))
    fried = atmosphere.fried_length(air.seeing, wave, telescope.outer)
    turn = float(np.radians(detector.rotation))
    fronts = [_wavefront(detector, *at, mission) for at in ((0.0, 0.0), *nodes)]
    ratios = [TransferRatio.from_wavefront(front, telescope, wave, fried, turn) for front in fronts]
    x, y = np.array(nodes).T
    from_nodes = matrices.least_squares(np.stack([x**i * y**j for i, j, _ in powers], axis=1), np.eye(len(nodes)))
    off = np.stack([r.values - ratios[0].values for r in ratios[1:]])
    flat = off.reshape(len(nodes), -1)
    terms = matrices.matmul(from_nodes, flat.real) + 1j * matrices.matmul(from_nodes, flat.imag)
    plane_transfer = grid.transfer(wave, fried, telescope, air)
    changes = terms.reshape(-1, *off.shape[1:])
    return np.stack(
        [
            grid.image(plane_transfer * grid.interpolate_ratio(replace(ratios[0], values=change), wave))
            for change in changes
        ]
    )


def _match_rings(edges_: Edges, image: Float, samples: int) -> Edges:
    """Scale the rings so that they are as bright at the border of the plane as the wings of the air in it.

    The wings fall as r^-11/3; at twice the distance, the rings are too bright by a half.
    """
    axis = (np.arange(len(image)) - len(image) // 2) / samples
    r = np.hypot(axis, axis[:, None])
    annulus = (r > 0.4 * SIDE) & (r < 0.48 * SIDE)
    level = float((image[annulus] * r[annulus] ** 3).mean()) * samples**2
    now = spikes.ring_light(edges_, np.full(N_SUB_BANDS, 1.0 / N_SUB_BANDS))
    return replace(edges_, perimeter=edges_.perimeter * max(level / now, 1.0))


def _outer_light(
    air: Air, detector: Detector, band: Passband, mission: MissionConfiguration, samples: int
) -> tuple[Edges, Float32]:
    """Edges, and their light [n + 1, n + 1] inside a plane without the rings, which are part of its optics."""
    pupil_edges = edges(air, detector, band, mission)
    step = 1.0 / samples
    axis = (np.arange(SIDE * samples + 1) - SIDE * samples // 2) * step
    x, y = axis, axis[:, None]
    amplitude, core = pupil_edges.halo
    light = amplitude / (x * x + y * y + (core / pupil_edges.pixel_scale) ** 2)
    photons = np.full(N_SUB_BANDS, 1.0 / N_SUB_BANDS)
    for (angle, _, _), line in zip(pupil_edges.bars, spikes.spike_light(pupil_edges, photons, SIDE), strict=True):
        t, r = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        on_spike = np.abs(t) < STEP * (line.shape[1] - 1)
        places = np.stack([np.abs(r[on_spike]) / LONG, np.abs(t[on_spike]) / STEP])
        light[on_spike] += map_coordinates(line, places, order=1, mode="nearest")
    return pupil_edges, (light * step**2).astype(np.float32)
