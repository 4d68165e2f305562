"""Tests of the rows of table `active_nuclei`, of narrow lines in table `galaxies`, and of requests without them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.store import validate
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.variability.active_nuclei import ACTIVE_NUCLEI
from tests.truesky.catalogue.conftest import BOX_CELLS, SEED
from tests.truesky.catalogue.nuclei.test_narrow_lines import above_kewley
from truesky.catalogue import dust_map
from truesky.catalogue.galaxies import galaxies, high_redshift
from truesky.catalogue.halos import population
from truesky.catalogue.nuclei import accretion, rows
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import high_redshift as quasar_fluxes
from truesky.fluxes import passbands
from truesky.fluxes.high_redshift import HUBBLE
from truesky.request.schema import Universe
from truesky.variability import active_nuclei, nuclear_luminosity

CELL = 303_117
LAWS = accretion.laws()


@cache
def drawn(limit=22.5, z_max=2.5, variables=True):
    """Draw the galaxies of one cell, 0.05 deg2, with 5 times as many quasars."""
    wanted = Universe(
        galaxy_limit=limit, z_max=z_max, quasar_boost=5.0, variables=variables, lensing=(0.02, -0.01),
        box_cells=BOX_CELLS,
    )  # fmt: skip
    universe = galaxies.model(SEED, wanted)
    return galaxies.draw(CELL, universe, population.CellCache(universe.population), dust_map.load(SEED))


@cache
def nuclei(limit=22.5, z_max=2.5):
    return rows.draw(drawn(limit, z_max), SEED, LAWS, FIDUCIAL)


def values(table, name):
    return table[name].to_numpy(zero_copy_only=False).astype(float)


def test_rows_are_valid_and_of_both_kinds():
    table = nuclei()
    assert validate.find_violations(table, ACTIVE_NUCLEI) == []
    assert validate.find_violations(drawn(), GALAXIES) == []
    kind, kind_type = table["kind"].to_numpy(), table["type"].to_numpy()
    assert np.sum(kind == 2) > 20
    assert np.sum((kind < 2) & (kind_type == 1)) > 50
    assert np.sum(kind_type == 2) > 100
    assert np.isin(table["id"].to_numpy(), drawn()["id"].to_numpy()).all()


def test_each_quasar_is_a_row_with_a_host():
    table = nuclei().filter(pa.array(nuclei()["kind"].to_numpy() == 2))
    quasars = drawn().filter(pa.array(drawn()["kind"].to_numpy() == 2))
    assert table["id"].equals(quasars["id"])
    assert table["host_id"].null_count == 0
    assert values(table, "m_1450") == pytest.approx(values(quasars, "abs_mag_r01") + 5.0 * np.log10(HUBBLE), abs=1e-5)
    assert values(table, "mag_1450") == pytest.approx(values(quasars, "mag_r01"), abs=1e-4)
    # Hosts in the table are at the position and redshift of the quasar.
    place = {identifier: row for row, identifier in enumerate(drawn()["id"].to_pylist())}
    seen = [(row, place[host]) for row, host in enumerate(table["host_id"].to_pylist()) if host in place]
    assert len(seen) > 1
    for row, host in seen:
        for name in ("ra", "dec", "z_true", "z_obs", "log_halo_mass", "kappa"):
            assert values(table, name)[row] == pytest.approx(values(drawn(), name)[host], abs=1e-9), name
        assert table["log_stellar_mass"][row].as_py() == drawn()["log_stellar_mass"][host].as_py()


def test_fluxes_of_quasars_are_those_of_galaxies():
    is_quasar = nuclei()["kind"].to_numpy() == 2
    table = {name: values(nuclei(), name)[is_quasar] for name in active_nuclei.FLUX_COLUMNS if name != "id"}
    table |= {"id": nuclei()["id"].to_numpy()[is_quasar], "template": table["template"].astype(np.int64)}
    quasars = drawn().filter(pa.array(drawn()["kind"].to_numpy() == 2))
    band = passbands.load("lsst_i")
    assert active_nuclei.mean_fluxes(table, [band]) == pytest.approx(quasar_fluxes.fluxes(quasars, [band]), rel=1e-4)


def test_a_shallower_request_has_fewer_of_the_same():
    few, many = nuclei(21.0, 2.0), nuclei()
    again = many.filter(pa.array(np.isin(many["id"].to_numpy(), few["id"].to_numpy())))
    # The host of a quasar may be too faint for the shallower table.
    names = [name for name in few.column_names if name != "log_stellar_mass"]
    assert 20 < few.num_rows < many.num_rows
    assert few.select(names).equals(again.select(names))


def test_lines_of_active_galaxies_only_are_brighter():
    """The rest of the table is bit by bit that of a request without variable sources."""
    plain, table = drawn(variables=False), drawn()
    plain, table = (part.filter(pa.array(part["kind"].to_numpy() < 2)) for part in (plain, table))
    table = table.filter(pa.array(np.isin(table["id"].to_numpy(), plain["id"].to_numpy())))
    assert table["id"].equals(plain["id"])
    active = np.isin(table["id"].to_numpy(), nuclei()["id"].to_numpy())
    lines = [name for name in table.column_names if name.startswith("flux_")]
    for name in table.column_names:
        if name not in lines:
            assert table[name].equals(plain[name]), name
    for name in lines:
        brighter = values(table, name) > values(plain, name)
        assert np.mean(brighter[active]) > 0.9
        assert not brighter[~active].any()


@cache
def drawn_without_lensing(limit, z_max, cells):
    """Draw the galaxies of cells next to each other."""
    wanted = Universe(
        galaxy_limit=limit, z_max=z_max, quasar_boost=0.0, high_redshift_boost=0.0, variables=True,
        lensing=(0.0, 0.0), box_cells=BOX_CELLS,
    )  # fmt: skip
    universe = galaxies.model(SEED, wanted)
    cache_of_cells = population.CellCache(universe.population)
    parts = [galaxies.draw(cell, universe, cache_of_cells, dust_map.load(SEED)) for cell in range(cells)]
    return pa.concat_tables(parts)


@pytest.mark.parametrize(
    ("cells", "limits"), [(20, (0.03, 0.25)), pytest.param(150, (0.05, 0.15), marks=pytest.mark.nightly)]
)
def test_the_share_above_the_line_of_kewley(cells, limits):
    """5 to 15 % of emitters at z < 0.25 with H alpha above 1e-16 erg s-1 cm-2, in galaxies of I_E < 18,
    as bright as those of SDSS, of which Kewley et al. 2006 find 10 %.

    Sample: 150 cells, 7.9 deg2, 945 emitters with a share of 10.5 %. Significance: its standard deviation is 1 %, so
    that the limits are 4.5 of them away. The short test has 1 deg2 and wider limits.
    """
    table = drawn_without_lensing(18.0, 0.25, cells)
    selected = values(table, "flux_halpha") > 1e-16
    names = ("flux_nii", "flux_halpha", "flux_oiii", "flux_hbeta")
    share = above_kewley({name: values(table, name)[selected] for name in names})
    assert share.size > 4 * cells
    assert limits[0] < share.mean() < limits[1]


def test_the_visible_nuclei_meet_the_quasars():
    """Expected number of type 1 nuclei with -22.5 < M_1450 < -21.5 at 0.4 < z < 1, relative to that of quasars.

    Sample: galaxies of 12 cells, with 100 draws of nuclei each. Significance: the ratio is 0.8, with an error of 10 %
    by the clustering of galaxies.
    """
    table = drawn_without_lensing(22.5, 1.0, 12)
    z, mass = values(table, "z_true"), values(table, "log_stellar_mass")
    selected, law = (z > 0.4) & (mass > 9.5), replace(LAWS, faintest_quasar=-99.0)
    number, source = 0, table["id"].to_numpy()[selected]
    for seed in range(100):
        found = accretion.draw(law, source, seed, z[selected], mass[selected])
        magnitude = nuclear_luminosity.ultraviolet_magnitude(found.log_luminosity)
        number += int(np.sum((found.type == accretion.TYPE_1) & (np.abs(magnitude + 22.0) < 0.5)))
    (quasars,) = high_redshift.model(FIDUCIAL, 0.0, 1.0)
    steps, m = np.arange(0.41, 1.0, 0.02), np.arange(-22.49, -21.5, 0.02)
    volume = FIDUCIAL.comoving_volume(steps - 0.01, steps + 0.01) * np.radians(1.0) ** 2 / HUBBLE**3 * 0.05245 * 12
    expected = np.sum(high_redshift.density(2, quasars.numbers, m, steps[:, None]) * 0.02 * volume[:, None])
    assert 0.55 < number / 100.0 / float(expected) < 1.3
