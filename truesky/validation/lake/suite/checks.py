"""List of all checks of a lake."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from truesky.validation.lake.catalogues import (
    angular_clustering,
    colours,
    cosmic_shear,
    duplicates,
    observed_sky,
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
    """A check of catalogues.

    Attributes
    ----------
    name : str
        Name of the check.
    tables : tuple of str
        Tables that `measure` requires, in the order of its arguments.
    measure : callable
        Function of the versions of these tables that returns a Result.
    source : str
        Source of the expectations.
    """

    name: str
    tables: tuple[str, ...]
    measure: Callable[..., Result]
    source: str


def _without_series(rows: Callable[..., list[Row]]) -> Callable[..., Result]:
    """Wrap a check that returns rows alone, without series for figures."""
    return lambda *versions: Result(Place(), rows(*versions), {})


# Checks of single frames.
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
# Checks of all frames together.
EXPOSURE_CHECKS = (REPEATABILITY, COMMON_BIAS)
# Checks of the tables of a lake.
CATALOGUE_CHECKS = (
    CatalogueCheck(observed_sky.NAME, ("galaxies",), observed_sky.measure, "observed.csv"),
    CatalogueCheck(angular_clustering.NAME, ("galaxies",), angular_clustering.measure, angular_clustering.SOURCE),
    CatalogueCheck(cosmic_shear.NAME, ("galaxies",), cosmic_shear.measure, cosmic_shear.SOURCE),
    CatalogueCheck(colours.NAME, ("galaxies", "galaxy_fluxes"), colours.measure, colours.SOURCE),
    CatalogueCheck(duplicates.NAME, ("galaxies",), _without_series(duplicates.rows), duplicates.SOURCE),
    CatalogueCheck(duplicates.NAME, ("stars",), _without_series(duplicates.rows), duplicates.SOURCE),
    CatalogueCheck(
        requirements.NAME, ("galaxies", "galaxy_fluxes"), _without_series(requirements.rows), requirements.SOURCE
    ),
)
