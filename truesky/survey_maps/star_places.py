"""Bright stars, the exposures that see them, and their places in the focal plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lake_schema import sky, units
from lake_schema.arrays import Array, Float, Int
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera import pointing
from truesky.render.camera.detectors import Detector
from truesky.survey_maps.planned_footprints import Footprints

# Faintest AB magnitude of a star with a halo in the mask: the limit of Coupon et al.
FAINTEST = 18.0
ARCSEC = pointing.ARCSEC


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


@dataclass(frozen=True)
class MaskExposures:
    """Exposures of a camera in a band, from which masks are predicted.

    Attributes
    ----------
    exposures : sequence of ExposureRow
        The exposures, at least one.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission parameters of the exposures.
    psf_area : float
        Effective area of the PSF, arcsec^2.
    footprints : Footprints
        Footprints of detectors in these exposures.
    """

    exposures: Sequence[ExposureRow]
    band: Passband
    mission: MissionConfiguration
    psf_area: float
    footprints: Footprints

    @cached_property
    def detectors(self) -> tuple[Detector, ...]:
        """Return all detectors of the camera, whose layout takes milliseconds to read."""
        return camera_detectors.detectors(self.exposures[0].camera, self.mission)


def pairs(stars: Stars, footprints: Footprints, margin: Float) -> tuple[Int, Int]:
    """Return the pairs of a star and a footprint that contains it, or whose sides are near it.

    Parameters
    ----------
    stars : Stars
        The stars.
    footprints : Footprints
        Footprints of detectors.
    margin : float array, shape (n,)
        Largest distance of each star from the sides of a footprint that it is outside of, arcsec.

    Returns
    -------
    star, footprint : int64 array, shape (m,)
        Indices, sorted by footprint.
    """
    from scipy.spatial import cKDTree

    indices: list[tuple[Int, Int]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    if len(stars.ra) and len(footprints.exposure):
        places = sky.unit_vectors(stars.ra, stars.dec)
        reach = np.minimum(footprints.radius + float(margin.max()) * ARCSEC, np.pi)
        for number, numbers in enumerate(
            cKDTree(places).query_ball_point(footprints.centre, 2.0 * np.sin(0.5 * reach))
        ):
            index = np.sort(np.array(numbers, np.int64))
            depth = (places[index, None] * footprints.normals[number]).sum(axis=-1).min(axis=1, initial=1.0)
            index = index[depth >= -margin[index] * ARCSEC]
            indices.append((index, np.full(len(index), number)))
    star, footprint = (np.concatenate(column) for column in zip(*indices, strict=True))
    return star, footprint


def focal_plane(stars: Stars, exposure: ExposureRow) -> tuple[Float, Float, Array]:
    """Return the places of stars in the focal plane (x, y, arcsec), and whether they are in front of the telescope."""
    places = sky.unit_vectors(stars.ra, stars.dec)
    return pointing.plane_of_sky(places, exposure.ra, exposure.dec, exposure.position_angle)


def position_angle(detector: Detector, along: float, up: float) -> float:
    """Return the position angle of a direction on a detector, if that of the focal plane is 0.

    Parameters
    ----------
    detector : Detector
        The detector.
    along, up : float
        Components of the direction along rows and along columns of pixels.

    Returns
    -------
    float
        Position angle, deg.
    """
    x, y = (float(detector.axes[i, 0] * along + detector.axes[i, 1] * up) for i in (0, 1))
    # The focal plane's x axis points west, its y axis north.
    return float(np.degrees(np.arctan2(-x, y)))
