"""Stored columns hold the rows of the table in its order, are filled once, and are never mixed if rows change order."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.explore import columns
from truesky.explore.columns import Selection, load
from truesky.explore.process import Process
from truesky.numerics import cache

KEYS = ("id",)


@pytest.fixture(scope="module")
def process(explored):
    tables = [f"{name}={read.version(explored, name).key}" for name in ("galaxies", "galaxy_fluxes", "plain")]
    process = Process(explored, tables, 1e9)
    yield process
    process.close()


@pytest.fixture
def ask(process, monkeypatch, tmp_path):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path))
    asked = []

    def ask(text, expressions):
        asked.append(text)
        return process.batches(text, expressions=expressions)

    ask.asked = asked
    return ask


def test_rows_of_a_table(ask, explored, galaxies):
    where = Selection("k", "galaxies", keys=KEYS)
    stored = read.version(explored, "galaxies").rows(["z_obs", "flux_halpha"])
    for _ in range(2):
        z, line, ratio = load(where, ["z_obs", "flux_halpha", "z_obs / z_obs -- a note"], ask)
    assert len(ask.asked) == 3
    np.testing.assert_array_equal(z, stored["z_obs"].to_numpy())
    expected = np.array([np.nan if x is None else x for x in stored["flux_halpha"].to_pylist()], np.float32)
    np.testing.assert_array_equal(line, expected)
    assert np.nanmax(ratio) == 1.0


def test_sample_and_condition(ask):
    whole = load(Selection("k", "galaxies", keys=KEYS), ["z_obs"], ask)[0]
    (some,) = load(Selection("k", "galaxies", keys=KEYS, part=8), ["z_obs"], ask)
    assert 0 < len(some) < len(whole) / 4
    (near,) = load(Selection("k", "galaxies", "z_obs < 1", KEYS), ["z_obs"], ask)
    np.testing.assert_array_equal(near, whole[whole < 1])


def test_a_join_is_one_query(ask):
    source = "galaxies JOIN galaxy_fluxes USING (id)"
    z, flux = load(Selection("k", source), ["z_obs", "f_nu_euclid_vis"], ask)
    assert len(ask.asked) == 1
    assert len(z) == len(flux)


def test_rows_in_another_order_are_not_mixed(monkeypatch, tmp_path):
    """The mock engine returns the rows of each query in a different order."""
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path))
    asked = []

    def ask(text, expressions):
        order = np.roll(np.arange(50), len(asked))
        asked.append(text)
        names = [expression for expression in expressions[:-1]]
        found = {name: (order * (10.0 if name == "b" else 1.0)).astype(np.float32) for name in names}
        yield pa.RecordBatch.from_pydict({**found, "own": (order + 1).astype(np.uint64)})

    a, b = load(Selection("other", "t", keys=KEYS), ["a", "b"], ask)
    np.testing.assert_array_equal(b, a * 10.0)
    assert len(asked) == 3


@pytest.mark.parametrize("text", [
    "z_obs) FROM galaxies --", "z_obs), (1", "z_obs) LIMIT (3", "z_obs) ORDER BY (1", "1) UNION SELECT (2", "",
    "z_obs) AS x, (1", "SELECT 1; SELECT 2", "read_text('/etc/passwd')", "z_obs) WHERE (true", "getenv('HOME')",
])  # fmt: skip
def test_only_single_expressions_are_accepted(ask, text):
    for selection, wanted in (
        (Selection("k", "galaxies", keys=KEYS), [text]),
        (Selection("k", "galaxies", text), ["1"]),
    ):
        with pytest.raises(BadInput, match=r"^SQL: "):
            load(selection, wanted, ask)


def test_oldest_columns_are_removed_first(ask):
    for text in ("1", "2", "3"):
        load(Selection("k", "galaxies", keys=KEYS), [text], ask)
    size = sum(file.stat().st_size for file in cache.cache_dir().rglob("*") if file.is_file())
    assert columns.trim(size) == 0
    assert columns.trim(size * 0.7) == 1
    load(Selection("k", "galaxies", keys=KEYS), ["3"], ask)
    assert len(ask.asked) == 3
    load(Selection("k", "galaxies", keys=KEYS), ["1"], ask)
    assert len(ask.asked) == 4
