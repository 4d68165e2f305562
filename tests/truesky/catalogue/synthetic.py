"""Synthetic catalogues in external formats: a few hundred galaxies each, without real data."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from astropy.table import Table

from truesky.catalogue.external import mapping
from truesky.fluxes.spectra.lines import columns as columns_of_lines

RA, DEC = 53.1, -27.8


def columns(number=300, seed=3):
    """Return values by our keys."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.05, 2.2, number)
    return {
        "origin_id": 10_000_000_000_000_000 + rng.permutation(number).astype(np.int64),
        "halo": rng.integers(0, number // 3, number) + 7,
        "kind": rng.integers(0, 2, number),
        "ra": RA + rng.uniform(-0.1, 0.1, number),
        "dec": DEC + rng.uniform(-0.1, 0.1, number),
        "ra_lensed": RA + rng.uniform(-0.1, 0.1, number),
        "dec_lensed": DEC + rng.uniform(-0.1, 0.1, number),
        "z_true": z,
        "z_obs": z + rng.normal(0.0, 1e-3, number),
        "abs_mag_r01": rng.uniform(-22, -16, number),
        "mag_r01": rng.uniform(18, 26, number),
        "mag": 22.0 + 5.0 * np.log10(z) + rng.uniform(-1.0, 2.0, number),
        "color_gr_01": rng.uniform(0.2, 1.0, number),
        "log_halo_mass": rng.uniform(11, 14, number),
        "log_stellar_mass": rng.uniform(8, 11, number),
        "log_sfr": rng.uniform(-2, 2, number),
        "sed": rng.uniform(0, 30, number),
        "ext_law": rng.integers(0, 5, number),
        "ebv": rng.uniform(0, 0.5, number),
        **{f"{name}_{k}": values for k in "12" for name, values in _component(rng, number).items()},
        **{f"flux_{line}": 10.0 ** rng.uniform(-18, -16, number) for line in LINES},
        "bulge_half_light_radius": rng.uniform(0.1, 1, number),
        "disk_half_light_radius": rng.uniform(0.1, 1, number),
        "bulge_fraction": rng.uniform(0, 1, number),
        "bulge_sersic_index": rng.uniform(0.5, 4, number),
        "bulge_axis_ratio": rng.uniform(0.3, 1, number),
        "disk_axis_ratio": rng.uniform(0.3, 1, number),
        "inclination": rng.uniform(0, 90, number),
        "position_angle": rng.uniform(0, 180, number),
        "kappa": rng.normal(0, 0.02, number),
        "gamma1": rng.normal(0, 0.02, number),
        "gamma2": rng.normal(0, 0.02, number),
        "a_v": rng.uniform(0.02, 0.1, number),
    }


LINES = tuple(column.removeprefix("flux_") for column in columns_of_lines())


def _component(rng, number):
    return {
        "sed": rng.integers(0, 31, number),
        "frac": np.full(number, 0.5),
        "ext_law": rng.integers(0, 5, number),
        "ebv": rng.uniform(0, 0.5, number),
    }


def theirs(form, values):
    """Apply the mapping of a format backwards; return the columns of the main file and of the companion file."""
    tables = {}, {}
    for key, entry in mapping.formats()[form]["columns"].items():
        entry = {"column": entry} if isinstance(entry, str) else entry
        given = values[key]
        if key.startswith("flux_") and mapping.formats()[form].get("lines_magnified"):
            given = given / ((1.0 - values["kappa"]) ** 2 - values["gamma1"] ** 2 - values["gamma2"] ** 2)
        if "over" in entry:
            given = given * tables[0][entry["over"]]
        elif set(entry) - {"column", "unit", "beside"}:
            given = (given - entry.get("offset", 0.0)) / entry.get("scale", 1.0)
            given = np.log10(given) if entry.get("power10") else given
            given = 10.0**given if entry.get("log10") else given
        tables[bool(entry.get("beside"))].setdefault(entry["column"], given)
    return tables


def write(folder, form, values=None):
    """Write a file of a format (with its companion file) that is marked as synthetic."""
    main, beside = theirs(form, columns() if values is None else values)
    about = {"comment": "synthetic fixture: no real galaxies"}
    if form == "euclid":
        path = folder / "synthetic.fits"
        Table(main, meta={"COMMENT": about["comment"]}).write(path)
        return path
    path = folder / ("galaxy_1.parquet" if beside else "synthetic.parquet")
    pq.write_table(pa.table(main).replace_schema_metadata(about), path)
    if beside:
        identifier = {"galaxy_id": main["galaxy_id"]}
        pq.write_table(pa.table({**identifier, **beside}), folder / "galaxy_flux_1.parquet")
    return path
