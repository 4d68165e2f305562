"""Galaxies leave in the forms of other programs, and what leaves as skyCatalogs comes back through the ingest."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from astropy.table import Table

from lake_schema import sky
from lake_schema.store import publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue.exports import fits_files, skycatalogs
from truesky.catalogue.external import mapping, reading
from truesky.commands import __main__ as truesky
from truesky.cosmology import FIDUCIAL

CELL = 8989


@pytest.fixture
def lake(tmp_path):
    """Made up: 50 galaxies of one cell, and fluxes in LSST r."""
    rng = np.random.default_rng(4)
    index, ra, dec = sky.random_in_cell(5, CELL, 50, rng)
    values = {c.name: rng.uniform(max(c.lo or 0.0, -20.0), min(c.hi or 1.0, 5.0), 50) for c in GALAXIES.columns}
    values |= {name: np.zeros(50, int) for name in ("kind", "sed_1", "sed_2", "ext_law_1", "ext_law_2", "stamp")}
    values |= {"id": np.arange(50), "halo_id": np.arange(50), "origin_id": np.arange(50)}
    values |= {"ra": ra, "dec": dec, "ra_true": ra, "dec_true": dec, "_healpix_29": index}
    values |= {name: rng.uniform(-0.1, 0.1, 50) for name in ("kappa", "gamma1", "gamma2")}
    values["position_angle"] = rng.uniform(0, 180, 50)
    part = Task(f"Norder=5/Dir=0/Npix={CELL}.parquet", {})
    plan = Plan(GALAXIES, {}, (part,))
    publish.make_version(tmp_path, plan, lambda root, facts: Output(GALAXIES.build(values)))
    table = fluxes("galaxy", ["lsst_r"])
    light = {c.name: values[c.name] for c in table.columns if c.name in values} | {
        "f_nu_lsst_r": np.full(50, 3.631),
        "integrated": np.zeros(50, bool),
    }
    made = Plan(table, {"input": plan.key}, (part,))
    publish.make_version(tmp_path, made, lambda root, facts: Output(table.build(light)))
    return tmp_path


def test_fits_tables_have_units_and_ucds(lake, tmp_path):
    (path,) = fits_files.write(lake, GALAXIES, tmp_path / "out")
    assert path.name == f"galaxies_nside32_nest_{CELL}.fits"
    found, rows = Table.read(path), read.version(lake, "galaxies").rows()
    assert found.colnames == GALAXIES.names
    assert found["disk_half_light_radius"].unit == "arcsec"
    assert found.meta["TUCD3"] == GALAXIES.columns[2].ucd
    assert np.array_equal(found["ra"], rows["ra"].to_numpy())
    assert np.array_equal(found["id"], rows["id"].to_numpy())


def test_a_skycatalogs_set_comes_back_through_its_mapping(lake, tmp_path):
    written = skycatalogs.write(lake, tmp_path / "out")
    pixel = sky.ring_index(5, CELL)
    assert [path.name for path in written] == [
        f"galaxy_{pixel}.parquet",
        f"galaxy_flux_{pixel}.parquet",
        "skyCatalog.yaml",
    ]
    (piece,) = reading.read(written[:1], mapping.galaxy_columns("skycatalogs", {}, FIDUCIAL))
    rows = read.version(lake, "galaxies").rows()
    for name in ("gamma1", "gamma2", "kappa", "a_v", "z_true", "disk_axis_ratio", "bulge_half_light_radius"):
        assert piece.values[name] == pytest.approx(rows[name].to_numpy(), rel=1e-5), name
    assert piece.values["position_angle"] % 180 == pytest.approx(rows["position_angle"].to_numpy(), abs=1e-3)
    # 3.631 microjansky is AB magnitude 22.5.
    assert piece.values["mag"] == pytest.approx(22.5, abs=2e-3)
    assert pq.read_table(written[1]).column_names == ["galaxy_id", "lsst_flux_r"]


def test_fluxes_of_other_galaxies_are_refused(lake, tmp_path, capsys):
    table = fluxes("galaxy", ["lsst_r"])
    rows = read.version(lake, "galaxy_fluxes").rows()
    part = Task(f"Norder=5/Dir=0/Npix={CELL}.parquet", {})
    publish.make_version(lake, Plan(table, {"input": "other"}, (part,)), lambda root, facts: Output(rows))
    arguments = ["export", "galaxies", str(lake), "--out", str(tmp_path / "out"), "--form", "skycatalogs"]
    assert truesky.main(arguments) == 2
    assert "run truesky fluxes first" in capsys.readouterr().err
