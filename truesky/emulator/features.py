"""Describe sources by the four numbers that determine how they are detected and measured.

They are the brightness relative to the depth, the width relative to the PSF, the light of neighbours relative to the
own light, and whether the source is a point. They are relative, so that what is learned on a few images holds at other
depths and other seeing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from lake_schema import ids, sky
from lake_schema.arrays import Array, Bool, Float, Int

# Neighbours within this distance (arcsec) contribute light.
NEAR = 3.0
# Bright neighbours contribute within this distance (arcsec): their outskirts cover fainter sources. A margin of a
# catalogue is 10 arcsec wide, so that sources that are displaced by less than 1 arcsec have all their neighbours.
FAR = 9.0
# A neighbour is bright if it exceeds the depth by this number of magnitudes.
BRIGHT = 4.0
# Smallest and largest light of neighbours relative to the own light that are distinguished.
_LEAST_LIGHT, _MOST_LIGHT = 1e-2, 1e2
# Kinds of sources that are points: QSOs and stars.
_POINTS = (2, 5)
# Half-light radius of a Gaussian in units of its standard deviation, sqrt(2 ln 2).
_HALF_LIGHT = 1.1774100225154747


@dataclass(frozen=True, slots=True)
class Features:
    """Properties of n sources, on which their detection and measurement depend.

    Attributes
    ----------
    brightness : float array, shape (n,)
        Total magnitude minus the depth (the magnitude of a point source at 5 sigma).
    width : float array, shape (n,)
        log10 of the half-light radius after convolution with the PSF, in units of that of the PSF; 0 for a point.
    blending : float array, shape (n,)
        log10 of the neighbours' light at the place of the source, relative to its own light, -2 to 2.
    is_point : bool array, shape (n,)
        True for stars and QSOs.
    """

    brightness: Float
    width: Float
    blending: Float
    is_point: Bool

    def select(self, rows: Int | Bool) -> Features:
        """Return the features of some sources, given by indices or by a boolean mask."""
        return Features(self.brightness[rows], self.width[rows], self.blending[rows], self.is_point[rows])


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Pairs of neighbouring sources, each in both directions.

    Attributes
    ----------
    source : int array, shape (m,)
        Index of the source that receives light.
    neighbour : int array, shape (m,)
        Index of its neighbour.
    distance : float array, shape (m,)
        Distance in arcsec.
    """

    source: Int
    neighbour: Int
    distance: Float


def is_point(source_ids: Int) -> Bool:
    """Return True for the identifiers of stars and QSOs."""
    return np.isin(ids.kind_from_id(source_ids), _POINTS)


def circular_radius(bulge_fraction: Array, bulge: tuple[Array, Array], disk: tuple[Array, Array]) -> Float:
    """Return the half-light radius of galaxies as if they were round, in arcsec.

    Parameters
    ----------
    bulge_fraction : float array, shape (n,)
        Flux of the bulge / total.
    bulge, disk : (float array, float array), each of shape (n,)
        Half-light semi-major axis in arcsec and axis ratio of each component.

    Returns
    -------
    float array, shape (n,)
        Mean of the components' radii, weighted by their fluxes. The radius of a component is the geometric mean of its
        half-light semi-axes.
    """
    fraction = np.asarray(bulge_fraction, float)
    radii = [np.asarray(axis, float) * np.sqrt(np.asarray(ratio, float)) for axis, ratio in (bulge, disk)]
    return np.asarray(fraction * radii[0] + (1.0 - fraction) * radii[1], float)


def psf_radius(psf_area: Array | float) -> Float:
    """Return the half-light radius (arcsec) of a Gaussian PSF with these effective areas, 4 pi sigma^2 (arcsec^2)."""
    return np.asarray(_HALF_LIGHT * np.sqrt(np.asarray(psf_area, float) / (4.0 * np.pi)))


def find_neighbours(source_ids: Int, ra: Float, dec: Float, is_bright: Bool) -> Neighbours:
    """Find pairs of sources within 3 arcsec, and bright neighbours within 9 arcsec.

    Parameters
    ----------
    source_ids : int array, shape (n,)
        Identifiers of the sources.
    ra, dec : float array, shape (n,)
        Positions in deg.
    is_bright : bool array, shape (n,)
        True for sources that contribute light up to 9 arcsec.

    Returns
    -------
    Neighbours
        The pairs, in the order of sources, and of the identifiers of neighbours of the same source. Sums over pairs
        therefore do not depend on the order in which they were found.
    """
    vectors = np.ascontiguousarray(np.reshape(sky.unit_vectors(ra, dec), (-1, 3)))
    if not len(vectors):
        return Neighbours(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    near_chord, far_chord = (2.0 * np.sin(0.5 * np.radians(limit / 3600.0)) for limit in (NEAR, FAR))
    # The pairs do not depend on the kind of tree, and a balanced one takes 1.6 times as long to build.
    tree = scipy.spatial.cKDTree(vectors, balanced_tree=False)
    pairs = tree.query_pairs(near_chord, output_type="ndarray")
    source, neighbour = (np.concatenate([pairs[:, a], pairs[:, b]]).astype(np.int64) for a, b in ((0, 1), (1, 0)))
    bright = np.flatnonzero(is_bright)
    if bright.size:
        indices = tree.query_ball_point(vectors[bright], far_chord)
        source = np.concatenate([source, *(np.asarray(row, np.int64) for row in indices)])
        neighbour = np.concatenate([neighbour, np.repeat(bright, [len(row) for row in indices])])
    chord = np.sqrt(((vectors[source] - vectors[neighbour]) ** 2).sum(axis=1))
    distance = np.degrees(2.0 * np.arcsin(0.5 * chord)) * 3600.0
    order = np.lexsort((source_ids[neighbour], source))
    source, neighbour, distance = source[order], neighbour[order], distance[order]
    # Bright neighbours within 3 arcsec were found twice, and each bright source found itself.
    is_new = source != neighbour
    is_new[1:] &= (source[1:] != source[:-1]) | (neighbour[1:] != neighbour[:-1])
    return Neighbours(source[is_new], neighbour[is_new], distance[is_new])


def neighbour_light(pairs: Neighbours, flux: Float, radius: Float, is_bright: Bool) -> Float:
    """Return log10 of the light of neighbours at the place of each source, relative to its own light.

    Parameters
    ----------
    pairs : Neighbours
        Pairs of neighbours.
    flux : float array, shape (n,)
        Flux of each source, in any unit.
    radius : float array, shape (n,)
        Half-light radius of each source after convolution with the PSF in arcsec.
    is_bright : bool array, shape (n,)
        True for sources that contribute light up to 9 arcsec; others do up to 3 arcsec.

    Returns
    -------
    float array, shape (n,)
        Logarithm of the ratio, clipped to -2 to 2. Sources without flux have 2.

    Notes
    -----
    The surface brightness of a neighbour with flux f and half-light radius h at the distance d is
    f / (pi h^2) (1 + d^2 / h^2)^-2, a Moffat profile. This is multiplied by the area of the source,
    which is pi times the square of its half-light radius.
    """
    area, neighbour_area = radius**2, radius[pairs.neighbour] ** 2
    profile = area[pairs.source] / neighbour_area / (1.0 + pairs.distance**2 / neighbour_area) ** 2
    counts = (pairs.distance <= NEAR) | is_bright[pairs.neighbour]
    received = np.where(counts, flux[pairs.neighbour] * profile, 0.0)
    light = np.bincount(pairs.source, weights=received, minlength=len(flux))
    ratio = np.divide(light, flux, out=np.full(len(flux), _MOST_LIGHT), where=flux > 0.0)
    return np.asarray(np.log10(np.clip(ratio, _LEAST_LIGHT, _MOST_LIGHT)))
