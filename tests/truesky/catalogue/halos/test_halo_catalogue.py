"""The user's halo light-cone replaces the drawn halos: a synthetic one, and refused ones."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.table import Table

from lake_schema import ids, sky
from lake_schema.errors import BadInput, LakeError
from lake_schema.store.provenance import file_sha256
from tests.truesky.catalogue.conftest import BOX_CELLS, SEED
from truesky.catalogue.external import mapping
from truesky.catalogue.galaxies import galaxies
from truesky.catalogue.halos import halo_catalogue, population
from truesky.cosmology import FIDUCIAL
from truesky.request.schema import Universe

CELL = 303_117
COLUMNS = {
    "origin_id": '"halo_id"',
    "ra": '{"column": "ra", "unit": "deg"}',
    "dec": '{"column": "dec", "unit": "deg"}',
    "z_true": '"z"',
    "z_obs": '"z_seen"',
    "log_mass": '{"column": "mass", "log10": true, "unit": "Msun/h"}',
}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(
        halo_catalogue, "cached_arrays", lambda name, key, make: {k: np.asarray(v) for k, v in make().items()}
    )


def synthetic(number=2000):
    """Return synthetic massive halos in one generation cell and its surroundings."""
    rng = np.random.default_rng(8)
    _, ra, dec = sky.random_in_cell(6, CELL >> 4, number, rng)
    z = rng.uniform(0.1, 1.5, number)
    return {
        "halo_id": rng.permutation(number) + 5,
        "ra": ra,
        "dec": dec,
        "z": z,
        "z_seen": z + rng.normal(0, 1e-3, number),
        "mass": 10.0 ** rng.uniform(12.5, 14.5, number),
    }


def write(path, values):
    if path.suffix == ".parquet":
        pq.write_table(pa.table(values), path)
    else:
        Table(values).write(path)
    return path


def loaded(path, columns=COLUMNS):
    return halo_catalogue.load([path], [file_sha256(path)], mapping.halo_columns(columns, FIDUCIAL))


@pytest.mark.parametrize("ending", ["parquet", "fits", "csv"])
def test_the_halos_of_a_cell_are_those_of_the_file(tmp_path, ending):
    values = synthetic()
    cone = loaded(write(tmp_path / f"synthetic.{ending}", values))
    universe = galaxies.halos_and_galaxies(SEED, Universe(galaxy_limit=24.5, box_cells=BOX_CELLS), cone)
    rows = galaxies.halo_table(CELL, universe, population.CellCache(universe))
    inside = sky.cell_at(values["ra"], values["dec"], ids.GENERATION_ORDER) == CELL
    bright = inside & (np.log10(values["mass"]) > universe.halos.mass_limit(FIDUCIAL.comoving_distance(values["z"])))
    there = universe.halos.mass_limit(FIDUCIAL.comoving_distance(rows["z_true"].to_numpy().astype(float)))
    found = rows.filter(pa.array(rows["log_mass"].to_numpy() > there))
    assert found.num_rows == bright.sum() > 50
    assert np.sort(found["log_mass"].to_numpy()) == pytest.approx(np.sort(np.log10(values["mass"][bright])), abs=1e-5)
    assert np.sort(found["z_obs"].to_numpy()) == pytest.approx(np.sort(values["z_seen"][bright]), abs=1e-5)


def test_galaxies_live_in_them_and_none_is_lost_between_cells(tmp_path):
    cone = loaded(write(tmp_path / "synthetic.parquet", synthetic()))
    universe = galaxies.halos_and_galaxies(SEED, Universe(galaxy_limit=24.5, box_cells=BOX_CELLS), cone)
    cells = population.CellCache(universe)
    parts = [population.members(cells, cell) for cell in range(CELL >> 4 << 4, (CELL >> 4 << 4) + 16)]
    own, host = (np.concatenate([getattr(part, name) for part in parts]) for name in ("id", "halo_id"))
    known = np.concatenate([part.halos.id for part in parts])
    assert np.unique(own).size == own.size > known.size
    # There are no halos of the file outside these cells.
    assert np.isin(host, known).all()


def broken(key, row, value):
    values = synthetic(100)
    values[key][row] = value
    return values


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (broken("ra", 4, np.nan), r"column ra of row 5 is NaN"),
        (broken("mass", 9, 1e13 / 1e10), r"column mass \(log_mass\) of row 10 is 3, but must be from 8 to 16.5"),
        (broken("z", 0, -0.1), r"column z \(z_true\) of row 1 is -0.1"),
        (broken("halo_id", 7, synthetic(100)["halo_id"][2]), r"column halo_id of row 8 is \d+, as in row 3 of"),
        ({name: v for name, v in synthetic(100).items() if name != "mass"}, "has no column mass; it has halo_id"),
    ],
)
def test_a_wrong_halo_is_named(tmp_path, values, said):
    with pytest.raises(BadInput, match=said):
        loaded(write(tmp_path / "synthetic.parquet", values))


def test_a_file_in_other_units(tmp_path):
    table = Table(synthetic(100))
    table["mass"].unit = "kg"
    table.write(tmp_path / "synthetic.fits")
    with pytest.raises(BadInput, match=r"column mass \(log_mass\) has unit 'kg', but the mapping has 'Msun/h'"):
        loaded(tmp_path / "synthetic.fits")
    # The column contains a logarithm instead of the mass.
    values = synthetic(100)
    values["mass"] = np.log10(values["mass"])
    with pytest.raises(BadInput, match=r"column mass \(log_mass\) of row 1 is 1\.\d+, but must be"):
        loaded(write(tmp_path / "logarithm.parquet", values))


@pytest.mark.parametrize("ending", ["parquet", "fits"])
def test_a_file_that_is_cut_short(tmp_path, ending):
    path = write(tmp_path / f"synthetic.{ending}", synthetic())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(LakeError, match=f"synthetic.{ending}"):
        loaded(path)
