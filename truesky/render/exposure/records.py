"""What one detector is rendered from."""

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
    """Catalogue rows that may touch the detector.

    galaxies, stars : of GALAXY_COLUMNS, STAR_COLUMNS of visible_sources.py
    galaxy_fluxes, star_fluxes : row by row their f_nu in the band, microjansky
    lenses     : of `strong_lenses` (lensed_arcs.ARC_COLUMNS), whose sources are among the galaxies; None: there is none
    bodies     : a day's moving bodies (ephemerides.Bodies.of_day); None = the embedded population
    library    : what the galaxies' sed_1 and sed_2 count;  stellar : what the stars' sed does; None = the embedded ones
    complete   : how far beyond the detector the rows have every source, arcsec
    earlier    : exposures that left something in the detector
    discs      : what structure large discs have; None = they are smooth
    stamps     : what galaxies are drawn as in place of their profiles; None = there are none
    bulges     : [n] part of the galaxies' light that is in the bulge, the same in all bands; None = as the rows say
    beside     : bright stars of the detectors that are read with this one
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
    """Another detector of the same exposure; stars : on it;  fluxes : row by row theirs."""

    detector: Detector
    stars: pa.Table
    fluxes: pa.Table


@dataclass(frozen=True, slots=True)
class PreviousExposure:
    """An exposure of the same detector before; rows : of its bright sources;  mission : None = as the later one's."""

    aim: Aim
    rows: Rows
    mission: MissionConfiguration | None = None

    @property
    def exposure(self) -> ExposureRow:
        return self.aim.exposure


@dataclass(frozen=True, slots=True)
class PreviousSky:
    """An exposure of the same detector before that nothing renders: of what shone there the sky alone is known."""

    exposure: ExposureRow


@dataclass(frozen=True, slots=True)
class Variant:
    """What one request of an exploration is rendered with; forced : effect name -> on or off."""

    mission: MissionConfiguration
    accuracy: Accuracy
    forced: Mapping[str, bool]
