"""Checks of supernovae and active nuclei pass for correct tables and fail for the fault that they must detect."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from tests.truesky.validation.lake.catalogues.test_faults import CELLS, Version, verdicts
from truesky.validation.lake.catalogues import changing_sources
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS, UNDECIDED

GALAXIES, YEARS, BOOST = 5000, 10.0, 5.0
FACTS = {
    "start": 60000.0, "end": 60000.0 + 365.25 * YEARS, "kinds": ["ia", "core_collapse"], "boost": BOOST,
    "galaxies": "g1",
}  # fmt: skip
# 31 deg2, in which galaxies scatter by 7 %.
MANY_CELLS = np.arange(600)


def expected_number(cells):
    """Return the number of type Ia supernovae at z < 0.3.

    The comoving distance to z = 0.3 is 1197 Mpc for h = 0.7, and the mean rate 3.2e-5 per year and Mpc^3. An observer
    sees 1.23 times fewer of them per year.
    """
    volume = 4.0 / 3.0 * np.pi * 1197.0**3 * len(cells) * sky.cell_area(GENERATION_ORDER) / 41252.96
    return round(volume * 3.2e-5 / 1.23 * YEARS * BOOST)


def tables(ratio=1.0, cells=MANY_CELLS, facts=(), galaxy_facts=(), **changes):
    """Return the tables of supernovae and galaxies.

    `ratio` is the number of type Ia supernovae at z < 0.3, relative to the expected one. As many are farther away, peak
    outside the window, or are of another type.
    """
    rng, number = np.random.default_rng(7), round(ratio * expected_number(cells))
    n = 4 * number
    z, peak = 0.3 * rng.random(n) ** (1.0 / 3.0), rng.uniform(FACTS["start"], FACTS["end"], n)
    z[number : 2 * number] += 0.3
    peak[2 * number : 3 * number] += np.where(np.arange(number) % 2, 1.0, -1.0) * (FACTS["end"] - FACTS["start"])
    columns = {
        "id": np.arange(n) + 10, "host_id": rng.integers(0, GALAXIES, n), "z_true": z, "peak_mjd": peak,
        "type": np.repeat([1, 1, 1, 2], number),
    } | changes  # fmt: skip
    transients = Version("transients", columns, cells)
    galaxies = Version("galaxies", {"id": np.arange(GALAXIES)}, cells)
    transients.manifest["facts"] = FACTS | dict(facts)
    galaxies.manifest["facts"] = {"galaxy_limit": 24.5} | dict(galaxy_facts)
    galaxies.key = "g1"
    return transients, galaxies


def rate_of(*arguments, **changes):
    rows = changing_sources.supernova_rows(*tables(*arguments, **changes))
    (rate,) = (row for row in rows if row.quantity == "type_ia_rate")
    return rate


def test_correct_tables_pass():
    found = verdicts(changing_sources.supernova_rows(*tables()))
    assert found == {"supernovae_ids": PASS, "supernovae_without_host": PASS, "type_ia_rate": PASS}
    assert rate_of().value == pytest.approx(1.0, abs=0.05)
    assert rate_of().error == pytest.approx(0.4 / np.sqrt(31.5), rel=0.1)


def test_supernovae_of_unknown_galaxies_and_repeated_ones():
    n = 4 * expected_number(MANY_CELLS)
    hosts, ids = np.zeros(n, int), np.arange(n) + 10
    hosts[3], ids[5] = GALAXIES + 1, ids[4]
    found = {row.quantity: row for row in changing_sources.supernova_rows(*tables(host_id=hosts, id=ids))}
    assert found["supernovae_without_host"].value == found["supernovae_ids"].value == 1.0
    assert found["supernovae_without_host"].verdict == found["supernovae_ids"].verdict == FAIL


@pytest.mark.parametrize("ratio", [0.3, 2.0])
def test_too_few_or_too_many_supernovae(ratio):
    assert rate_of(ratio).verdict == FAIL


def test_a_boost_that_the_table_does_not_contain():
    assert rate_of(facts={"boost": 1.0}).value == pytest.approx(BOOST, rel=0.05)
    assert rate_of(facts={"boost": 1.0}).verdict == FAIL


def test_a_small_field_decides_nothing():
    assert rate_of(2.0, cells=CELLS).verdict == UNDECIDED
    assert rate_of(cells=CELLS[:1], facts={"end": FACTS["start"] + 30.0}).verdict == NOT_APPLICABLE


def test_a_lake_that_ends_at_a_smaller_redshift():
    """Supernovae are expected up to the largest redshift of the galaxies."""
    transients, galaxies = tables(galaxy_facts={"z_max": 0.2})
    (rate,) = (row for row in changing_sources.supernova_rows(transients, galaxies) if row.quantity == "type_ia_rate")
    assert "z < 0.2" in rate.note
    assert rate.value == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(
    ("facts", "galaxy_facts", "reason"),
    [
        ({}, {"galaxy_limit": 20.0}, "hosts end at 20"),
        ({}, {"galaxy_band": "lsst_r"}, "hosts end at 24.5 in lsst_r"),
        ({}, {"ingest": {}}, "your ingest"),
        ({}, {"halos": {}}, "your halos"),
        ({"kinds": ["core_collapse"]}, {}, "were not drawn"),
    ],
)
def test_lakes_without_an_expected_rate(facts, galaxy_facts, reason):
    rate = rate_of(facts=facts, galaxy_facts=galaxy_facts)
    assert rate.verdict == NOT_APPLICABLE
    assert reason in rate.note


def test_galaxies_of_another_request():
    """The last published table of supernovae may belong to another request of the lake."""
    transients, galaxies = tables()
    nuclei = Version("active_nuclei", {"id": np.arange(5)})
    galaxies.key, nuclei.manifest["facts"] = "g2", {"galaxies": "g1"}
    assert verdicts(changing_sources.supernova_rows(transients, galaxies)) == {"transients": NOT_APPLICABLE}
    assert verdicts(changing_sources.nucleus_rows(nuclei, galaxies)) == {"active_nuclei": NOT_APPLICABLE}


def test_nuclei_of_unknown_galaxies_and_repeated_ones():
    _, galaxies = tables()
    for ids, expected in ((np.arange(50), PASS), (np.array([1, 2, 2, GALAXIES]), FAIL)):
        nuclei = Version("active_nuclei", {"id": ids})
        nuclei.manifest["facts"] = {"galaxies": "g1"}
        found = verdicts(changing_sources.nucleus_rows(nuclei, galaxies))
        assert found == {"nuclei_ids": expected, "nuclei_without_host": expected}


def test_empty_tables():
    empty = {name: np.zeros(0) for name in ("id", "host_id", "type", "z_true", "peak_mjd")}
    found = verdicts(changing_sources.supernova_rows(*tables(**empty)))
    assert found == {"supernovae_ids": PASS, "supernovae_without_host": PASS, "type_ia_rate": FAIL}
