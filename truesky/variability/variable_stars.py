"""Variable stars: columns of table `stars`, and light curves from these columns.

The columns exist in lakes whose request has `variables = true` in its section `universe`. `pulsation_columns` and
`binary_columns` make them, and `flux_factors` computes light curves from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.tables.stars import VARIABILITY_COLUMNS
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.randomness.per_source import PerSourceGenerator
from truesky.variability import eclipses, light_curves, pulsation
from truesky.variability.eclipses import Pairs
from truesky.variability.pulsation import StarProperties

ECLIPSING, TIDAL = 6, 7
# MJD near which the epochs are: 2023-02-25. Times of observations are not many periods away.
REFERENCE_MJD = 60000.0
# Shapes, columns of their parameter, and column of the amplitude ratios of pulsating stars, by code of `variability`.
_CURVES = {
    pulsation.RR_AB: ("rr_ab", "amplitude", "rr_lyrae"),
    pulsation.RR_C: ("rr_c", "amplitude", "rr_lyrae"),
    pulsation.CEPHEID: ("cepheid", "period", "cepheid"),
    pulsation.MIRA: ("long_period", "period", "long_period"),
    pulsation.SEMIREGULAR: ("long_period", "period", "long_period"),
}
# Number of values of a light curve that are computed at a time; their arrays fit into the processor's cache.
_BLOCK = 1 << 17


def pulsation_columns(ids: Int, stars: StarProperties, seed: int) -> tuple[Int, dict[str, Array]]:
    """Draw the pulsating stars among n stars.

    Parameters
    ----------
    ids : int64 array, shape (n,)
        Identifiers of the stars, which are the keys of the random numbers.
    stars : StarProperties
        Properties of the stars.
    seed : int
        Seed of the request.

    Returns
    -------
    index : int array, shape (k,)
        Indices of the stars that pulsate.
    columns : dict of str to array, shape (k,)
        Their columns of table `stars`: variability, period, epoch and amplitude.
    """
    candidates = pulsation.may_pulsate(stars)
    rng = PerSourceGenerator(ids[candidates], seed, "stars.pulsation")
    drawn = pulsation.draw(stars.select(candidates), rng)
    start = rng.random(candidates.size)
    pulsating = np.flatnonzero(drawn.kind != pulsation.CONSTANT)
    period = drawn.period[pulsating]
    return candidates[pulsating], {
        "variability": drawn.kind[pulsating],
        "period": period,
        "epoch": REFERENCE_MJD + period * start[pulsating],
        "amplitude": drawn.amplitude[pulsating],
    }


def binary_columns(ids: Int, pairs: Pairs, seed: int) -> tuple[Int, Bool, dict[str, Array]]:
    """Draw the eclipses and tides of n binaries.

    Parameters
    ----------
    ids : int64 array, shape (n,)
        Identifiers of the primaries, which are the keys of the random numbers.
    pairs : Pairs
        Properties of the binaries.
    seed : int
        Seed of the request.

    Returns
    -------
    index : int array, shape (k,)
        Indices of binaries that may vary.
    is_variable : bool array, shape (2, k)
        True for the primaries (first row) and companions of these binaries that have eclipses or tides.
    columns : dict of str to array, shape (2, k)
        Columns of table `stars` of both stars, which are valid for variable stars only.
    """
    stage = "stars.eclipses"
    index = eclipses.may_vary(pairs, PerSourceGenerator(ids, seed, stage).random())
    rng = PerSourceGenerator(ids[index], seed, stage)
    drawn = eclipses.draw(pairs.select(index), rng)
    epoch = REFERENCE_MJD + drawn.period * ((rng.random() + drawn.phase) % 1.0)
    return (
        index,
        drawn.is_variable,
        {
            "variability": np.where(drawn.duration > 0.0, ECLIPSING, TIDAL),
            "period": drawn.period,
            "epoch": epoch,
            "amplitude": drawn.amplitude,
            "eclipse_radius_ratio": drawn.radius_ratio,
            "eclipse_impact": drawn.impact,
            "eclipse_duration": drawn.duration,
            "tidal_amplitude": drawn.tides,
        },
    )


def read_columns(rows: pa.Table) -> dict[str, Array]:
    """Return the columns of variable stars as arrays for `flux_factors`.

    `rows` are rows of table `stars`. Missing values become 0 in `variability`, and NaN in the other columns. If the
    table was made without variable stars, all stars are constant.
    """
    if "variability" not in rows.column_names:
        return {"variability": np.zeros(rows.num_rows, np.int64)}
    out: dict[str, Array] = {}
    for column in VARIABILITY_COLUMNS:
        values = rows[column.name]
        if column.name == "variability":
            out[column.name] = values.fill_null(0).to_numpy().astype(np.int64)
        else:
            out[column.name] = values.cast(pa.float64()).to_numpy()
    return out


def flux_factors(stars: Mapping[str, Any], band: Passband, mjd: npt.ArrayLike) -> Float:
    """Return the flux of stars at some dates, relative to their flux in the catalogue.

    Parameters
    ----------
    stars : mapping of str to array, shape (n,)
        Columns of table `stars` as from `read_columns`; only `variability` is needed if it is 0 for all stars.
    band : Passband
        Passband of the flux.
    mjd : float or float array, shape (m,)
        Dates (MJD, d).

    Returns
    -------
    float array, shape (n,) or (n, m)
        f_nu at the dates divided by f_nu of the catalogue; 1 for constant stars. The shape is (n,) for a single date.

    Notes
    -----
    The catalogue has the mean flux over a period of a pulsating star (intensity mean), and the flux outside of
    eclipses, averaged over the tides, of a star in a binary. A value does not depend on the other dates and stars.
    """
    dates = np.atleast_1d(np.asarray(mjd, float))
    codes = np.asarray(stars["variability"], np.int64)
    out = np.ones((codes.size, dates.size))
    wavelength = passbands.pivot_wavelength(band) if codes.any() else 0.0
    for code in np.unique(codes[codes > 0]).tolist():
        members = np.flatnonzero(codes == code)
        step = max(_BLOCK // max(dates.size, 1), 1)
        for first in range(0, members.size, step):
            chosen = members[first : first + step]
            columns = {name: np.asarray(values)[chosen] for name, values in stars.items() if name != "variability"}
            phase = (dates - columns["epoch"][:, None]) / columns["period"][:, None]
            make = _pulsation_factors if code in _CURVES else _binary_factors
            out[chosen] = make(code, columns, phase, wavelength)
    return out[:, 0] if np.ndim(mjd) == 0 else out


def _pulsation_factors(code: int, columns: Mapping[str, Array], phase: Float, wavelength: float) -> Float:
    kind, name, family = _CURVES[code]
    parameter = np.asarray(columns[name], float)
    if name == "period":
        parameter = np.log10(parameter)
    # The fraction of the phase keeps sines accurate after many periods.
    phase = phase - np.floor(phase)
    amplitude = columns["amplitude"] * light_curves.amplitude_ratio(family, wavelength)
    return light_curves.flux_factors(light_curves.shape(kind), parameter, amplitude, phase)


def _binary_factors(code: int, columns: Mapping[str, Array], phase: Float, wavelength: float) -> Float:
    shadow = (columns["eclipse_radius_ratio"], columns["eclipse_impact"], columns["eclipse_duration"])
    darkening = eclipses.limb_darkening(wavelength)
    phase = phase - np.floor(phase)
    return eclipses.flux_factors(phase, columns["period"], shadow, columns["tidal_amplitude"], darkening)
