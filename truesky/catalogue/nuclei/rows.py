"""Make rows of table `active_nuclei` from rows of table `galaxies`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Float, Int
from lake_schema.ids import cell_from_id, transient_id
from lake_schema.tables.variability.active_nuclei import ACTIVE_NUCLEI
from truesky.catalogue.nuclei import accretion
from truesky.catalogue.nuclei.accretion import Laws
from truesky.cosmology import Cosmology
from truesky.fluxes.high_redshift import HUBBLE, QUASAR, QUASAR_OFFSETS, QUASAR_STRENGTHS, ultraviolet_magnitude
from truesky.randomness import per_source
from truesky.randomness.per_source import PerSourceGenerator
from truesky.variability import nuclear_luminosity

_SHARED = (
    "id", "ra", "dec", "_healpix_29", "ra_true", "dec_true", "kind", "density_boost", "z_true", "z_obs", "kappa",
    "gamma1", "gamma2", "a_v",
)  # fmt: skip
# Columns of table `galaxies` that are needed.
COLUMNS = (
    *_SHARED, "halo_id", "abs_mag_r01", "log_halo_mass", "log_stellar_mass", "bulge_fraction", "sed_1",
)  # fmt: skip
_Columns = Mapping[str, npt.NDArray[np.generic]]


def draw(galaxies: pa.Table, seed: int, law: Laws, cosmology: Cosmology) -> pa.Table:
    """Return the rows of table `active_nuclei` of the quasars and active galaxies among rows of table `galaxies`.

    Parameters
    ----------
    galaxies : Table
        Rows of table `galaxies` with the columns COLUMNS. They should include the hosts of the quasars, whose stellar
        masses are else missing.
    seed : int
        Seed of the request.
    law : Laws
        Parameters of nuclei.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Table
        Rows in the order of `galaxies`.
    """
    columns = {name: _values(galaxies, name) for name in COLUMNS}
    kind, source = columns["kind"], columns["id"].astype(np.int64)
    is_quasar = kind == QUASAR
    log_mass = np.asarray(columns["log_stellar_mass"], float)
    is_galaxy = np.isin(kind, (0, 1)) & np.isfinite(log_mass)
    z = np.asarray(columns["z_true"], float)
    nuclei = accretion.draw(law, source, seed, z, np.where(is_galaxy, log_mass, 0.0))
    row = np.flatnonzero(is_quasar | (is_galaxy & accretion.has_nucleus(nuclei)))
    selected = {name: values[row] for name, values in columns.items()}
    properties = _properties(law, seed, selected, nuclei.log_luminosity[row])
    hosts, host_mass = _hosts(selected, source, log_mass)
    keys = per_source.keys(source[row], seed, "active_nuclei.light_curve")
    return ACTIVE_NUCLEI.build(
        {
            **{name: selected[name] for name in _SHARED},
            **properties,
            "type": np.where(is_quasar[row], accretion.TYPE_1, nuclei.type[row]),
            "mag_1450": ultraviolet_magnitude(cosmology, properties["m_1450"], selected["z_true"]),
            "host_id": hosts,
            "log_stellar_mass": host_mass,
            "log_halo_mass": _without_nan(np.asarray(selected["log_halo_mass"], float)),
            "point_id": np.where(is_quasar[row], source[row], transient_id(cell_from_id(source[row]), keys)),
            "light_curve_key": keys.view(np.int64),
        }
    )


def _properties(law: Laws, seed: int, rows: _Columns, log_luminosity: Float) -> dict[str, npt.NDArray[np.generic]]:
    """Return luminosities, black holes and templates; `log_luminosity` (erg/s) is that of nuclei in galaxies."""
    source, is_quasar = np.asarray(rows["id"], np.int64), rows["kind"] == QUASAR
    m_1450 = np.where(
        is_quasar,
        np.asarray(rows["abs_mag_r01"], float) + 5.0 * np.log10(HUBBLE),
        nuclear_luminosity.ultraviolet_magnitude(log_luminosity),
    )
    log_luminosity = np.where(is_quasar, nuclear_luminosity.log_luminosity(m_1450), log_luminosity)
    normal = PerSourceGenerator(source, seed, "active_nuclei.black_hole").standard_normal()
    log_mass, bulge = (np.asarray(rows[name], float) for name in ("log_stellar_mass", "bulge_fraction"))
    black_hole = np.where(
        is_quasar,
        accretion.quasar_black_hole_mass(law, m_1450, normal),
        accretion.black_hole_mass(law, np.where(is_quasar, 0.0, log_mass), bulge, log_luminosity, normal),
    )
    templates = PerSourceGenerator(source, seed, "active_nuclei.spectrum").integers(
        0, len(QUASAR_OFFSETS) * len(QUASAR_STRENGTHS)
    )
    return {
        "log_luminosity": log_luminosity,
        "m_1450": m_1450,
        "log_black_hole_mass": black_hole,
        "log_eddington_ratio": log_luminosity - black_hole - np.log10(law.accretion.eddington),
        "template": np.where(is_quasar, rows["sed_1"], templates),
    }


def _hosts(rows: _Columns, ids: Int, log_mass: Float) -> tuple[npt.NDArray[np.generic], npt.NDArray[np.generic]]:
    """Return identifiers and log10 stellar masses (Msun) of the host of each nucleus; unknown ones are masked.

    `ids` and `log_mass` belong to all galaxies.
    """
    is_quasar = rows["kind"] == QUASAR
    host = np.where(is_quasar, rows["halo_id"], rows["id"]).astype(np.int64)
    order = np.argsort(ids)
    place = order[np.minimum(np.searchsorted(ids[order], host), ids.size - 1)]
    mass = np.where(ids[place] == host, log_mass[place], np.nan) if ids.size else np.zeros(0)
    # Only quasars in halos have the mass of their halo.
    without = is_quasar & np.isnan(np.asarray(rows["log_halo_mass"], float))
    return np.ma.masked_array(host, without), _without_nan(mass)


def _without_nan(values: Float) -> npt.NDArray[np.generic]:
    return np.ma.masked_invalid(values)


def _values(table: pa.Table, name: str) -> npt.NDArray[np.generic]:
    """Return a column, with NaN for missing numbers."""
    values = table[name]
    if not values.null_count:
        return np.asarray(values.to_numpy())
    return np.asarray(pc.cast(values, pa.float64()).to_numpy(zero_copy_only=False))
