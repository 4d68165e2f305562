"""Data classes with the inputs for the simulation of one detector's image: catalogue rows and earlier exposures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import pyarrow as pa

from lake_schema.arrays import Float, Float32
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.libraries.templates import Library
from truesky.render.camera.detectors import Detector
from truesky.render.sources.disc_structure import DiscStructure
from truesky.render.sources.galaxy_stamps import GalaxyStamps
from truesky.render.sources.nuclei import Nuclei
from truesky.render.sources.point_light import OwnSpectra
from truesky.render.sources.solar_system import Population
from truesky.render.sources.transients import Transients
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class Rows:
    """Catalogue rows and other data that affect the image of one detector in one exposure.

    Attributes
    ----------
    galaxies, stars : Table
        Catalogue rows with GALAXY_COLUMNS and STAR_COLUMNS of visible_sources.py.
    galaxy_fluxes, star_fluxes : Table
        Fluxes f_nu of the same rows, in the same order, in the band of the exposure, microjansky. For spectra, there
        may also be fluxes in the band by which sources are selected.
    lenses : Table, optional
        Rows of the table `strong_lenses` (columns lensed_arcs.ARC_COLUMNS). The lensed sources must be among the
        galaxies. None without lenses.
    bodies : callable, optional
        Function that returns the bodies of the Solar System on a day (ephemerides.Bodies.on_day). By default the
        population included in the package.
    galaxy_library, stellar_library : Library, optional
        Libraries with the spectra to which the columns `sed_1` and `sed_2` of galaxies, and `sed` of stars, refer. By
        default the libraries included in the package.
    complete_margin_arcsec : float
        Distance beyond the detector up to which the rows contain every source of the catalogues, arcsec.
    previous_exposures : tuple of PreviousExposure or PreviousSky
        Earlier exposures of this detector, whose light leaves persistence.
    discs : DiscStructure, optional
        Spiral arms and knots of large discs. By default discs are smooth.
    stamps : GalaxyStamps, optional
        Images that replace the profiles of galaxies. None to draw profiles only.
    bulge_fractions : float array, shape (n,), optional
        Fraction of each galaxy's light in its bulge in the catalogue, the same in all bands. By default the fraction in
        `galaxies`.
    transients : Transients, optional
        Supernovae around the detector; None without.
    nuclei : Nuclei, optional
        Active nuclei, varying quasars and lensed quasars around the detector; None without.
    own_spectra : OwnSpectra, optional
        Spectra of the last stars over the exposure's band. Other stars have the spectra of templates. None if all
        have.
    neighbours : tuple of NeighbourDetector
        Other detectors on the same readout board, with their bright stars, for crosstalk.
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
    transients: Transients | None = None
    nuclei: Nuclei | None = None
    own_spectra: OwnSpectra | None = None
    neighbours: tuple[NeighbourDetector, ...] = ()


@dataclass(frozen=True, slots=True)
class NeighbourDetector:
    """Another detector of the same exposure, with its bright stars.

    `stars` are catalogue rows, and `fluxes` the fluxes f_nu (microjansky) of the same stars in the same order.
    """

    detector: Detector
    stars: pa.Table
    fluxes: pa.Table


@dataclass(frozen=True, slots=True)
class PreviousExposure:
    """Earlier exposure of the same detector, whose charge leaves persistence.

    `charge` is a function without arguments that returns the expected electrons, float32[ny, nx], of this exposure. It
    draws them when it is called, unless they are in memory.
    """

    exposure: ExposureRow
    charge: Callable[[], Float32]


@dataclass(frozen=True, slots=True)
class PreviousSky:
    """Earlier exposure of the same detector that cannot be simulated, so that only its mean sky is known."""

    exposure: ExposureRow


@dataclass(frozen=True, slots=True)
class Variant:
    """Parameters with which an exposure is simulated; a request may define several sets of them (variants).

    Attributes
    ----------
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras), with the values that the request changes.
    accuracy : Accuracy
        Errors that the request accepts.
    forced : mapping of str to bool
        Detector effects that are switched on or off, by name. All other effects are applied if they are noticeable.
    """

    mission: MissionConfiguration
    accuracy: Accuracy
    forced: Mapping[str, bool]
