"""List of all checks of a lake: of single frames, of several frames together, and of catalogues."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from truesky.validation.lake.catalogues import (
    angular_clustering,
    angular_power,
    changing_sources,
    colours,
    cosmic_shear,
    duplicates,
    observed_sky,
    redshift_multipoles,
    requirements,
)
from truesky.validation.lake.images.astrometry import ASTROMETRY
from truesky.validation.lake.images.background import BACKGROUND
from truesky.validation.lake.images.common_bias import COMMON_BIAS
from truesky.validation.lake.images.completeness import COMPLETENESS
from truesky.validation.lake.images.cosmic_rays import COSMIC_RAYS
from truesky.validation.lake.images.depth import DEPTH
from truesky.validation.lake.images.gain import GAIN
from truesky.validation.lake.images.noise import NOISE
from truesky.validation.lake.images.photometry import PHOTOMETRY
from truesky.validation.lake.images.psf import PSF
from truesky.validation.lake.images.quality import QUALITY
from truesky.validation.lake.images.repeatability import REPEATABILITY
from truesky.validation.lake.images.saturation import SATURATION
from truesky.validation.lake.images.spectra import SPECTRA
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row


@dataclass(frozen=True, slots=True)
class CatalogueCheck:
    """A check that is applied to tables of a lake, such as the clustering of galaxies.

    Attributes
    ----------
    name : str
        Name of the check.
    tables : tuple of str
        Names of the tables that the check requires, in the order of the arguments of `measure`.
    measure : callable
        Function of these published tables (Version objects) that returns a Result: rows with verdicts, and arrays for
        plots.
    source : str
        Publication or file from which the expected values are taken.
    """

    name: str
    tables: tuple[str, ...]
    measure: Callable[..., Result]
    source: str


def _without_series(rows: Callable[..., list[Row]]) -> Callable[..., Result]:
    """Convert a function that returns only rows (measured values with verdicts) to one that returns a Result.

    The Result has no arrays for plots.
    """
    return lambda *versions: Result(Place(), rows(*versions), {})


# Checks of single frames (one detector of an exposure).
FRAME_CHECKS = (
    ASTROMETRY,
    PHOTOMETRY,
    BACKGROUND,
    NOISE,
    GAIN,
    PSF,
    QUALITY,
    COSMIC_RAYS,
    SATURATION,
    DEPTH,
    COMPLETENESS,
    SPECTRA,
)
# Checks that combine the results of all frames: between exposures, and averaged over detectors.
EXPOSURE_CHECKS = (REPEATABILITY, COMMON_BIAS)
# Tables of checks that need the area and the masks of a survey.
_SURVEY = ("galaxies", "depth", "randoms")
# Checks of the catalogues (tables) of a lake.
CATALOGUE_CHECKS = (
    CatalogueCheck(observed_sky.NAME, ("galaxies",), observed_sky.measure, "observed.csv"),
    CatalogueCheck(angular_clustering.NAME, ("galaxies",), angular_clustering.measure, angular_clustering.SOURCE),
    CatalogueCheck(cosmic_shear.NAME, ("galaxies",), cosmic_shear.measure, cosmic_shear.SOURCE),
    CatalogueCheck(angular_power.NAME, _SURVEY, angular_power.measure, angular_power.SOURCE),
    CatalogueCheck(redshift_multipoles.NAME, _SURVEY, redshift_multipoles.measure, redshift_multipoles.SOURCE),
    CatalogueCheck(colours.NAME, ("galaxies", "galaxy_fluxes"), colours.measure, colours.SOURCE),
    CatalogueCheck(duplicates.NAME, ("galaxies",), _without_series(duplicates.rows), duplicates.SOURCE),
    CatalogueCheck(duplicates.NAME, ("stars",), _without_series(duplicates.rows), duplicates.SOURCE),
    CatalogueCheck(
        changing_sources.NAME,
        ("transients", "galaxies"),
        _without_series(changing_sources.supernova_rows),
        changing_sources.RATE_SOURCE,
    ),
    CatalogueCheck(
        changing_sources.NAME,
        ("active_nuclei", "galaxies"),
        _without_series(changing_sources.nucleus_rows),
        changing_sources.HOSTS_SOURCE,
    ),
    CatalogueCheck(
        requirements.NAME, ("galaxies", "galaxy_fluxes"), _without_series(requirements.rows), requirements.SOURCE
    ),
)
