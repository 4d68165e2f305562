"""Spectra of the nearest observed galaxy, tested against a brute-force search and in a complete draw."""

import dataclasses

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lake_schema.errors import BadInput
from lake_schema.store import publish, read, validate
from lake_schema.tables.galaxies import GALAXIES
from tests import requests
from truesky.catalogue import build_galaxies
from truesky.catalogue.external import mapping
from truesky.catalogue.galaxies import galaxies, nearest_sed
from truesky.cosmology import FIDUCIAL
from truesky.request.from_toml import parse
from truesky.request.schema import Universe

KEYS = ("z_true", "abs_mag_r01", "color_gr_01", "sed", "ext_law", "ebv")


def observed(number=400, seed=4):
    """Made up: no real galaxies."""
    rng = np.random.default_rng(seed)
    law = rng.integers(0, 5, number)
    return {
        "z_true": rng.uniform(0.0, 2.3, number),
        "abs_mag_r01": rng.uniform(-23.0, -14.0, number),
        "color_gr_01": rng.uniform(-0.2, 1.02, number),
        "sed": rng.uniform(0.0, 30.0, number),
        "ext_law": law,
        "ebv": np.where(law > 0, rng.uniform(0.0, 0.7, number), 0.0),
    }


@pytest.fixture
def given():
    return nearest_sed.build_training(observed(), 30)


def wanted(rng, n=300):
    return rng.uniform(-0.2, 1.0, n), rng.uniform(-22.0, -15.0, n), rng.uniform(0.0, 2.2, n)


def test_the_nearest_is_that_of_a_search_through_all(given, rng):
    colour, m_r, z = wanted(rng)
    exact = dataclasses.replace(given, law=dataclasses.replace(given.law, index=0.0, ebv=0.0))
    found, theirs = nearest_sed.assign(exact, colour, m_r, z, rng), observed()
    apart = np.abs(colour[:, None] - theirs["color_gr_01"]) / 0.05
    apart += np.abs(m_r[:, None] - theirs["abs_mag_r01"]) / 0.3 + np.abs(z[:, None] - theirs["z_true"]) / 0.1
    best = apart.argmin(1)
    index = found.template_1 * found.frac_1 + found.template_2 * found.frac_2
    assert index == pytest.approx(theirs["sed"][best], abs=1e-12)
    assert np.array_equal(found.law, theirs["ext_law"][best])
    assert np.array_equal(found.ebv, theirs["ebv"][best])


def test_the_scatter_is_as_stated_and_stays_in_the_library(given, rng):
    n = 20_000
    theirs = {name: np.full(1, value) for name, value in zip(KEYS, (0.5, -20.0, 0.5, 12.3, 2, 0.2), strict=True)}
    one = nearest_sed.build_training({**theirs, "ebv": np.array([0.3])}, 30)
    found = nearest_sed.assign(one, np.zeros(n), np.full(n, -20.0), np.full(n, 0.5), rng)
    index = found.template_1 * found.frac_1 + found.template_2 * found.frac_2
    assert np.mean(index) == pytest.approx(12.3, abs=0.02)
    assert np.std(index) == pytest.approx(0.5, rel=0.03)
    # Nothing is dustier than the training table.
    assert found.ebv.max() == 0.3
    assert np.median(found.ebv[found.ebv < 0.3]) == pytest.approx(0.3 - 0.6745 * 0.02, abs=1e-3)
    ends = nearest_sed.assign(given, *wanted(rng, 2000), rng)
    assert ends.template_1.min() >= 1
    assert ends.template_1.max() <= 30
    assert np.all((ends.frac_1 >= 0) & (ends.frac_1 <= 1) & (ends.frac_2 >= 0) & (ends.frac_2 <= 1))
    assert np.all(ends.ebv[ends.law == 0] == 0)


def test_galaxies_are_drawn_with_these_spectra(universe, cells, dust, given):
    """Spectra from a training table are in the library and in the table's bounds; the number of galaxies is usual."""
    there = dataclasses.replace(universe, training=given)
    rows = galaxies.draw(303_117, there, cells, dust)
    assert validate.find_violations(rows, GALAXIES) == []
    again = galaxies.draw(303_117, there, cells, dust)
    assert rows.equals(again)
    theirs = set(observed()["ext_law"].tolist())
    assert set(np.unique(rows["ext_law_1"].to_numpy()).tolist()) == theirs
    assert 5_000 < rows.num_rows < 40_000


@pytest.mark.nightly
def test_a_request_with_a_training_table(tmp_path):
    """Its galaxies have other spectra than without."""
    pq.write_table(pa.table(observed()), tmp_path / "synthetic.parquet")
    columns = "".join(f'{key} = "{key}"\n' for key in KEYS)
    theirs = f'[ingest.training]\nfiles = ["synthetic.parquet"]\n[ingest.training.columns]\n{columns}'
    more = 'galaxy_band = "euclid_h"\nhigh_redshift_boost = 0.0\nquasar_boost = 0.0\n'
    found = []
    for name, own in (("with", theirs), ("without", "")):
        text = requests.shallow(20.0, 18.0, more) + own
        path = requests.written(tmp_path, text, requests.FIELD.format(0.05), name)
        for step in build_galaxies.steps(tmp_path / name, parse(path)):
            publish.make_version(tmp_path / name, step.plan, step.run_task)
        found.append(read.version(tmp_path / name, "galaxies"))
    with_table, without = (version.rows() for version in found)
    assert found[0].manifest["facts"]["training"]["columns"] == {key: f'"{key}"' for key in KEYS}
    assert validate.find_violations(with_table, GALAXIES) == []
    assert with_table.num_rows > 20
    assert not with_table["ebv_1"].equals(without["ebv_1"])


def test_dustier_galaxies_are_searched_for_as_deep_as_they_can_be_seen(given):
    """E(B-V) beyond the embedded universe's: the tables reach as far, and so do the halos."""
    wanted = Universe(galaxy_limit=22.0, galaxy_band="euclid_h", box_cells=192)
    deep = galaxies.halos_and_galaxies(7, wanted, training=given)
    usual = galaxies.halos_and_galaxies(7, wanted)
    assert given.dustiest > 0.6
    assert np.all(deep.halos.limit <= usual.halos.limit + 1e-9)
    assert np.any(deep.halos.limit < usual.halos.limit - 0.01)


def test_an_unknown_template_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(nearest_sed, "cached_arrays", lambda name, key, make: make())
    values = observed(20)
    values["sed"][4] = 30.5
    path = tmp_path / "synthetic.parquet"
    pq.write_table(pa.table(values), path)
    columns = mapping.training_columns({key: f'"{key}"' for key in KEYS}, FIDUCIAL)
    with pytest.raises(BadInput, match=r"synthetic\.parquet: column sed of row 5 is 30\.5, but must be from 0 to 30"):
        nearest_sed.load([path], ["x"], columns)
    with pytest.raises(BadInput, match=r"ingest\.training\.columns must have ebv"):
        mapping.training_columns({key: f'"{key}"' for key in KEYS[:-1]}, FIDUCIAL)
