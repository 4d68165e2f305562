"""Checks of supernovae and active nuclei pass for correct tables and fail for the fault that they must detect."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from tests.truesky.validation.lake.catalogues.test_faults import CELLS, Version, verdicts
from truesky.validation.lake.catalogues import changing_sources
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS

GALAXIES, YEARS = 5000, 10.0
FACTS = {"start": 60000.0, "end": 60000.0 + 365.25 * YEARS, "kinds": ["ia", "core_collapse"], "boost": 1.0}
# Type Ia supernovae at z < 0.3: the comoving distance to z = 0.3 is 1197 Mpc for h = 0.7, and the mean rate 3.2e-5 per
# year and Mpc^3. An observer sees 1.23 times fewer of them per year.
VOLUME = 4.0 / 3.0 * np.pi * 1197.0**3 * len(CELLS) * sky.cell_area(GENERATION_ORDER) / 41252.96
NUMBER = round(VOLUME * 3.2e-5 / 1.23 * YEARS)


def tables(number=NUMBER, galaxy_limit=24.5, **changes):
    """Return the tables of supernovae and galaxies, with `number` type Ia supernovae at z < 0.3."""
    rng = np.random.default_rng(7)
    n = number + 300
    columns = {
        "id": np.arange(n) + 10, "host_id": rng.integers(0, GALAXIES, n), "type": np.append(np.ones(number), [2] * 300),
        "z_true": 0.3 * rng.random(n) ** (1.0 / 3.0), "peak_mjd": rng.uniform(FACTS["start"], FACTS["end"], n),
    } | changes  # fmt: skip
    transients, galaxies = Version("transients", columns), Version("galaxies", {"id": np.arange(GALAXIES)})
    transients.manifest["facts"] = FACTS
    galaxies.manifest["facts"] = {"galaxy_limit": galaxy_limit}
    return transients, galaxies


def test_correct_tables_pass():
    found = verdicts(changing_sources.supernova_rows(*tables()))
    assert found["supernovae_ids"] == found["supernovae_without_host"] == PASS
    (rate,) = (row for row in changing_sources.supernova_rows(*tables()) if row.quantity == "type_ia_rate")
    assert rate.value == pytest.approx(1.0, abs=0.05)
    assert rate.error == pytest.approx(0.53, abs=0.1)
    assert rate.verdict != FAIL


def test_supernovae_of_unknown_galaxies_and_repeated_ones():
    n = NUMBER + 300
    hosts, ids = np.zeros(n, int), np.arange(n) + 10
    hosts[3], ids[5] = GALAXIES + 1, ids[4]
    found = {row.quantity: row for row in changing_sources.supernova_rows(*tables(host_id=hosts, id=ids))}
    assert found["supernovae_without_host"].value == found["supernovae_ids"].value == 1.0
    assert found["supernovae_without_host"].verdict == found["supernovae_ids"].verdict == FAIL


def test_ten_times_too_many_supernovae():
    """As if a boost of the rate were not divided out."""
    assert verdicts(changing_sources.supernova_rows(*tables(10 * NUMBER)))["type_ia_rate"] == FAIL


def test_lakes_without_the_numbers_of_the_rate():
    transients, galaxies = tables(galaxy_limit=20.0)
    assert verdicts(changing_sources.supernova_rows(transients, galaxies))["type_ia_rate"] == NOT_APPLICABLE
    transients, galaxies = tables()
    transients.manifest["facts"] = FACTS | {"kinds": ["core_collapse"]}
    assert verdicts(changing_sources.supernova_rows(transients, galaxies))["type_ia_rate"] == NOT_APPLICABLE


def test_nuclei_of_unknown_galaxies_and_repeated_ones():
    galaxies = Version("galaxies", {"id": np.arange(GALAXIES)})
    good = changing_sources.nucleus_rows(Version("active_nuclei", {"id": np.arange(50)}), galaxies)
    assert verdicts(good) == {"nuclei_ids": PASS, "nuclei_without_host": PASS}
    faulty = changing_sources.nucleus_rows(Version("active_nuclei", {"id": np.array([1, 2, 2, GALAXIES])}), galaxies)
    assert verdicts(faulty) == {"nuclei_ids": FAIL, "nuclei_without_host": FAIL}


def test_empty_tables():
    empty = {name: np.zeros(0) for name in ("id", "host_id", "type", "z_true", "peak_mjd")}
    transients, galaxies = tables(**empty)
    found = verdicts(changing_sources.supernova_rows(transients, galaxies))
    assert found["supernovae_ids"] == found["supernovae_without_host"] == PASS
