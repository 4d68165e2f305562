"""Simulate measurements of stars as in Gaia's second data release (DR2): rows of table `gaia`.

Random numbers depend only on the seed and the identifier of the star, so its measurement is the same in every file.
Errors of different quantities are not correlated. The true positions and proper motions are from table `stars`, which
has the epoch of DR2. The parameters and their sources are in gaia.toml.

References
----------
Gaia Collaboration, Brown et al. 2018
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import scipy

from lake_schema import sky, units
from lake_schema.arrays import Array, Float
from lake_schema.tables.gaia import GAIA, NOT_AVAILABLE, VARIABLE, with_variable_flag
from truesky.catalogue import parameters
from truesky.randomness.rng import uniforms

BANDS = ("gaia_g", "gaia_bp", "gaia_rp")
STAR_COLUMNS = ["id", "ra", "dec", "distance", "pm_ra", "pm_dec"]
# Columns of variable stars, which the table `stars` has if the request has variable stars.
VARIABLE_COLUMNS = ("variability", "amplitude")
FLUX_COLUMNS = [f"f_nu_{band}" for band in BANDS]
_FILE = "gaia.toml"
_MAS = 1.0 / 3.6e6
_MAG_OVER_FLUX = 2.5 / np.log(10.0)
# Rows of the array of random numbers: one per measured quantity, and one (_LISTED) for whether Gaia detects the star.
_RA, _DEC, _PARALLAX, _G, _BP, _RP, _LISTED, _PMRA, _PMDEC, _RUWE = range(10)
_COUNT = _RUWE + 1


def observe(stars: pa.Table, fluxes: pa.Table, seed: int) -> pa.Table:
    """Draw simulated Gaia measurements of stars.

    Parameters
    ----------
    stars : Table
        Rows of table `stars` with the columns STAR_COLUMNS, and VARIABLE_COLUMNS if the table has them.
    fluxes : Table
        Rows of table `star_fluxes` for the same stars in the same order, with the columns FLUX_COLUMNS.
    seed : int
        Seed of the request.

    Returns
    -------
    Table
        Rows of table `gaia`, sorted by _healpix_29 (the order-29 cell of the measured position). Stars that Gaia does
        not detect have no row. With VARIABLE_COLUMNS there is the column phot_variable_flag.
    """
    ids = stars["id"].to_numpy()
    chance = uniforms(ids, _COUNT, seed, "gaia")
    true_mags = [units.mag_of_f_nu(fluxes[name].to_numpy().astype(float)) for name in FLUX_COLUMNS]
    vega = ab_minus_vega()
    g = true_mags[0] - vega[0]
    listed = np.flatnonzero(chance[_LISTED] < completeness(g))
    noise, listed_stars = scipy.special.ndtri(chance[:, listed]), stars.take(pa.array(listed))
    columns: dict[str, Any] = {"id": ids[listed], **_astrometry(listed_stars, g[listed], noise)}
    columns |= _motion(listed_stars, g[listed], noise)
    columns["ruwe"] = _ruwe(chance[_RUWE, listed])
    for k, (short, kind) in enumerate((("g", "g"), ("bp", "xp"), ("rp", "xp"))):
        columns |= _photometry(short, true_mags[k][listed], vega[k], kind, noise[_G + k])
    declared = GAIA
    if "variability" in stars.column_names:
        declared, columns["phot_variable_flag"] = with_variable_flag(GAIA), _variable_flags(listed_stars)
    order = np.lexsort((columns["id"], columns["_healpix_29"]))
    return declared.build({name: values[order] for name, values in columns.items()})


def ab_minus_vega() -> tuple[float, ...]:
    """Return the difference between AB and Vega magnitude in each of BANDS, as defined by Gaia's zero points.

    The difference is the AB magnitude minus the Vega magnitude. It deviates by 0.04 mag from the value that follows
    from a spectrum of Vega.
    """
    return tuple(parameters.section(_FILE, "zero_points")["ab_minus_vega"])


def completeness(g: npt.ArrayLike) -> Float:
    """Return the fraction of stars with each G magnitude (Vega) that Gaia detects, 0 to 1."""
    law = parameters.section(_FILE, "completeness")
    return np.asarray(0.5 * scipy.special.erfc((np.asarray(g, float) - law["half"]) / (np.sqrt(2.0) * law["width"])))


def astrometric_errors(g: npt.ArrayLike) -> tuple[Float, Float, Float]:
    """Return the standard errors (mas) of ra (times cos(dec)), dec and parallax for G magnitudes (Vega)."""
    law = parameters.section(_FILE, "astrometry")
    z = 10.0 ** (0.4 * (np.maximum(np.asarray(g, float), law["bright"]) - 15.0))
    parallax = 1e-3 * law["scale"] * np.sqrt(law["c0"] + law["c1"] * z + law["c2"] * z**2)
    ra, dec, parallax_error = (np.maximum(factor * parallax, law["floor"]) for factor in (law["ra"], law["dec"], 1.0))
    return ra, dec, parallax_error


def proper_motion_errors(g: npt.ArrayLike) -> tuple[Float, Float]:
    """Return the standard errors (mas/yr) of the proper motions in ra (times cos(dec)) and dec, by Vega G magnitude."""
    law, (_, _, parallax) = parameters.section(_FILE, "proper_motion"), astrometric_errors(g)
    return law["ra"] * parallax, law["dec"] * parallax


def mean_flux(mag: npt.ArrayLike, band: int) -> Float:
    """Return the flux (electrons per second) of stars with Vega magnitudes `mag` in the band number `band` of BANDS."""
    zero = parameters.section(_FILE, "flux_zero_points")["vega"][band]
    return np.asarray(10.0 ** (0.4 * (zero - np.asarray(mag, float))))


def photometric_errors(mag: npt.ArrayLike, kind: str) -> Float:
    """Return the standard errors (mag) at Vega magnitudes `mag` in G (`kind` "g"), or in BP or RP (`kind` "xp")."""
    law = parameters.section(_FILE, "photometry")
    nodes, error = np.array(law[kind]), np.log(law[f"{kind}_error"])
    slope = np.diff(error) / np.diff(nodes)
    magnitude = np.asarray(mag, float)
    extrapolation = slope[-1] * np.maximum(magnitude - nodes[-1], 0.0) + slope[0] * np.minimum(
        magnitude - nodes[0], 0.0
    )
    return np.asarray(np.exp(np.interp(magnitude, nodes, error) + extrapolation))


def _astrometry(stars: pa.Table, g: Float, noise: Float) -> dict[str, Any]:
    errors = astrometric_errors(g)
    east, north = (_MAS * error * noise[k] for error, k in zip(errors[:2], (_RA, _DEC), strict=True))
    ra, dec = sky.offset_positions(stars["ra"].to_numpy(), stars["dec"].to_numpy(), np.radians(east), np.radians(north))
    distance = np.asarray(pc.fill_null(stars["distance"], np.nan).to_numpy(), float)
    parallax = 1e3 / distance + errors[2] * noise[_PARALLAX]
    return {
        "ra": ra,
        "dec": dec,
        "_healpix_29": sky.healpix_29(ra, dec),
        "ra_error": errors[0],
        "dec_error": errors[1],
        "parallax": np.ma.masked_invalid(parallax),
        "parallax_error": errors[2],
    }


def _motion(stars: pa.Table, g: Float, noise: Float) -> dict[str, Any]:
    """Return the columns of measured proper motions and their errors, masked for stars without a true proper motion."""
    true = [np.asarray(pc.fill_null(stars[name], np.nan).to_numpy(), float) for name in ("pm_ra", "pm_dec")]
    errors, columns = proper_motion_errors(g), {}
    for name, value, error, deviate in zip(("pmra", "pmdec"), true, errors, noise[_PMRA : _PMDEC + 1], strict=True):
        columns[name] = np.ma.masked_invalid(value + error * deviate)
        columns[f"{name}_error"] = np.ma.MaskedArray(error, mask=np.isnan(value))
    return columns


def _ruwe(chance: Float) -> Float:
    degrees = parameters.section(_FILE, "goodness")["degrees"]
    return np.asarray(np.sqrt(scipy.special.chdtri(degrees, chance) / degrees))


def _variable_flags(stars: pa.Table) -> Array:
    limit = parameters.section(_FILE, "variability")["min_amplitude"]
    varies = pc.and_(pc.is_valid(stars["variability"]), pc.greater(pc.fill_null(stars["amplitude"], 0.0), limit))
    return np.where(varies.to_numpy(), VARIABLE, NOT_AVAILABLE)


def _photometry(short: str, true_ab: Float, vega: float, kind: str, noise: Float) -> dict[str, Any]:
    """Return the columns of one band, with normal errors of the flux.

    `short` is the band in column names, `kind` is "g" or "xp", and `vega` the AB - Vega magnitude. Stars whose measured
    flux is not positive have masked values.
    """
    error = photometric_errors(true_ab - vega, kind) / _MAG_OVER_FLUX
    flux = 1.0 + error * noise
    with np.errstate(invalid="ignore", divide="ignore"):
        mag = np.ma.masked_invalid(true_ab - 2.5 * np.log10(flux))
    return {
        f"mag_{short}_ab": mag,
        f"phot_{short}_mean_mag": mag - vega,
        f"phot_{short}_mean_flux_over_error": np.ma.MaskedArray(flux / error, mask=np.ma.getmaskarray(mag)),
    }
