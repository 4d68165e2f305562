"""PSF of a ground telescope: turbulent air, optics with aberrations, an aureole, and spikes of the spider's vanes.

An image of the PSF at one wavelength is the Fourier transform of the product of three functions of the spatial
frequency. They are expressed by a distance rho in the pupil, the wavelength (m) times the frequency (cycles / radian)::

    transfer(rho)       transfer function of the air (psf/atmosphere.py), for the seeing at this wavelength
    clear(rho)          overlap of an annular pupil without aberrations with itself after a shift by rho
    ratio(rho)          mean of exp(i phase difference) over that overlap: the aberrations of the optics

and of a Gaussian: the blur by the dome, the telescope's tracking, and the diffusion of charge in the detector.

Seeing is given as astronomers measure it: the FWHM of a star through the air alone, at the zenith and at a wavelength
of 500 nm. In a band, it is proportional to airmass^0.6 and to wavelength^slope, with the slope from the mission
database.

The air transmits practically nothing if rho is more than a few Fried lengths, which are a small part of the pupil. Up
to there the ratio is smooth and is interpolated from a coarse lattice. The phase of the ratio at small rho, which would
shift the image, is removed, since astrometry is calibrated with centroids.

The aureole and the spikes are added to the images. At the distance r arcsec from a star, the aureole has the fraction
A / (r^2 + c^2) of its light per arcsec^2, with A and c from the mission database. The images are normalised to the sum
1: the light in an image is the flux of a star in photometry. Light beyond its border is additional.

References
----------
King 1971, PASP 83, 199, and Racine 1996, PASP 108, 699 (aureole).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

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

# Side of the PSF images, pixels. Beyond their border, only the aureole, spikes and rings of bright stars are drawn.
SIDE = 256
# Side of the images that describe the change of the PSF across a detector, pixels.
_DRIFT_SIDE = 64
# The number of samples per pixel of a PSF image is chosen so that there are at least this many samples per FWHM. Above
# the Nyquist frequency of these samples the air transmits less than 1e-7.
_SAMPLES_OF_FWHM = 6.0
# Smallest number of samples of a PSF image per detector pixel.
_LEAST_SAMPLES = 2
# Largest number of samples of a PSF image per detector pixel. It takes precedence over `_SAMPLES_OF_FWHM`.
_MOST_SAMPLES = 6
# In bands with a mean wavelength (Angstrom) above this, the PSF is computed at four wavelengths instead of eight, since
# atmospheric refraction varies less there.
_REDDER = 5300.0
# Largest allowed seeing (FWHM), arcsec, for which the PSF still fits into its image. Above it OutOfRange is raised.
_WORST = 10.0
# Number of distances in the pupil, from 0 to 3 Fried lengths, at which the transfer function of the air and of optics
# without aberrations is tabulated. It is interpolated linearly between them.
_TABLE = 4000
# Wavelength at which seeing is given, Angstrom.
_SEEING_WAVELENGTH = 5000.0
# Exponent of the airmass in the FWHM of seeing (Roddier 1981).
_AIRMASS_POWER = 0.6
# Degree of the polynomial by which the PSF changes across a detector, for the keys of `euclid.DEGREES`. With degree 3,
# sizes and ellipticities in the outermost detectors are wrong by 2e-5 (LSST, DECam); in HSC, by 2e-3 and 5e-4.
_DEGREES = {1: 0, 4: 2, 9: 3, 25: 3}
# FWHM of a Gaussian in units of its standard deviation.
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


@dataclass(frozen=True, slots=True)
class Air:
    """State of the air during an exposure, in the axes of a detector (x along columns, y along rows).

    Attributes
    ----------
    seeing : float
        FWHM of the image of a star through the air at the mean wavelength of the band and the airmass of the exposure,
        arcsec.
    shear : (float, float)
        Ellipticity (e1, e2) of the PSF that is caused by the air. The PSF is stretched along x for positive e1, and
        along the diagonal x = y for positive e2. The squared axis ratio is (1 - e) / (1 + e) with e^2 = e1^2 + e2^2.
    slope : float
        Exponent s in seeing proportional to wavelength^s; 0 for seeing that does not depend on wavelength.
    tan_zenith_distance : float
        Tangent of the zenith distance, times the fraction of the refraction that an atmospheric dispersion corrector
        leaves; 0 for no refraction.
    zenith : float
        Direction of the zenith on the detector, radian, from the x axis, positive towards y.
    height : float
        Height of the observatory above sea level, m.
    system : float
        FWHM of the Gaussian blur by telescope and camera, arcsec.
    """

    seeing: float
    shear: tuple[float, float] = (0.0, 0.0)
    slope: float = 0.0
    tan_zenith_distance: float = 0.0
    zenith: float = 0.0
    height: float = 0.0
    system: float = 0.0

    @property
    def fwhm(self) -> float:
        """Approximate FWHM of a star's image without aberrations, arcsec: air and system, added in quadrature."""
        return float(np.hypot(self.seeing, self.system))


def air_in_band(seeing: float, airmass: float, section: str, band: Passband, mission: MissionConfiguration) -> Air:
    """Return the state of round, undispersed air with a given seeing, as it appears in a band.

    Parameters
    ----------
    seeing : float
        FWHM of the image of a star through the air at the zenith and at 500 nm, arcsec.
    airmass : float
        Airmass.
    section : str
        Prefix of the camera's parameters in the mission database, such as "ext.lsstcam".
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    Air
        Seeing at the mean wavelength of the band, its slope, and the blur by telescope and camera.
    """
    slope = mission.value(f"{section}.psf.seeing_slope", "")
    mean = float(_waves(band, Air(seeing, slope=slope, tan_zenith_distance=1.0)).mean())
    system = mission.value(f"{section}.psf.system_fwhm", "arcsec")
    return Air(
        seeing * airmass**_AIRMASS_POWER * (mean / _SEEING_WAVELENGTH) ** slope,
        slope=slope,
        system=system * airmass ** mission.value(f"{section}.psf.system_airmass_power", ""),
    )


def exposure_air(exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration) -> Air:
    """Return the state of the air during an exposure, with a random ellipticity that is the same for all detectors.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`. If it has no airmass or no direction of the zenith, there is no refraction.
    detector : Detector
        Detector of the camera of this exposure.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    Air
        The state in the axes of the detector.
    """
    section = detector.section
    # The random ellipticity must depend on the exposure and on the seed of the user's request. The seed itself is not
    # needed in `identity`, because the seeing, which is part of the stream's name, was drawn with it.
    identity = (exposure.camera, exposure.band, *(x.hex() for x in (exposure.ra, exposure.dec, exposure.mjd)))
    rms = mission.value(f"{section}.psf.air_ellipticity", "")
    size, turn = rng.stream("psf.air", exposure.seeing.hex(), *identity).random(2)
    # Both components of the ellipticity are normally distributed with the given rms. Then the square of its size is
    # exponentially distributed, and is drawn as rms^2 times -2 ln(1 - u) with a uniform u from 0 to 1. The size is
    # limited to 0.5.
    size = min(rms * float(np.sqrt(-2.0 * np.log1p(-size))), 0.5)
    angle = 2.0 * detector.own_radians(np.pi * float(turn))
    shear = size * float(np.cos(angle)), size * float(np.sin(angle))
    airmass = 1.0 if exposure.airmass is None else exposure.airmass
    air = replace(air_in_band(exposure.seeing, airmass, section, band, mission), shear=shear)
    if exposure.airmass is None or exposure.zenith is None:
        return air
    # Angle on the detector from the x axis to the zenith, positive towards y. For the position angle 0 the x axis of
    # the focal plane points west and the y axis north, so north is at 90 deg. Position angles, from north to east, are
    # counted in the same direction as angles from x to y.
    zenith = float(np.radians(detector.own_degrees(90.0 + exposure.zenith - exposure.position_angle)))
    tan_zenith_distance = float(np.sqrt(max(exposure.airmass**2 - 1.0, 0.0))) * mission.value(
        f"{section}.psf.refraction", ""
    )
    height = mission.value(f"{section}.site.height", "m")
    return replace(air, tan_zenith_distance=tan_zenith_distance, zenith=zenith, height=height)


def check(seeing: float, detector: Detector, band: Passband, mission: MissionConfiguration) -> None:
    """Check that the PSF of turbulent air can be computed for a seeing and for the pupil of a telescope.

    Parameters
    ----------
    seeing : float
        FWHM of the image of a star through the air at the mean wavelength of the band and the airmass of the exposure,
        arcsec.
    detector : Detector
        Detector of the camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Raises
    ------
    OutOfRange
        If the seeing is below one pixel, below the finest seeing for the outer scale of the turbulence
        (`atmosphere.finest_seeing`), or above 10 arcsec. Also if the telescope's collecting area is not positive or
        exceeds its aperture.
    """
    outer, slope = (
        Telescope.from_mission(detector.section, mission).outer,
        mission.value(f"{detector.section}.psf.seeing_slope"),
    )
    waves = _waves(band, Air(seeing, slope=slope, tan_zenith_distance=1.0))
    best = max(atmosphere.finest_seeing(wave, outer) * (wave / waves.mean()) ** -slope for wave in waves.tolist())
    if not max(best, detector.pixel_scale) <= seeing <= _WORST:
        name = f"seeing of {detector.section} in {band.name} through a turbulent atmosphere, arcsec"
        raise OutOfRange(name, seeing, max(best, detector.pixel_scale), _WORST)


def atmospheric_psf(air: Air, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Psf:
    """Return the PSF of a detector of a ground camera, through turbulent air and aberrated optics.

    Parameters
    ----------
    air : Air
        State of the air during the exposure.
    detector : Detector
        The detector.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    positions : int
        Number that selects the degree of the polynomials by which the PSF changes across the detector: 1, 4, 9 or 25
        (keys of `euclid.DEGREES`); 25 is treated as 9.

    Returns
    -------
    Psf
        The PSF in the axes of the detector, with an error of 1e-3 of the peak because of the sampling of the pupil.

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
    blur = grid.gaussian(air.system)
    lifts = atmosphere.refraction(waves, air.height) * air.tan_zenith_distance
    middle = _wavefront(detector, band.name, 0.0, 0.0, mission)
    images = []
    for wave, length, lift in zip(waves, fried, lifts - lifts.mean(), strict=True):
        ratio = TransferRatio.from_wavefront(middle, telescope, float(wave), length, detector.axes)
        plane_transfer = (
            blur * grid.transfer(float(wave), length, telescope, air) * grid.interpolate_ratio(ratio, float(wave))
        )
        if lift != 0.0:
            plane_transfer *= grid.phase_shift(lift * ARCSEC * np.cos(air.zenith), lift * ARCSEC * np.sin(air.zenith))
        images.append(grid.image(plane_transfer))
    pupil_edges, outer_light = _outer_light(air, detector, band, mission, samples)
    total = 1.0 + float(outer_light.sum())
    pupil_edges = _match_rings(pupil_edges, np.mean(images, axis=0), samples)
    planes = ((np.stack(images) + outer_light) / total).astype(np.float32)
    drift = _drift(air, detector, band, positions, telescope, samples, mission) / total
    half = ((detector.nx - 1) / 2, (detector.ny - 1) / 2)
    psf_planes = Planes(waves, planes, drift.astype(np.float32), half, _powers(positions), samples)
    psf = model.from_planes(psf_planes, scale, has_pixel=False, side=SIDE)
    return replace(psf, edges=replace(pupil_edges, halo=(pupil_edges.halo[0] / total, pupil_edges.halo[1])))


def edges(air: Air, detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges:
    """Return what causes light far from a star: circular edges of the pupil, vanes of the spider, and the aureole.

    Parameters
    ----------
    air : Air
        State of the air during the exposure.
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
    # On an altazimuth mount, the vanes of the spider have a fixed angle to the direction of the zenith. On other mounts
    # they have a fixed angle to the x axis of the focal plane. `first` is an angle from the detector's x axis.
    vane, is_altazimuth = (
        mission.value(f"{section}.pupil.vane_angle", "rad"),
        mission.value(f"{section}.pupil.altazimuth") == 1.0,
    )
    first = air.zenith + detector.handedness * vane if is_altazimuth else detector.own_radians(vane)
    length = 1e3 * (telescope.radius - telescope.inner)
    bars = np.array([(first + 2.0 * np.pi * i / vanes, width, length) for i in range(vanes)]).reshape(vanes, 3)
    area = 1e6 * np.pi * (telescope.radius**2 - telescope.inner**2)
    circles = 2e3 * np.pi * (telescope.radius + telescope.inner)
    halo = tuple(mission.value(f"{section}.psf.aureole{part}", unit) for part, unit in (("", ""), ("_core", "arcsec")))
    return Edges(
        spikes.wavelengths(sub_bands(band)), area, circles, bars, air.fwhm / _FWHM, detector.pixel_scale, 0.0,
        (halo[0], halo[1]),
    )  # fmt: skip


def _waves(band: Passband, air: Air) -> Float:
    """Return the wavelengths (Angstrom) at which the PSF is computed: the mean wavelengths of sub-bands of a passband.

    There is only one sub-band if seeing does not depend on wavelength and there is no refraction. Otherwise there are
    8, or 4 if the mean wavelength is above 5300 Angstrom. The sub-bands have equal numbers of photons for constant
    f_nu.
    """
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


def _wavefront(detector: Detector, band: str, x: float, y: float, mission: MissionConfiguration) -> Float:
    """Return the Zernike coefficients of the wavefront, nm rms by Noll number, at a position on a detector.

    `x` and `y` are measured from the centre of the detector along its own axes, in units of half of its sides. `band`
    is the name of the passband. If the mission database has no wavefront for it, that of the camera is used.
    """
    scale = detector.pixel_scale
    at = detector.to_focal_plane(x * detector.nx * scale / 2, y * detector.ny * scale / 2)
    reach = max(np.hypot(abs(d.x), abs(d.y)) + d.half_diagonal for d in detectors(detector.section[4:], mission))
    key = f"{detector.section}.{band}.psf.wavefront"
    return euclid.wavefront(float(at[0] / reach), float(at[1] / reach), detector.section, mission, key)


@dataclass(frozen=True, slots=True)
class _Grid:
    """Spatial frequencies of a PSF image with n x n samples, in cycles per radian, in the order of the FFT.

    `across` [n / 2 + 1] are the frequencies along x, without the negative ones, which a real image does not need.
    `along` [n] are the frequencies along y.
    """

    across: Float
    along: Float

    @classmethod
    def from_pixels(cls, side: int, samples: int, scale: float) -> _Grid:
        """Return the frequencies of an image of `side` x `side` pixels.

        A pixel is `scale` arcsec wide and has `samples` samples along each axis.
        """
        step = scale * ARCSEC / samples
        n = side * samples
        return cls(np.asarray(np.fft.rfftfreq(n, step), float), np.asarray(np.fft.fftfreq(n, step), float))

    def transfer(self, wave: float, fried: float, telescope: Telescope, air: Air) -> Float:
        """Return the transfer function of the air and of optics without aberrations, at all frequencies [n, n / 2 + 1].

        `wave` is the wavelength in Angstrom, and `fried` the Fried length at this wavelength in m. The ellipticity of
        the air is included. The result is 0 where the distance in the pupil exceeds 3 Fried lengths.
        """
        farthest = FARTHEST * fried
        rho = np.linspace(0.0, farthest, _TABLE)
        table = atmosphere.transfer(rho, fried, telescope.outer) * ideal_transfer(
            rho, telescope.radius, telescope.inner
        )
        (e1, e2), metres = air.shear, wave * 1e-10
        x, y = metres * self.across, metres * self.along[:, None]
        distance = np.sqrt((1.0 + e1) * x * x + (1.0 - e1) * y * y + 2.0 * e2 * x * y)
        return np.interp(distance, rho, table, right=0.0)

    def gaussian(self, fwhm: float) -> Float:
        """Return the transform [n, n / 2 + 1] of a round Gaussian with the sum 1 and a given FWHM in arcsec."""
        variance = (fwhm * ARCSEC / _FWHM) ** 2
        along, across = (np.exp(-2.0 * np.pi**2 * variance * axis**2) for axis in (self.along, self.across))
        return np.asarray(along[:, None] * across)

    def interpolate_ratio(self, ratio: TransferRatio, wave: float) -> Complex:
        """Interpolate a `TransferRatio` at all frequencies [n, n / 2 + 1].

        `ratio` is the transfer function of aberrated optics divided by that of perfect optics, on a lattice of shifts
        in the pupil. `wave` is the wavelength in Angstrom. The result is 0 for shifts beyond the lattice, where the air
        transmits practically nothing.
        """
        count = (len(ratio.values) - 1) // 2
        lags = ratio.step * (np.arange(len(ratio.values)) - count)
        rows, columns = (_spline(np.asarray(lags, float), wave * 1e-10 * axis) for axis in (self.along, self.across))
        parts = [
            matrices.matmul(rows, matrices.matmul(part, columns.T)) for part in (ratio.values.real, ratio.values.imag)
        ]
        return np.asarray(parts[0] + 1j * parts[1])

    def phase_shift(self, x: float, y: float) -> Complex:
        """Return the factors of a transform [n, n / 2 + 1] that move its image by the angles x and y in radian."""
        return np.asarray(np.exp(-2j * np.pi * x * self.across) * np.exp(-2j * np.pi * y * self.along[:, None]))

    def image(self, plane_transfer: Array) -> Float:
        """Return the PSF image [n + 1, n + 1] that belongs to a transfer function, centred on the middle sample.

        The inverse Fourier transform is periodic with n samples, so the first and last row (and column) of the image
        would be equal. Each of them is given half of the light, which preserves the sum.
        """
        n = len(self.along)
        centred_image = np.fft.fftshift(scipy.fft.irfft2(plane_transfer, (n, n)))
        out = np.pad(centred_image, ((0, 1), (0, 1)), mode="wrap")
        out[[0, -1]] *= 0.5
        out[:, [0, -1]] *= 0.5
        return np.asarray(out)


def _spline(lags: Float, at: Float) -> Float:
    """Return the weights [n, m] that interpolate values at `lags` [m] by a cubic spline at positions `at` [n].

    `lags` and `at` are shifts in the pupil along one axis, m. The lags must ascend and be symmetric about 0. Weights
    are 0 for positions farther from 0 than the last lag.
    """
    inside = np.abs(at) <= lags[-1]
    out = np.zeros((len(at), len(lags)))
    out[inside] = scipy.interpolate.make_interp_spline(lags, np.eye(len(lags)), k=3)(at[inside])
    return out


def _degree(positions: int) -> int:
    """Return the degree of the polynomial by which the PSF changes across a detector: 0 (no change), 2 or 3.

    `positions` is a key of `euclid.DEGREES`. Terms of higher degree are neglected.
    """
    return _DEGREES[positions]


def _powers(positions: int) -> tuple[tuple[int, int, int], ...]:
    """Return the powers of x, y and wavelength in the polynomial by which the PSF changes across a detector.

    x and y are the position on the detector, from -1 to 1 between its edges. The power of wavelength is always 0: the
    change is the same at all wavelengths. The constant term is not included. `positions` is a key of `euclid.DEGREES`.
    """
    return tuple((k - j, j, 0) for k in range(1, _degree(positions) + 1) for j in range(k + 1))


def _nodes(positions: int) -> tuple[tuple[float, float], ...]:
    """Return the positions (x, y) on a detector, from -1 to 1 between its edges, at which aberrations are computed.

    `positions` is a key of `euclid.DEGREES`. If it is 1, the result is empty: aberrations are then computed only at the
    centre of the detector, which need not be listed.
    """
    axis = np.linspace(-1.0, 1.0, _degree(positions) + 1).tolist() if _degree(positions) else []
    return tuple((x, y) for y in axis for x in axis)


def _drift(
    air: Air, detector: Detector, band: Passband, positions: int, telescope: Telescope, samples: int,
    mission: MissionConfiguration,
) -> Float:  # fmt: skip
    """Return one image per term of the polynomial in position that describes how the PSF changes across a detector.

    These are the images of `Planes.drift`. The polynomial is fitted by least squares to the transfer functions of the
    optics at several positions. As an approximation, all are computed at the mean wavelength of the band. `samples` is
    the number of samples per pixel.
    """
    powers, nodes, wave = _powers(positions), _nodes(positions), float(_waves(band, air).mean())
    grid = _Grid.from_pixels(_DRIFT_SIDE, samples, detector.pixel_scale)
    if not powers:
        return np.zeros((0, len(grid.along) + 1, len(grid.along) + 1))
    fried = atmosphere.fried_length(air.seeing, wave, telescope.outer)
    fronts = [_wavefront(detector, band.name, *at, mission) for at in ((0.0, 0.0), *nodes)]
    ratios = [TransferRatio.from_wavefront(front, telescope, wave, fried, detector.axes) for front in fronts]
    x, y = np.array(nodes).T
    from_nodes = matrices.least_squares(np.stack([x**i * y**j for i, j, _ in powers], axis=1), np.eye(len(nodes)))
    off = np.stack([r.values - ratios[0].values for r in ratios[1:]])
    flat = off.reshape(len(nodes), -1)
    terms = matrices.matmul(from_nodes, flat.real) + 1j * matrices.matmul(from_nodes, flat.imag)
    plane_transfer = grid.gaussian(air.system) * grid.transfer(wave, fried, telescope, air)
    changes = terms.reshape(-1, *off.shape[1:])
    return np.stack(
        [
            grid.image(plane_transfer * grid.interpolate_ratio(replace(ratios[0], values=change), wave))
            for change in changes
        ]
    )


def _match_rings(edges_: Edges, image: Float, samples: int) -> Edges:
    """Return the edges of the pupil with diffraction rings that are as bright as the PSF image at its border.

    Otherwise the light of a star would have a step at the border of the image. `image` is the PSF image with `samples`
    samples per pixel. Rings are only made brighter, never fainter. With the distance r from the star they fall as r^-3,
    but the wings caused by the air as r^(-11/3). As an approximation this is neglected: at twice the distance of the
    border, the light drawn is too bright by a half.
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
    """Return the edges of the pupil, and an image [n + 1, n + 1] of aureole and diffraction spikes of a star of flux 1.

    n is the side of the PSF images in samples, with `samples` samples per pixel. Diffraction rings are not included,
    since the image that is computed from the transfer function already contains them.
    """
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
        light[on_spike] += scipy.ndimage.map_coordinates(line, places, order=1, mode="nearest")
    return pupil_edges, (light * step**2).astype(np.float32)
