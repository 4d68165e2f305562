"""Predict mask bits of bright stars: halos, spikes, ghosts of Euclid, and saturated pixels.

The radius of a halo is that of the masks of the Hyper Suprime-Cam survey, as a function of magnitude (Coupon et al.
2018, PASJ 70, S7). They were measured with Gaia's magnitude G; the AB magnitude in the band stands for it. The radii
are multiplied by 0.5 for Euclid, which scatters less light (assumed). Spikes are bars perpendicular to the vanes of the
spider. They are twice as long as the halo's radius, and their half width is a tenth of the radius, at least 1 arcsec
(assumed). Ghosts are circles with the positions and outer radii of the renderer's ghosts. Only ghosts brighter than a
tenth of a pixel's noise are masked. Stars saturate if their brightest detector pixel has more electrons than the full
well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema import sky, units
from lake_schema.arrays import Array, Float, Int
from lake_schema.mission import ghost_offsets
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.survey.depth import BRIGHT_STAR, GHOST, SATURATED, SPIKE
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera import pointing
from truesky.render.channels import registry
from truesky.render.channels.aim import electron_rate
from truesky.render.effects.scene import NOTICEABLE
from truesky.render.exposure import scene_factory
from truesky.request.accuracy import SURVEY
from truesky.survey_maps.pixel_overlap import PixelGrid

# Faintest AB magnitude of a star with a halo in the mask: the limit of Coupon et al.
FAINTEST = 18.0
# Largest distance of a star from a pixel that it masks, deg: the spikes of Sirius, of magnitude -1.5.
REACH = 0.5
# Faintest AB magnitude of a star with spikes in the mask (assumed).
_SPIKE_LIMIT = 15.0
# Halo of Coupon et al.: magnitude below which the first of the two exponentials holds, and for both the radius (arcsec)
# at magnitude 0 and the number of magnitudes by which it falls by a factor e.
_BRIGHT, _HALO_BRIGHT, _HALO_FAINT = 9.0, (708.9, 8.41), (694.7, 4.04)
# Radii in Euclid, divided by the radii in Hyper Suprime-Cam (assumed).
_IN_SPACE = 0.5
# Length and half width of a spike, relative to the radius of the halo, and smallest half width in arcsec (assumed).
_SPIKE_LENGTH, _SPIKE_WIDTH, _SPIKE_MIN = 2.0, 0.1, 1.0
# Fraction of a star's light in its brightest pixel, times the effective area of the PSF in pixels. It is 2 for a wide
# Gaussian; with this value, stars saturate in VIS at the published magnitude of 17.8.
_PEAK = 2.8
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class Stars:
    """Bright stars: positions `ra` and `dec` (deg) and `magnitude` (AB) in a band, arrays of shape (n,)."""

    ra: Float
    dec: Float
    magnitude: Float

    @classmethod
    def from_fluxes(cls, ra: Float, dec: Float, flux: Float) -> Stars:
        """Return the stars brighter than `FAINTEST`.

        Parameters
        ----------
        ra, dec : float array, shape (n,)
            Positions, deg.
        flux : float array, shape (n,)
            Flux densities, microjansky.

        Returns
        -------
        Stars
            The bright stars.
        """
        bright = np.flatnonzero(flux > 10.0 ** (-0.4 * (FAINTEST - units.AB_UJY)))
        return cls(ra[bright], dec[bright], units.AB_UJY - 2.5 * np.log10(flux[bright]))

    def select(self, chosen: Array) -> Stars:
        """Return the stars with the given flags or indices."""
        return Stars(self.ra[chosen], self.dec[chosen], self.magnitude[chosen])


@dataclass(frozen=True, slots=True)
class MaskExposures:
    """Exposures of a camera in a band, from which masks are predicted, and the effective area of the PSF (arcsec^2)."""

    exposures: Sequence[ExposureRow]
    band: Passband
    mission: MissionConfiguration
    psf_area: float


class PixelTree:
    """Find the pixels of a cell in circles on the sky."""

    def __init__(self, grid: PixelGrid) -> None:
        from scipy.spatial import cKDTree

        self.grid, self._tree = grid, cKDTree(grid.centres)
        # Half of the width of a pixel, arcsec.
        self.half_width = 0.5 * float(np.sqrt(sky.cell_area(grid.pixel_order))) * 3600.0

    def in_circles(self, ra: Float, dec: Float, radius: Float) -> Iterator[tuple[int, Int]]:
        """Yield the number of each circle that touches pixels, and the indices of these pixels.

        Parameters
        ----------
        ra, dec : float array, shape (n,)
            Centres of the circles, deg.
        radius : float array, shape (n,)
            Radii, arcsec.

        Yields
        ------
        number : int
            Number of the circle.
        pixels : int array, shape (m,)
            Indices of the pixels whose centres are less than the radius plus half of the width of a pixel away.
        """
        chords = 2.0 * np.sin(0.5 * (radius + self.half_width) * _ARCSEC)
        for number, pixels in enumerate(self._tree.query_ball_point(sky.unit_vectors(ra, dec), chords)):
            if pixels:
                yield number, np.array(pixels, np.int64)


def halo_radius(magnitude: Float, in_space: bool) -> Float:
    """Return the radius of a star's halo in the mask, arcsec.

    Parameters
    ----------
    magnitude : float array, shape (n,)
        AB magnitudes.
    in_space : bool
        True for Euclid.

    Returns
    -------
    float array, shape (n,)
        The radii.
    """
    bright, faint = (size * np.exp(-magnitude / scale) for size, scale in (_HALO_BRIGHT, _HALO_FAINT))
    return np.asarray(np.where(magnitude < _BRIGHT, bright, faint) * (_IN_SPACE if in_space else 1.0))


def predict(stars: Stars, seen_by: MaskExposures, grid: PixelGrid) -> Int:
    """Return the mask bits of bright stars in the pixels of a cell, in one band.

    Parameters
    ----------
    stars : Stars
        Stars with their magnitudes in the band, in the cell and up to `REACH` around it.
    seen_by : MaskExposures
        Exposures that touch the cell, at least one.
    grid : PixelGrid
        Pixels of the cell.

    Returns
    -------
    int64 array, shape (n,)
        Bits of the column `mask` of the table `depth`.
    """
    bits, tree = np.zeros(len(grid.centres), np.int64), PixelTree(grid)
    in_space = not registry.CHANNELS[seen_by.exposures[0].channel].on_ground
    radius = halo_radius(stars.magnitude, in_space)
    for _, pixels in tree.in_circles(stars.ra, stars.dec, radius):
        bits[pixels] |= BRIGHT_STAR
    bright = stars.magnitude < _SPIKE_LIMIT
    _add_spikes(bits, tree, (stars.select(bright), radius[bright]), seen_by)
    saturated = stars.select(stars.magnitude < _saturation(seen_by))
    # With this radius, the circle touches the pixel that contains the star wherever it is in the pixel.
    smallest = grid.pixel_radius / _ARCSEC - tree.half_width
    for _, pixels in tree.in_circles(saturated.ra, saturated.dec, np.full(len(saturated.ra), smallest)):
        bits[pixels] |= SATURATED
    for exposure in seen_by.exposures:
        for ra, dec, size in _ghosts(stars, exposure, seen_by.mission):
            for _, pixels in tree.in_circles(ra, dec, np.full(len(ra), size)):
                bits[pixels] |= GHOST
    return bits


def _saturation(seen_by: MaskExposures) -> float:
    """Return the magnitude of a star whose brightest pixel is full in the longest exposure."""
    exposure = max(seen_by.exposures, key=lambda e: e.exposure_time_s)
    detector = camera_detectors.detectors(exposure.camera, seen_by.mission)[0]
    scene = scene_factory.from_exposure(exposure, detector, seen_by.mission, SURVEY)
    peak = min(_PEAK * detector.pixel_scale**2 / seen_by.psf_area, 1.0)
    rate = electron_rate(exposure) * exposure.exposure_time_s
    return float(units.AB_UJY - 2.5 * np.log10(scene.full_well / (peak * rate)))


def _add_spikes(bits: Int, tree: PixelTree, stars: tuple[Stars, Float], seen_by: MaskExposures) -> None:
    """Set the bits of spikes; `stars` are the stars and the radii of their halos (arcsec)."""
    (places, halo), slopes = stars, spike_angles(seen_by)
    if not len(slopes):
        return
    length, width = _SPIKE_LENGTH * halo, np.maximum(_SPIKE_WIDTH * halo, _SPIKE_MIN)
    for i, pixels in tree.in_circles(places.ra, places.dec, length):
        east, north, _ = pointing.basis(places.ra[i], places.dec[i])
        to_east, to_north = ((tree.grid.centres[pixels] * axis.ravel()).sum(axis=1) / _ARCSEC for axis in (east, north))
        across = np.abs(to_east[:, None] * np.cos(slopes) - to_north[:, None] * np.sin(slopes))
        bits[pixels[(across < width[i] + tree.half_width).any(axis=1)]] |= SPIKE


def spike_angles(seen_by: MaskExposures) -> Float:
    """Return the different position angles of the spikes of all exposures, radian; each stands for both directions.

    Spikes are perpendicular to the vanes, whose angles from the x axis of the detector the PSF model knows. On an
    altazimuth mount, it gives them for a zenith in the direction of this axis, and vanes turn with the zenith.
    """
    angles = set()
    channel = registry.CHANNELS[seen_by.exposures[0].channel]
    detector = camera_detectors.detectors(seen_by.exposures[0].camera, seen_by.mission)[0]
    edges = channel.diffraction_edges and channel.diffraction_edges(detector, seen_by.band, seen_by.mission)
    key = f"{detector.section}.pupil.altazimuth"
    follows_zenith = key in seen_by.mission and seen_by.mission.value(key) == 1.0

    def position_angle(along: float, up: float) -> float:
        """Return the position angle (deg) of a direction on the detector, if that of the focal plane is 0."""
        x, y = (float(detector.axes[i, 0] * along + detector.axes[i, 1] * up) for i in (0, 1))
        # The focal plane's x axis points west, its y axis north.
        return float(np.degrees(np.arctan2(-x, y)))

    for bar, *_ in edges.bars if edges else ():
        spike = position_angle(-float(np.sin(bar)), float(np.cos(bar)))
        for exposure in seen_by.exposures:
            turn = exposure.position_angle
            if follows_zenith and exposure.zenith is not None:
                turn = exposure.zenith - position_angle(1.0, 0.0)
            angles.add(round((spike + turn) % 180.0))
    return np.radians(sorted(angles))


def _ghosts(stars: Stars, exposure: ExposureRow, mission: MissionConfiguration) -> Iterator[tuple[Float, Float, float]]:
    """Yield the positions (deg) and the radius (arcsec) of the ghosts of each plate and order of Euclid."""
    section = exposure.camera
    if section not in ghost_offsets.PLATES:
        return
    all_detectors = camera_detectors.detectors(section, mission)
    detector, (field_x, field_y) = all_detectors[0], pointing.outline(all_detectors)
    noise = NOTICEABLE * scene_factory.from_exposure(exposure, detector, mission, SURVEY).pixel_noise
    electrons = electron_rate(exposure) * exposure.exposure_time_s * 10.0 ** (0.4 * (units.AB_UJY - stars.magnitude))
    x, y, front = _focal_plane(stars, exposure)
    for plate in ghost_offsets.PLATES[section]:
        for order in ghost_offsets.orders(mission, section, plate):
            radius = order * mission.value(f"{section}.{plate}.radius_out", "pix")
            ratio = mission.value(f"{section}.{plate}.flux_ratio", "")
            if order > 1:
                ratio *= mission.value(f"{section}.{plate}.order_ratio", "") ** (order - 1)
            chosen = front & (ratio * electrons > noise * np.pi * radius**2)
            dx, dy = ghost_offsets.offset(mission, (section, plate), order, x[chosen] / 3600.0, y[chosen] / 3600.0)
            scale = detector.pixel_scale
            to_x, to_y, reach = x[chosen] + scale * dx, y[chosen] + scale * dy, radius * scale
            # Other exposures may observe the place of a ghost outside the field, but they do not have this ghost.
            inside = (to_x > field_x.min() - reach) & (to_x < field_x.max() + reach)
            inside &= (to_y > field_y.min() - reach) & (to_y < field_y.max() + reach)
            place = to_x[inside], to_y[inside]
            yield *pointing.sky_of_plane(*place, exposure.ra, exposure.dec, exposure.position_angle), reach


def _focal_plane(stars: Stars, exposure: ExposureRow) -> tuple[Float, Float, Array]:
    """Return the places of stars in the focal plane (x, y, arcsec), and whether they are in front of the telescope."""
    east, north, out = pointing.basis(exposure.ra, exposure.dec)
    places = sky.unit_vectors(stars.ra, stars.dec)
    to_east, to_north, to_out = ((places * axis.ravel()).sum(axis=-1) for axis in (east, north, out))
    front, angle = to_out > 0.5, np.radians(exposure.position_angle)
    to_east, to_north = (np.divide(v, to_out, out=np.zeros_like(v), where=front) / _ARCSEC for v in (to_east, to_north))
    # The inverse of `pointing.sky_of_plane`.
    return to_north * np.sin(angle) - to_east * np.cos(angle), to_east * np.sin(angle) + to_north * np.cos(angle), front
