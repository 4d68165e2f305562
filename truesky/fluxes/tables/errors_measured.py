"""Measure the interpolation errors of flux tables for spectra and passbands from a user's files.

Errors for built-in spectra and passbands were measured in advance and are in flux_errors.csv.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lake_schema.arrays import Array
from truesky.fluxes import integration
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import Galaxies
from truesky.fluxes.spectra import extinction, intergalactic, lines
from truesky.fluxes.spectra.continuum import TemplateMix
from truesky.fluxes.tables import build_tables, flux_tables, settings
from truesky.fluxes.tables.build_tables import Setting
from truesky.fluxes.tables.settings import CANDIDATES, MARGIN, Choice
from truesky.numerics import cache
from truesky.numerics.code_fingerprints import code_key
from truesky.request.accuracy import Accuracy

# Number of random galaxies with which errors are measured. The largest error of a small sample is smaller than that of
# all galaxies; the factor MARGIN accounts for the difference.
_SAMPLE = 4000
# Seed of the random galaxies.
_SEED = 5


def choose(bands: Sequence[Passband], accuracy: Accuracy, library: Library) -> tuple[Choice, ...]:
    """Return for each band the smallest flux table that is accurate enough.

    Parameters
    ----------
    bands : sequence of Passband
        The passbands.
    accuracy : Accuracy
        Errors that the user allows. `accuracy.flux` is the largest allowed relative error of a flux.
    library : Library
        Templates of galaxies.

    Returns
    -------
    tuple of Choice
        Resolution of each band's table and its errors; `settings.INTEGRATED` if no table is accurate enough.

    Notes
    -----
    For built-in passbands and templates, errors are in flux_errors.csv; see settings.choose. For a passband or library
    from a user's file, and for a band with intergalactic absorption, the errors of 4000 random galaxies decide. The
    search starts at the resolution from settings.choose.
    """
    embedded_choices = settings.choose([band.name for band in bands], accuracy)
    return tuple(
        _smallest_choice(band, choice, accuracy, library)
        if library.external or band.name not in settings.measured_bands() or _is_absorbed(band, library)
        else choice
        for band, choice in zip(bands, embedded_choices, strict=True)
    )


def _is_absorbed(band: Passband, library: Library) -> bool:
    return library.intergalactic and intergalactic.is_absorbed(band, build_tables.Z_LAST)


def measure(band: Passband, setting: Setting, library: Library) -> Choice:
    """Measure the errors of fluxes from a table, relative to direct integration, with 4000 random galaxies.

    Parameters
    ----------
    band : Passband
        The passband.
    setting : Setting
        Resolution of the table.
    library : Library
        Templates of galaxies.

    Returns
    -------
    Choice
        The resolution, and the rms and largest error as fractions of the flux. Results are cached on disc.
    """
    library_key = build_tables.library_key(library)
    numbers = (setting.step, setting.n_ebv, setting.n_av)
    key_values = (*numbers, band.wavelength, band.response, band.medium, _SAMPLE, _SEED)
    key = cache.content_key(code_key(__name__), library_key, *key_values)

    def make() -> dict[str, Array]:
        rows = draw_galaxies(_SAMPLE, len(library), np.random.default_rng(_SEED))
        fast = flux_tables.galaxy_fluxes(rows, flux_tables.open_grid([band], [setting], library))
        error = np.abs(fast / integration.galaxy_fluxes(rows, [band], library) - 1.0)
        return {"errors": np.array([np.sqrt(np.mean(error**2)), error.max()])}

    rms, largest = cache.cached_arrays(f"flux_errors_{band.name}", key, make)["errors"]
    return Choice(setting, float(f"{rms:.2e}"), float(f"{largest:.2e}"))


def draw_galaxies(n: int, n_template: int, rng: np.random.Generator) -> Galaxies:
    """Draw random galaxies whose redshift, E(B-V) and A(V) are uniform over the range of the flux tables.

    Parameters
    ----------
    n : int
        Number of galaxies.
    n_template : int
        Number of templates in the library, from which two are drawn for each galaxy.
    rng : np.random.Generator
        Source of random numbers.

    Returns
    -------
    Galaxies
        Galaxies with two templates, all emission lines and no magnification.
    """
    frac = rng.uniform(0.0, 1.0, n)
    mix = TemplateMix(
        rng.uniform(build_tables.Z_FIRST, build_tables.Z_LAST, n),
        rng.integers(0, n_template, (2, n)),
        rng.integers(0, extinction.LAW_COUNT, (2, n)),
        np.stack([frac, 1.0 - frac]),
        rng.uniform(0.0, build_tables.EBV_LAST, (2, n)),
    )
    return Galaxies(
        mix,
        rng.uniform(-23.0, -16.0, n),
        rng.uniform(18.0, 26.0, n),
        10.0 ** rng.uniform(-18.0, -15.5, (n, len(lines.line_list()))),
        np.ones(n),
        rng.uniform(0.0, build_tables.A_V_LAST, n),
    )


def _smallest_choice(band: Passband, first_choice: Choice, accuracy: Accuracy, library: Library) -> Choice:
    if first_choice.setting is None:
        return first_choice
    for setting in CANDIDATES[CANDIDATES.index(first_choice.setting) :]:
        choice = measure(band, setting, library)
        if MARGIN * choice.largest <= accuracy.flux:
            return choice
    return settings.INTEGRATED
