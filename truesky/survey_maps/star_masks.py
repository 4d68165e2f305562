"""Predict mask bits of bright stars: halos, spikes, bleeding trails, ghosts, and saturated pixels.

The radius of a halo is that of the masks of the Hyper Suprime-Cam survey, as a function of magnitude (Coupon et al.
2018, PASJ 70, S7). They were measured with Gaia's magnitude G; the AB magnitude in the band stands for it. The radii
are multiplied by 0.5 for Euclid, which scatters less light (assumed). Spikes are bars perpendicular to the vanes of the
spider, at the angles of the exposures that see the star. They are twice as long as the halo's radius, and their half
width is a tenth of the radius, at least 1 arcsec (assumed).

Stars saturate if their brightest detector pixel has more electrons than the full well. The column of
pixels with such a star is then full over a length that holds its charge, half on each side, as in the renderer's
bleeding: charge that arrives at a serial register is lost, and at the other end of a column it turns back.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lake_schema import sky, units
from lake_schema.arrays import Float, Int
from lake_schema.tables.survey.depth import BRIGHT_STAR, GHOST, SATURATED, SPIKE
from truesky.render.camera import pointing
from truesky.render.channels import registry
from truesky.render.channels.aim import electron_rate
from truesky.render.effects.charge import bleeding
from truesky.render.exposure import scene_factory
from truesky.request.accuracy import SURVEY
from truesky.survey_maps import star_ghosts
from truesky.survey_maps.pixel_overlap import PixelGrid
from truesky.survey_maps.star_places import ARCSEC, MaskExposures, Stars, focal_plane, pairs, position_angle

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
# Fraction of a star's light in its column of pixels, times the width sqrt(N) of the PSF with an effective area of N
# pixels: sqrt(2) for a Gaussian.
_COLUMN = float(np.sqrt(2.0))


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
        chords = 2.0 * np.sin(0.5 * (radius + self.half_width) * ARCSEC)
        for number, pixels in enumerate(self._tree.query_ball_point(sky.unit_vectors(ra, dec), chords)):
            if pixels:
                yield number, np.array(pixels, np.int64)

    def along(self, pixels: Int, place: tuple[float, float], angles: Float) -> tuple[Float, Float]:
        """Return the distances of pixels from a place, along directions and across them.

        Parameters
        ----------
        pixels : int array, shape (n,)
            Indices of the pixels.
        place : (float, float)
            Right ascension and declination, deg.
        angles : float array, shape (k,)
            Position angles of the directions, radian.

        Returns
        -------
        along, across : float array, shape (n, k)
            Distances, arcsec.
        """
        east, north, _ = pointing.basis(*place)
        x, y = ((self.grid.centres[pixels] * axis.ravel()).sum(axis=1)[:, None] / ARCSEC for axis in (east, north))
        return x * np.sin(angles) + y * np.cos(angles), x * np.cos(angles) - y * np.sin(angles)


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
    _add_trails(bits, tree, saturated, seen_by)
    # With this radius, the circle touches the pixel that contains the star wherever it is in the pixel.
    smallest = grid.pixel_radius / ARCSEC - tree.half_width
    for _, pixels in tree.in_circles(saturated.ra, saturated.dec, np.full(len(saturated.ra), smallest)):
        bits[pixels] |= SATURATED
    for exposure in seen_by.exposures:
        for circles in star_ghosts.circles(stars, exposure, seen_by):
            for _, pixels in tree.in_circles(*circles):
                bits[pixels] |= GHOST
    return bits


def _saturation(seen_by: MaskExposures) -> float:
    """Return the magnitude of a star whose brightest pixel is full in the longest exposure."""
    exposure = max(seen_by.exposures, key=lambda e: e.exposure_time_s)
    detector = seen_by.detectors[0]
    scene = scene_factory.from_exposure(exposure, detector, seen_by.mission, SURVEY)
    peak = min(_PEAK * detector.pixel_scale**2 / seen_by.psf_area, 1.0)
    rate = electron_rate(exposure) * exposure.exposure_time_s
    return float(units.AB_UJY - 2.5 * np.log10(scene.full_well / (peak * rate)))


def _add_spikes(bits: Int, tree: PixelTree, stars: tuple[Stars, Float], seen_by: MaskExposures) -> None:
    """Set the bits of spikes; `stars` are the stars and the radii of their halos (arcsec)."""
    (places, halo), slopes = stars, spike_angles(seen_by)
    if not slopes:
        return
    length, width = _SPIKE_LENGTH * halo, np.maximum(_SPIKE_WIDTH * halo, _SPIKE_MIN)
    star, footprint = pairs(places, seen_by.footprints, length)
    # Exposures that see each star, sorted by star.
    observed = np.unique(np.stack([star, seen_by.footprints.exposure[footprint]], axis=1), axis=0)
    first = np.searchsorted(observed[:, 0], np.arange(len(halo) + 1))
    for i, pixels in tree.in_circles(places.ra, places.dec, length):
        angles = sorted({angle for number in observed[first[i] : first[i + 1], 1].tolist() for angle in slopes[number]})
        along, across = tree.along(pixels, (places.ra[i], places.dec[i]), np.radians(angles))
        is_spike = (np.abs(across) < width[i] + tree.half_width) & (np.abs(along) < length[i] + tree.half_width)
        bits[pixels[is_spike.any(axis=1)]] |= SPIKE


def spike_angles(seen_by: MaskExposures) -> dict[int, tuple[int, ...]]:
    """Return the position angles of the spikes (deg, 0 to 179) in each exposure; each stands for both directions.

    Spikes are perpendicular to the vanes, whose angles from the x axis of the detector the PSF model knows. On an
    altazimuth mount, it gives them for a zenith in the direction of this axis, and vanes turn with the zenith.
    """
    channel = registry.CHANNELS[seen_by.exposures[0].channel]
    detector = seen_by.detectors[0]
    edges = channel.diffraction_edges and channel.diffraction_edges(detector, seen_by.band, seen_by.mission)
    if not edges:
        return {}
    key = f"{detector.section}.pupil.altazimuth"
    follows_zenith = key in seen_by.mission and seen_by.mission.value(key) == 1.0
    spikes = [position_angle(detector, -float(np.sin(bar)), float(np.cos(bar))) for bar, *_ in edges.bars]
    angles = {}
    for exposure in seen_by.exposures:
        turn = exposure.position_angle
        if follows_zenith and exposure.zenith is not None:
            turn = exposure.zenith - position_angle(detector, 1.0, 0.0)
        angles[exposure.exposure_id] = tuple(sorted({round((spike + turn) % 180.0) % 180 for spike in spikes}))
    return angles


def _add_trails(bits: Int, tree: PixelTree, stars: Stars, seen_by: MaskExposures) -> None:
    """Set the bits of the bleeding trails of saturated stars that leave the pixel of the map with the star."""
    channel = registry.CHANNELS[seen_by.exposures[0].channel]
    if bleeding.EFFECT not in channel.effects["science"]:
        return
    exposures = {exposure.exposure_id: exposure for exposure in seen_by.exposures}
    detectors = {d.name: d for d in seen_by.detectors}
    star, footprint = pairs(stars, seen_by.footprints, np.zeros(len(stars.ra)))
    for number in np.unique(footprint):
        exposure = exposures[int(seen_by.footprints.exposure[number])]
        detector = detectors[seen_by.footprints.detector[number]]
        chosen = stars.select(star[footprint == number])
        scene = scene_factory.from_exposure(exposure, detector, seen_by.mission, SURVEY)
        electrons = (
            electron_rate(exposure) * exposure.exposure_time_s * 10.0 ** (0.4 * (units.AB_UJY - chosen.magnitude))
        )
        _, row = detector.pixel_place(*focal_plane(chosen, exposure)[:2])
        size = seen_by.psf_area / detector.pixel_scale**2
        full = float(np.min(scene.amplifier_values("full_well", "electron")))
        below, above, width = trails(row, electrons, (full, size), scene.column_segments)
        below, above, width = (detector.pixel_scale * values for values in (below, above, width))
        angle = np.radians([exposure.position_angle + position_angle(detector, 0.0, 1.0)])
        reach = np.maximum(below, above)
        long = np.flatnonzero(reach > tree.half_width)
        for i, pixels in tree.in_circles(chosen.ra[long], chosen.dec[long], reach[long]):
            k = long[i]
            along, across = (v[:, 0] for v in tree.along(pixels, (chosen.ra[k], chosen.dec[k]), angle))
            inside = (along > -below[k] - tree.half_width) & (along < above[k] + tree.half_width)
            bits[pixels[inside & (np.abs(across) < width[k] + tree.half_width)]] |= SPIKE


def trails(
    row: Float, electrons: Float, full_well_and_size: tuple[float, float], segments: bleeding.Segments
) -> tuple[Float, Float, Float]:
    """Return the lengths of bleeding trails from stars to lower and to higher rows, and half of their widths, pixels.

    Parameters
    ----------
    row : float array, shape (n,)
        Rows of the stars.
    electrons : float array, shape (n,)
        Electrons of the stars.
    full_well_and_size : (float, float)
        Full well in electrons, and effective area of the PSF in pixels.
    segments : sequence of (int, int, bool)
        Parts of every column that are read through one serial register, see `bleeding.apply`.

    Returns
    -------
    below, above, width : float array, shape (n,)
        Lengths to lower and higher rows and half widths. They are 0 for stars that do not saturate.
    """
    full, size = full_well_and_size
    peak = np.minimum(_PEAK / size, 1.0) * electrons / full
    # In a wide Gaussian PSF, columns up to this distance from the star have a full pixel.
    width = np.sqrt(size / (2.0 * np.pi) * np.log(np.maximum(peak, 1.0)))
    half = np.where(peak > 1.0, 0.5 * min(_COLUMN / np.sqrt(size), 1.0) * electrons / full, 0.0)
    below, above = half.copy(), half.copy()
    for first, past, register_above in segments:
        inside = (row >= first) & (row < past)
        to_first, to_past = row - first, past - row
        # Charge turns back at the end of the segment without a register, and is lost at the other.
        turned = np.maximum(half - (to_first if register_above else to_past), 0.0)
        below = np.where(inside, np.minimum(half + (0.0 if register_above else turned), to_first), below)
        above = np.where(inside, np.minimum(half + (turned if register_above else 0.0), to_past), above)
    return below, above, width
