"""Check requirements of the Euclid mission that concern the sky: numbers and redshifts of galaxies, H alpha emitters.

Requirements that no table of a lake can test are listed as not applicable.
"""

from __future__ import annotations

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.verdicts import AT_LEAST

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "requirement"
# Source of the requirements.
SOURCE = "requirements named by Serrano et al. 2024"
# Band of the magnitude limit of the galaxies whose number and redshifts are required (I_E).
_BAND = "euclid_vis"
# Magnitude limit in I_E of the galaxies whose number and redshifts are required, AB mag.
_LIMIT = 24.5
# Required number of galaxies per arcmin^2 with I_E < 24.5; fewer fail the check.
_PER_ARCMIN2 = 30.0
# Required median redshift of galaxies with I_E < 24.5; a lower one fails the check.
_REDSHIFT = 0.8
# A galaxy counts as an H alpha emitter if its H alpha flux is at least this value, erg/s/cm^2.
_LINE = 2e-16
# Required number of H alpha emitters per deg^2; fewer fail the check.
_EMITTERS = 3500.0
# Lowest redshift of counted H alpha emitters.
_FROM = 0.4
# Highest redshift of counted H alpha emitters.
_TO = 1.8
# Requirements that a lake cannot test: name and reason.
_UNDETERMINED = (
    ("mean_redshift_of_bins", "no photometric redshifts are measured"),
    ("psf_ellipticity_known", "no model of the PSF is fitted to the stars"),
    ("straylight", "frames contain only the sum of all sky components"),
    ("ghost_contrast", "ghosts are below the noise of single frames"),
    ("jitter", "the jitter is part of the PSF"),
    ("purity_completeness_of_spectra", "no redshifts are measured"),
    ("photometric_redshifts", "none are measured"),
)


def rows(galaxies: read.Version, fluxes: read.Version) -> list[Row]:
    """Check the mission requirements with the tables `galaxies` and `galaxy_fluxes` of a lake.

    Returns rows (measured values with required minimum and verdict). Requirements get the verdict "not_applicable" if
    no table can test them, if the catalogue is not deep enough, or if `galaxy_fluxes` lacks I_E or some galaxies.
    """
    out = [_undetermined_row(name, why) for name, why in _UNDETERMINED]
    if f"f_nu_{_BAND}" not in fluxes.schema.names:
        return [*out, not_applicable(NAME, Place(), f"table galaxy_fluxes has no column f_nu_{_BAND}", SOURCE)]
    facts = galaxies.manifest.get("facts", {})
    band, limit = facts.get("galaxy_band", _BAND), facts.get("galaxy_limit", np.inf)
    if band != _BAND or limit < _LIMIT:
        why = f"the catalogue ends at {limit:g} in {band}; the requirements are for {_LIMIT:g} in {_BAND}"
        return [*out, not_applicable(NAME, Place(), why, SOURCE)]
    light = fluxes.rows(["id", f"f_nu_{_BAND}"])
    table = galaxies.rows(["id", "z_obs", "flux_halpha", "density_boost", "_healpix_29"])
    ids, flux_ids, flux = (column.to_numpy() for column in (table["id"], light["id"], light[f"f_nu_{_BAND}"]))
    order = np.argsort(flux_ids)
    at = order[np.minimum(np.searchsorted(flux_ids[order], ids), max(len(flux_ids) - 1, 0))] if len(flux_ids) else order
    if len(ids) and (not len(flux_ids) or (flux_ids[at] != ids).any()):
        why = "table galaxy_fluxes lacks galaxies of table galaxies: select one request with --name"
        return [*out, not_applicable(NAME, Place(), why, SOURCE)]
    with np.errstate(divide="ignore"):
        mag = 23.9 - 2.5 * np.log10(flux[at[: len(ids)]].astype(float))
    weight = 1.0 / table["density_boost"].to_numpy().astype(float)
    z, line = (table[name].to_numpy().astype(float) for name in ("z_obs", "flux_halpha"))
    cell = table["_healpix_29"].to_numpy() >> 2 * (sky.MAX_ORDER - GENERATION_ORDER)
    cells = np.unique(cell)
    drawn = {c for part in galaxies.manifest["parts"] for c in part["facts"].get("generation_cells", ())} or cells
    area = sky.cell_area(GENERATION_ORDER)
    bright, emits = mag < _LIMIT, (line > _LINE) & (z > _FROM) & (z < _TO)
    per_cell = [
        np.array([weight[chosen & (cell == c)].sum() for c in sorted(drawn)]) / area for chosen in (bright, emits)
    ]
    density, lines = (_mean(values) for values in per_cell)
    redshifts = z[bright]
    spread = float(redshifts.std() / np.sqrt(max(len(redshifts), 1))) if len(redshifts) else np.nan
    # Use the scatter of the median redshift between cells as error, if larger: galaxies are clustered.
    medians = [float(np.median(z[bright & (cell == c)])) for c in cells if (bright & (cell == c)).sum() > 20]
    error = max(spread, float(np.std(medians) / np.sqrt(len(medians)))) if len(medians) > 1 else np.inf
    median = float(np.median(redshifts)) if len(redshifts) else np.nan
    note = f"{len(drawn)} cells of {area:.3g} deg2"
    return [
        _minimum_row("galaxies_24.5", (density[0] / 3600.0, density[1] / 3600.0), _PER_ARCMIN2, "arcmin-2", note),
        _minimum_row("median_redshift", (median, error), _REDSHIFT, "", note),
        _minimum_row("halpha_emitters", lines, _EMITTERS, "deg-2", note),
        *out,
    ]


def _minimum_row(quantity: str, measured: tuple[float, float], minimum: float, unit: str, note: str) -> Row:
    return Row(NAME, quantity, Place(), *measured, minimum, 0.0, unit, SOURCE, AT_LEAST, note)


def _mean(values: Float) -> tuple[float, float]:
    if len(values) < 2:
        return float(values.mean()), np.inf
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def _undetermined_row(name: str, why: str) -> Row:
    nan = float("nan")
    return Row(NAME, name, Place(), nan, nan, nan, nan, "", SOURCE, note=why, applies=False)
