"""Which checks there are; each is a file of its own."""

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
from truesky.validation.lake.images.between import BETWEEN
from truesky.validation.lake.images.completeness import COMPLETENESS
from truesky.validation.lake.images.cosmic_rays import COSMIC_RAYS
from truesky.validation.lake.images.depth import DEPTH
from truesky.validation.lake.images.gain import GAIN
from truesky.validation.lake.images.noise import NOISE
from truesky.validation.lake.images.photometry import PHOTOMETRY
from truesky.validation.lake.images.psf import PSF
from truesky.validation.lake.images.quality import QUALITY
from truesky.validation.lake.images.saturation import SATURATION
from truesky.validation.lake.images.spectra import SPECTRA
from truesky.validation.lake.images.together import TOGETHER
from truesky.validation.lake.measure.rows import Place, Row
from truesky.validation.lake.measure.seen import Result


@dataclass(frozen=True, slots=True)
class Catalogued:
    """A check of catalogues.

    tables : that it wants, in the order in which `measured` takes their versions;  source : of its expectations
    """

    name: str
    tables: tuple[str, ...]
    measured: Callable[..., Result]
    source: str


def _plain(rows: Callable[..., list[Row]]) -> Callable[..., Result]:
    """Of a check that no figure is drawn of."""
    return lambda *versions: Result(Place(), rows(*versions), {})


# Of one frame each.
OF_FRAMES = (
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
# Of all frames together.
OF_SEVERAL = (BETWEEN, TOGETHER)
# Of the lake's tables.
OF_CATALOGUES = (
    Catalogued(observed_sky.NAME, ("galaxies",), observed_sky.measured, "observed.csv"),
    Catalogued(angular_clustering.NAME, ("galaxies",), angular_clustering.measured, angular_clustering.SOURCE),
    Catalogued(cosmic_shear.NAME, ("galaxies",), cosmic_shear.measured, cosmic_shear.SOURCE),
    Catalogued(colours.NAME, ("galaxies", "galaxy_fluxes"), colours.measured, colours.SOURCE),
    Catalogued(duplicates.NAME, ("galaxies",), _plain(duplicates.rows), duplicates.SOURCE),
    Catalogued(duplicates.NAME, ("stars",), _plain(duplicates.rows), duplicates.SOURCE),
    Catalogued(requirements.NAME, ("galaxies", "galaxy_fluxes"), _plain(requirements.rows), requirements.SOURCE),
)
