"""The explorer returns the same numbers as numpy for the same rows."""

import json
import os
import signal
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

from lake_schema import sky
from lake_schema.errors import BadInput, Damaged
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.galaxies import GALAXIES
from tests.universe import plain_plan, plain_work, rows_of
from truesky.explore.explorer import Explorer


def test_tables_and_their_columns(explorer):
    tables = explorer.tables()
    assert tables["rows"].to_dict() == {"galaxies": 500, "galaxy_fluxes": 500, "lists": 2, "plain": 60}
    assert (tables["MB"] > 0).all()
    columns = explorer.describe("galaxies")
    assert list(columns.index) == GALAXIES.names
    assert columns.loc["ra"].to_dict() == {
        "type": "double", "unit": "deg", "range": "0.0 .. 360.0", "null": False,
        "ucd": "pos.eq.ra;meta.main", "meaning": GALAXIES.column("ra").doc,
    }  # fmt: skip
    assert "2 QSO" in columns.loc["kind", "meaning"]
    with pytest.raises(BadInput, match="no table stars; it has galaxies"):
        explorer.describe("stars")


def test_sql_gives_the_rows_of_the_table(explorer, galaxies):
    found = explorer.sql("SELECT id, z_obs FROM galaxies WHERE z_obs < $most ORDER BY id", most=3.0)
    frame = galaxies.select(["id", "z_obs"]).to_pandas()
    wanted = frame[frame.z_obs < 3.0].sort_values("id", ignore_index=True)
    pd.testing.assert_frame_equal(found, wanted)
    whole = explorer.sql("SELECT * FROM galaxies ORDER BY _healpix_29", into="arrow")
    assert whole.cast(galaxies.schema).equals(galaxies)


@pytest.mark.parametrize(
    ("value", "kind"), [(1, int), (1.5, float), ("a'; DROP VIEW plain --", str), (True, bool), ([1, 2], list)]
)
def test_parameters_are_values_and_nothing_else(explorer, value, kind):
    assert explorer.sql("SELECT $x AS x", into="arrow", x=value)["x"].to_pylist() == [value]
    assert isinstance(value, kind)


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        (np.int64(2**53 + 1), 2**53 + 1), (np.float32(0.5), 0.5), (np.True_, True), ((1, 2), [1, 2]),
        (np.arange(3), [0, 1, 2]), ([np.int16(1), 2], [1, 2]),
    ],
)  # fmt: skip
def test_parameters_of_numpy_and_tuples_are_values(explorer, value, wanted):
    assert explorer.sql("SELECT $x AS x", into="arrow", x=value)["x"].to_pylist() == [wanted]


@pytest.mark.parametrize(
    "value", [object(), float("nan"), b"x", {1, 2}, np.float32("nan"), np.datetime64("2030-01-01", "ns")]
)
def test_other_parameters_are_refused(explorer, value):
    with pytest.raises(BadInput, match="parameter"):
        explorer.sql("SELECT $x", x=value)


def test_missing_and_unused_parameters(explorer):
    for text, parameters in (("SELECT $x", {}), ("SELECT 1", {"x": 1})):
        with pytest.raises(BadInput, match="SQL"):
            explorer.sql(text, **parameters)


def test_astropy_tables_have_units(explorer, galaxies):
    table = explorer.sql("SELECT ra, dec, z_obs, log_halo_mass, a_v FROM galaxies", into="astropy")
    assert table["ra"].unit == u.deg
    assert table["a_v"].unit == u.mag
    assert table["z_obs"].unit is None
    assert table["ra"].description == GALAXIES.column("ra").doc
    assert np.array_equal(table["ra"].data, galaxies["ra"].to_numpy())


def test_nulls_are_masked(explorer):
    table = explorer.sql(
        "SELECT CASE WHEN id > 5 THEN id END AS i, CASE WHEN id > 5 THEN value END AS x FROM plain", into="astropy"
    )
    assert table["i"].mask.sum() == table["x"].mask.sum() == 6


def test_identifiers_beside_missing_ones_stay_whole(explorer):
    text = f"SELECT unnest([{2**53 + 1}, NULL]) AS id, unnest([true, NULL]) AS flag, unnest([0.5, NULL])::DOUBLE AS x"
    found = explorer.sql(text)
    assert found.dtypes.astype(str).to_dict() == {"id": "Int64", "flag": "boolean", "x": "float64"}
    assert found["id"][0] == 2**53 + 1
    assert found.isna().sum().tolist() == [1, 1, 1]
    table = explorer.sql(text, into="astropy")
    assert table["id"][0] == 2**53 + 1
    assert table["flag"].dtype == bool
    assert [list(table[name].mask) for name in ("id", "flag", "x")] == [[False, True]] * 3
    assert explorer.sql("SELECT id FROM plain")["id"].dtype == np.int64


def test_astropy_has_no_two_columns_of_one_name(explorer):
    with pytest.raises(BadInput, match="are called"):
        explorer.sql("SELECT 1 AS a, 2 AS a", into="astropy")
    assert explorer.sql("SELECT 1 AS a, 2 AS a").shape == (1, 2)


# Only unchanged columns of a table have its unit.
UNITS = [
    ("SELECT ra FROM galaxies", {"ra": "deg"}),
    ("SELECT * FROM galaxies", {"ra": "deg", "a_v": "mag"}),
    ("select RA, g.Dec from galaxies g", {"ra": "deg", "dec": "deg"}),
    ("SELECT RA, z_obs::DOUBLE AS Ra FROM galaxies", {"Ra": ""}),
    ("FROM galaxies", {"dec": "deg"}),
    (
        "SELECT g.ra, f_nu_euclid_vis FROM galaxies g JOIN galaxy_fluxes f USING (id)",
        {"ra": "deg", "f_nu_euclid_vis": "uJy"},
    ),
    ("SELECT ra * 2 AS ra FROM galaxies", {"ra": ""}),
    ("SELECT z_obs::DOUBLE AS ra FROM galaxies", {"ra": ""}),
    ("SELECT ra AS dec FROM galaxies", {"dec": ""}),
    ("SELECT *, 1.0::DOUBLE AS ra FROM plain", {"ra": ""}),
    ("SELECT * REPLACE (ra * 2 AS ra) FROM galaxies", {"ra": ""}),
    ("SELECT ra FROM (SELECT z_obs::DOUBLE AS ra FROM galaxies)", {"ra": ""}),
    ("WITH galaxies AS (SELECT value AS ra FROM plain) SELECT ra FROM galaxies", {"ra": ""}),
    ("SELECT ra FROM galaxies AS g(dec, ra)", {"ra": ""}),
    ("SELECT ra FROM galaxies UNION SELECT dec FROM galaxies", {"ra": ""}),
    ("SELECT * FROM (SELECT ra, a_v, 2 AS dec FROM galaxies) LIMIT 3", {"ra": "deg", "a_v": "mag", "dec": ""}),
    ("SELECT * FROM (SELECT * FROM (FROM galaxies) WHERE z_obs > 0.1) AS q ORDER BY ra LIMIT 3", {"ra": "deg"}),
    ("SELECT q.ra FROM (SELECT * FROM galaxies) AS q JOIN galaxy_fluxes USING (id)", {"ra": "deg"}),
    ("WITH q AS (SELECT ra, z_obs AS dec FROM galaxies) SELECT * FROM q LIMIT 3", {"ra": "deg", "dec": ""}),
    ("WITH q AS (SELECT ra FROM galaxies), r AS (SELECT * FROM q) SELECT * FROM r", {"ra": "deg"}),
    ("WITH q(ra) AS (SELECT dec FROM galaxies) SELECT * FROM q", {"ra": ""}),
    ("SELECT *, 1 AS one FROM galaxies", {"ra": "deg", "one": ""}),
    ("SELECT * FROM (SELECT ra, dec FROM galaxies) AS q(dec, ra)", {"ra": "", "dec": ""}),
    ("SELECT * FROM (SELECT dec AS ra FROM (SELECT dec FROM galaxies))", {"ra": ""}),
    ("SELECT s.ra FROM galaxies JOIN (SELECT {'ra': 1.0::DOUBLE} AS s) ON true", {"ra": ""}),
    ("SELECT * FROM (SELECT ra FROM galaxies UNION SELECT z_obs FROM galaxies)", {"ra": ""}),
    ("SELECT ra FROM (SELECT 1.0::DOUBLE AS ra), plain", {"ra": ""}),
    ("SELECT stars, list_transform(stars, lambda x: 2 * x) AS twice FROM lists", {"stars": "uJy", "twice": ""}),
    ("SELECT * FROM (FROM lists) LIMIT 1", {"stars": "uJy"}),
]


@pytest.mark.parametrize(("text", "units"), UNITS)
def test_a_unit_is_never_given_to_another_quantity(explorer, text, units):
    schema = explorer.sql(text, into="arrow").schema
    assert {name: (schema.field(name).metadata or {}).get(b"unit", b"").decode() for name in units} == units


def test_lists_keep_unit_and_ucd_in_astropy(explorer):
    column = explorer.sql("SELECT * FROM (SELECT stars FROM lists) LIMIT 2", into="astropy")["stars"]
    assert (str(column.unit), column.meta["ucd"], len(column)) == ("uJy", "phot.flux.density", 2)


def test_sums_of_integers_are_numbers(explorer):
    assert explorer.sql("SELECT sum(id) AS s FROM plain", into="arrow")["s"].to_pylist() == [
        sum(i for part in range(3) for i in range(100 * part, 100 * part + 20))
    ]


def test_integers_beyond_64_bits_are_never_rounded(explorer):
    big = 2**53 + 1
    assert explorer.sql(f"SELECT sum(x) AS s FROM (SELECT {big} AS x)", into="arrow")["s"].to_pylist() == [big]
    with pytest.raises(BadInput, match="column s holds integers beyond 64 bits; make it s::DOUBLE"):
        explorer.sql(f"SELECT sum(x) AS s FROM (SELECT unnest([{2**62}, {2**62}]) AS x)")
    assert explorer.sql("SELECT 1.5 AS d", into="arrow")["d"].to_pylist() == [1.5]


def test_macros(explorer, galaxies):
    found = explorer.sql(
        "SELECT separation(ra, dec, 10.0, 20.0) AS r, mag_ab(3631e6) AS m, mag_ab(0) AS z FROM galaxies"
    )
    wanted = sky.separation(galaxies["ra"].to_numpy(), galaxies["dec"].to_numpy(), 10.0, 20.0)
    assert np.allclose(found["r"], wanted, rtol=1e-9, atol=0.0)
    assert found["m"][0] == pytest.approx(0.0, abs=1e-3)
    assert found["z"].isna().all()


def test_a_cone_is_a_cone(explorer, galaxies):
    ra, dec = sky.cell_centre(5, 1607)
    here = SkyCoord(ra, dec, unit="deg")
    for on, places in (("observed", ("ra", "dec")), ("true", ("ra_true", "dec_true"))):
        there = SkyCoord(*(galaxies[name].to_numpy() for name in places), unit="deg")
        wanted = galaxies["id"].to_numpy()[here.separation(there).deg <= 0.5]
        found = explorer.cone("galaxies", ra, dec, 0.5, ["id", "ra"], on)
        assert sorted(found["id"]) == sorted(wanted)
    assert explorer.cone("galaxies", ra, dec, 0.5, into="astropy")["ra"].unit == u.deg


def test_hist_agrees_with_numpy(explorer, galaxies):
    z = galaxies["z_obs"].to_numpy().astype(float)
    counts, edges = explorer.hist("galaxies", "z_obs", 20)
    wanted, wanted_edges = np.histogram(z, 20)
    assert np.array_equal(counts, wanted)
    assert np.allclose(edges, wanted_edges, atol=1e-12)
    boost = galaxies["density_boost"].to_numpy().astype(float)
    where = galaxies["kind"].to_numpy() == 0
    counts, edges = explorer.hist("galaxies", "z_obs + 1", 7, (2.0, 9.0), "kind = 0", "1 / density_boost")
    wanted, _ = np.histogram(z[where] + 1, 7, (2.0, 9.0), weights=1 / boost[where])
    # The weight is divided in the column's single precision.
    assert np.allclose(counts, wanted, rtol=1e-7, atol=0.0)


def test_hist_of_two_tables(explorer, galaxies):
    joined = "galaxies g JOIN galaxy_fluxes f USING (id)"
    counts, _ = explorer.hist(joined, "f_nu_euclid_vis - bulge_fraction", 1, (-0.5, 0.5), "g.kind = 0")
    assert counts[0] == sum(kind == 0 for kind in galaxies["kind"].to_pylist())


BAD = [
    (lambda lake: lake.hist("plain", "id", bins=2.5), r"bins = 2\.5 is not a whole number"),
    (lambda lake: lake.hist("plain", "id", bins="5"), "bins = '5' is not a whole number"),
    (lambda lake: lake.hist("plain", "id", bins=0), r"bins = 0 is outside \[1, 10000\]"),
    (lambda lake: lake.hist("plain", "id", span="x"), "span = 'x' is not a pair"),
    (lambda lake: lake.hist("plain", "id", span=(0, "x")), "span = 'x' is not a number"),
    (lambda lake: lake.hist("plain", "id", span=(1, 0)), "from a finite number to a larger one"),
    (lambda lake: lake.heatmap("plain", "id", "id", bins=5), "bins = 5 is not a pair"),
    (lambda lake: lake.heatmap("plain", "id", "id", span=((0, 1), 2)), "span = 2 is not a pair"),
    (lambda lake: lake.skymap("galaxies", order=2.5), r"order = 2\.5 is not a whole number"),
    (lambda lake: lake.sql(None), "the query must be text, not NoneType"),
]


@pytest.mark.parametrize("number", range(len(BAD)))
def test_wrong_arguments_are_named(explorer, number):
    ask, said = BAD[number]
    with pytest.raises(BadInput, match=said):
        ask(explorer)


@pytest.mark.parametrize("number", ["x", None, float("nan"), -1.0])
def test_limits_must_be_numbers(explored, number):
    for name in ("memory", "timeout"):
        with pytest.raises(BadInput, match=name):
            Explorer(explored, **{name: number})


def test_rows_without_a_weight_count_nothing(explorer):
    counts, _ = explorer.hist("plain", "id", 3, weight="NULL")
    assert counts.tolist() == [0.0, 0.0, 0.0]
    counts, *_ = explorer.heatmap("plain", "id", "id", (1, 1), weight="CASE WHEN id < 3 THEN 1 END")
    assert counts.tolist() == [[3.0]]


def test_any_parameter_may_be_exported_to_a_file_of_the_home_folder(explorer, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert explorer.export("SELECT $into AS q", "~/few.csv", into="x") == tmp_path / "few.csv"
    assert (tmp_path / "few.csv").read_text().split() == ['"q"', '"x"']


def test_a_table_of_another_version_is_not_listed_as_damaged(lake):
    table = replace(GALAXIES, version=GALAXIES.version + 1)
    plan = Plan(table, {}, (Task(layout.cell_file(5, 1607), {}),))
    publish.make_version(lake, plan, lambda root, facts: Output(rows_of(table, 12)))
    with Explorer(lake) as other:
        row = other.tables().loc["galaxies"]
    assert row["version"] == "unreadable version"
    assert "written by another version of truesky" in row["meaning"]


def test_heatmap_agrees_with_numpy(explorer, galaxies):
    x, y = (galaxies[name].to_numpy().astype(float) for name in ("z_obs", "abs_mag_r01"))
    counts, x_edges, y_edges = explorer.heatmap("galaxies", "z_obs", "abs_mag_r01", (8, 5))
    wanted, wanted_x, wanted_y = np.histogram2d(x, y, (8, 5))
    assert np.array_equal(counts, wanted.T)
    assert np.allclose(x_edges, wanted_x, atol=1e-12)
    assert np.allclose(y_edges, wanted_y, atol=1e-12)


def test_skymap_counts_cells(explorer, galaxies):
    for order in (0, 5, 9, 29):
        cells, counts = explorer.skymap("galaxies", order, "kind < 2")
        index = galaxies["_healpix_29"].to_numpy()[galaxies["kind"].to_numpy() < 2]
        wanted, n = np.unique(sky.parent(index, 29, order), return_counts=True)
        assert np.array_equal(cells, wanted)
        assert np.array_equal(counts, n)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda e: e.hist("galaxies", "speed"), "speed"),
        (lambda e: e.hist("stars", "ra"), "'stars' is not a table of the lake"),
        (lambda e: e.hist("galaxies", "1) FROM plain; DROP VIEW plain --"), "SQL"),
        (lambda e: e.hist("galaxies", "ra) AS x FROM read_text('/etc/passwd') --"), "SQL"),
        (lambda e: e.hist("galaxies", "(SELECT content FROM read_text('/etc/passwd'))"), "read_text"),
        (lambda e: e.hist("galaxies", "log_sfr", where="ra < 0"), "no finite"),
        (lambda e: e.hist("galaxies", "ra", 0), "bins = 0"),
        (lambda e: e.hist("galaxies", "ra", -1), "bins = -1"),
        (lambda e: e.hist("galaxies", "ra", 5, (1.0, 0.0)), "span"),
        (lambda e: e.hist("galaxies", "ra", 5, (0.0, float("inf"))), "span"),
        (lambda e: e.heatmap("galaxies", "ra", "dec", (5, 10**9)), "bins"),
        (lambda e: e.heatmap("galaxies", "ra", "dec", (5, 5), ((0.0, 1.0), (1.0, 1.0))), "span"),
        (lambda e: Explorer(e.root, memory=float("nan")), "memory"),
        (lambda e: Explorer(e.root, timeout=float("inf")), "timeout"),
        (lambda e: e.skymap("galaxies", 30), "order"),
        (lambda e: e.skymap("plain"), "_healpix_29"),
        (lambda e: e.sql("SELECT 1", into="numpy"), "into"),
        (lambda e: e.cone("plain", 0, 0, 1), "no column ra"),
        (lambda e: e.export("SELECT 1 AS a", "x.txt"), "must end in .csv"),
    ],
)
def test_refusals_name_what_is_wrong(explorer, call, words):
    with pytest.raises(BadInput, match=words):
        call(explorer)


def test_a_constant_has_a_histogram(explorer):
    counts, edges = explorer.hist("plain", "value", 4)
    assert counts.sum() == 60
    assert edges[0] < 1.0 < edges[-1]


def test_a_lake_without_tables(lake):
    with pytest.raises(BadInput, match="is not a lake"):
        Explorer(lake)


def test_an_explorer_stays_with_the_versions_it_opened(lake):
    publish.make_version(lake, plain_plan(1), plain_work)
    with Explorer(lake) as explorer:
        publish.make_version(lake, plain_plan(2), plain_work)
        assert explorer.sql("SELECT DISTINCT value FROM plain")["value"].tolist() == [1.0]
    with Explorer(lake) as explorer:
        assert explorer.sql("SELECT DISTINCT value FROM plain")["value"].tolist() == [2.0]


def test_changed_byte_is_damage(lake):
    publish.make_version(lake, plain_plan(), plain_work)
    path = read.version(lake, "plain").partition_path("1.parquet")
    data = bytearray(path.read_bytes())
    with Explorer(lake) as explorer:
        assert explorer.sql("SELECT sum(value) AS s FROM plain")["s"][0] == 60.0
        # Change a byte of a page, since the footer has been read already.
        data[60] ^= 1
        path.write_bytes(data)
        with pytest.raises(Damaged):
            explorer.sql("SELECT sum(value), sum(id) FROM plain")


def test_a_killed_process_is_replaced(explorer):
    explorer.sql("SELECT 1")
    os.kill(explorer._process._worker.process.pid, signal.SIGKILL)
    explorer._process._worker.process.wait()
    assert explorer.sql("SELECT 1 AS a")["a"][0] == 1


def test_results_in_files(explorer, galaxies, tmp_path):
    from astropy.io.fits import getheader
    from astropy.table import Table

    text = "SELECT id, ra, kind, flux_halpha, z_obs > 1 AS far, 'x' || kind AS name FROM galaxies ORDER BY _healpix_29"
    fits = Table.read(explorer.export(text, tmp_path / "a.fits"))
    header = getheader(tmp_path / "a.fits", 1)
    assert (header["TUNIT2"], header["TUCD2"]) == ("deg", GALAXIES.column("ra").ucd)
    # By default, pandas 3.0 rounds the last bits of some numbers.
    csv = pd.read_csv(explorer.export(text, tmp_path / "a.csv"), float_precision="round_trip")
    parquet = pa.parquet.read_table(explorer.export(text, tmp_path / "a.parquet"))
    assert fits["ra"].unit == "deg"
    assert fits["flux_halpha"].unit == u.Unit("erg s-1 cm-2")
    assert parquet.schema.field("ra").metadata[b"unit"] == b"deg"
    for found in (fits, csv, parquet.to_pandas()):
        assert len(found) == 500
        assert np.array_equal(np.asarray(found["id"]), galaxies["id"].to_numpy())
        assert np.array_equal(np.asarray(found["ra"], float), galaxies["ra"].to_numpy())
        assert [str(x) for x in found["name"]] == [f"x{k}" for k in galaxies["kind"].to_pylist()]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.fits", "a.parquet"]


def test_types_that_fits_cannot_hold(explorer, tmp_path):
    from astropy.table import Table

    text = "SELECT date '2020-01-01' AS d, [1, 2] AS l, 1::UTINYINT AS k, sum(id) AS s, NULL::BIGINT AS n FROM plain"
    found = Table.read(explorer.export(text, tmp_path / "a.fits"))
    assert found.colnames == ["d", "l", "k", "s", "n"]
    assert list(found["l"][0]) == [1, 2]
    assert found["n"].mask.all()
    assert found["d"][0] == "2020-01-01"
    assert found["s"][0] == explorer.sql(text)["s"][0]
    with pytest.raises(BadInput, match="are called"):
        explorer.export("SELECT 1 AS a, 2 AS a", tmp_path / "b.fits")


@pytest.mark.parametrize(
    ("column", "kinds"),
    [
        ("18446744073709551615::UBIGINT", ["fits"]),
        ("'naïve'", ["fits"]),
        ("INTERVAL 1 DAY", ["csv", "fits", "parquet"]),
        ("{'a': 1}", ["csv", "fits"]),
        ("[1, 2]", ["csv"]),
        ("[['a']]", ["csv", "fits"]),
    ],
)
def test_a_column_that_a_file_cannot_hold_is_named(explorer, tmp_path, column, kinds):
    for kind in ("csv", "fits", "parquet"):
        call = (f"SELECT 1 AS a, {column} AS bad", tmp_path / f"x.{kind}")
        if kind in kinds:
            with pytest.raises(BadInput, match=r"column bad: .+"):
                explorer.export(*call)
            assert not call[1].exists()
        else:
            assert explorer.export(*call).stat().st_size
    with pytest.raises(BadInput, match=r"column 'x{80}'"):
        explorer.export(f"SELECT 1 AS {'x' * 80}", tmp_path / "y.fits")


def test_questions_are_one_line_of_json(explorer):
    """No text in a query can become a second question."""
    text = 'SELECT $x AS a\n{"sql": "SELECT 2"}'
    with pytest.raises(BadInput):
        explorer.sql(text, x=1)
    assert explorer.sql("SELECT $x AS a", x=json.dumps({"sql": "\n"}))["a"][0] == json.dumps({"sql": "\n"})


def test_expressions_may_end_in_a_comment(explorer):
    """Each expression stands alone, whatever follows it in the query."""
    given = {"where": "z_obs > 1 -- far", "weight": "mag_r01 -- light"}
    plain = {"where": "z_obs > 1", "weight": "mag_r01"}
    for name, axes, noted in (
        ("hist", ("z_obs",), ("z_obs -- x",)),
        ("heatmap", ("z_obs", "mag_r01"), ("z_obs -- x", "mag_r01 -- y")),
        ("skymap", (), ()),
    ):
        one, other = getattr(explorer, name), getattr(explorer, name)
        for a, b in zip(one("galaxies", *axes, **plain), other("galaxies -- all", *noted, **given), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("value", [0.0, -1e17, 1e17, 1e300])
def test_the_range_of_equal_values_contains_them(explorer, value):
    counts, edges = explorer.hist("plain", f"{value!r}::DOUBLE", bins=4)
    assert edges[0] < value < edges[-1]
    assert counts.sum() == explorer.sql("SELECT count(*) AS n FROM plain")["n"][0]
