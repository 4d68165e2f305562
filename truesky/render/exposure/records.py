"""Inputs for the rendering of one detector."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import pyarrow as pa

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.libraries.templates import Library
from truesky.render.camera.detectors import Detector
from truesky.render.channels.aim import Aim
from truesky.render.sources.disc_structure import DiscStructure
from truesky.render.sources.galaxy_stamps import GalaxyStamps
from truesky.render.sources.solar_system import Population
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class Rows:
    """Catalogue rows and other data that affect one detector.

    Attributes
    ----------
    galaxies, stars : Table
        Rows with GALAXY_COLUMNS and STAR_COLUMNS of visible_sources.py.
    galaxy_fluxes, star_fluxes : Table
        Fluxes f_nu of the same rows in the band, in microjansky.
    lenses : Table, optional
        Rows of `strong_lenses` (lensed_arcs.ARC_COLUMNS), whose sources are among the galaxies. None without lenses.
    bodies : callable, optional
        Function that returns the moving bodies of a day (ephemerides.Bodies.on_day). By default the embedded
        population.
    galaxy_library, stellar_library : Library, optional
        Libraries with the spectra to which `sed_1` and `sed_2` of galaxies, and `sed` of stars, refer. By default the
        embedded ones.
    complete_margin_arcsec : float
        Distance beyond the detector up to which the rows contain every source, in arcsec.
    previous_exposures : tuple of PreviousExposure or PreviousSky
        Exposures that leave persistence in the detector.
    discs : DiscStructure, optional
        Structure of large discs. By default they are smooth.
    stamps : GalaxyStamps, optional
        Images that replace the profiles of galaxies. None to draw profiles only.
    bulge_fractions : float array, shape (n,), optional
        Fraction of each galaxy's light in its bulge, the same in all bands. By default as in the rows.
    neighbours : tuple of NeighbourDetector
        Bright stars of detectors on the same readout board.
    """

    galaxies: pa.Table
    galaxy_fluxes: pa.Table
    stars: pa.Table
    star_fluxes: pa.Table
    lenses: pa.Table | None = None
    bodies: Callable[[int], Population] | None = None
    galaxy_library: Library | None = None
    stellar_library: Library | None = None
    complete_margin_arcsec: float = 0.0
    previous_exposures: tuple[PreviousExposure | PreviousSky, ...] = ()
    discs: DiscStructure | None = None
    stamps: GalaxyStamps | None = None
    bulge_fractions: Float | None = None
    neighbours: tuple[NeighbourDetector, ...] = ()


@dataclass(frozen=True, slots=True)
class NeighbourDetector:
    """Another detector of the same exposure, with stars on it and the fluxes of the same rows."""

    detector: Detector
    stars: pa.Table
    fluxes: pa.Table


@dataclass(frozen=True, slots=True)
class PreviousExposure:
    """Earlier exposure of the same detector, with its bright sources.

    Without `mission`, it has the mission database of the later exposure.
    """

    aim: Aim
    rows: Rows
    mission: MissionConfiguration | None = None

    @property
    def exposure(self) -> ExposureRow:
        return self.aim.exposure


@dataclass(frozen=True, slots=True)
class PreviousSky:
    """Earlier exposure of the same detector in a channel that is not rendered: only its mean sky is known."""

    exposure: ExposureRow


@dataclass(frozen=True, slots=True)
class Variant:
    """Mission, accuracy and forced effects (name -> on or off) of one variant of a request."""

    mission: MissionConfiguration
    accuracy: Accuracy
    forced: Mapping[str, bool]
