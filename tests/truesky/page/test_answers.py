"""Answers to the page agree with the content of the lake."""

import json
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import sky
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.halos import HALOS
from tests.truesky.page.conftest import CENTRE, GALAXIES_N, NX, NY, asked, serving, system, unpacked
from tests.universe import rows_of
from truesky.page import charts, sky_maps
from truesky.render.camera import astrometry


def test_tables_are_described(page):
    told = json.loads(page.ask("/api/lake")[2])
    tables = {table["name"]: table for table in told["tables"]}
    assert set(tables) == {"galaxies", "galaxy_fluxes", "stars", "products", "rendered_truth", "plain"}
    (ra,) = (column for column in tables["galaxies"]["columns"] if column["name"] == "ra")
    assert (ra["unit"], ra["ucd"]) == ("deg", "pos.eq.ra;meta.main")
    assert tables["galaxies"]["rows"] == GALAXIES_N
    assert tables["galaxies"]["is_catalogue"]
    assert not tables["plain"]["is_catalogue"]
    assert told["is_changed"] is False
    assert page.gate.token not in json.dumps(told)


def test_rows_of_a_query(page, shown):
    body = json.dumps({"sql": "SELECT id, ra FROM galaxies ORDER BY id"}).encode()
    found = page.json("sql", method="POST", body=body)
    stored = read.version(shown, "galaxies").rows(["id", "ra"]).sort_by("id")
    assert found["more"] is True
    assert [row[0] for row in found["rows"]] == [str(i) for i in stored["id"].to_pylist()[:500]]
    assert [row[1] for row in found["rows"]] == stored["ra"].to_pylist()[:500]
    assert [column["unit"] for column in found["columns"]] == ["", "deg"]


def test_values_that_json_cannot_represent(page):
    body = json.dumps(
        {"sql": "SELECT 'nan'::FLOAT a, 'inf'::DOUBLE b, NULL c, [1, NULL] d, true e, 9007199254740993 f"}
    )
    assert page.json("sql", method="POST", body=body.encode())["rows"] == [
        ["nan", "inf", None, [1, None], True, "9007199254740993"]
    ]


def test_counts_agree_with_the_rows(page, shown):
    rows = read.version(shown, "galaxies").rows(["z_obs", "mag_r01", "flux_halpha"])
    z, mag = (rows[name].to_numpy() for name in ("z_obs", "mag_r01"))
    head, (one, both) = asked(
        page, source="galaxies", axes=["z_obs", "mag_r01", "flux_halpha"], limits=[[1, 10.0, 30.0]],
        charts=[{"axes": [0], "bins": [50], "spans": [[0, 5]]},
                {"axes": [0, 1], "bins": [7, 9], "spans": [[0, 5], [0, 40]]}],
    )  # fmt: skip
    inside = (mag >= 10) & (mag <= 30)
    np.testing.assert_array_equal(one, np.histogram(z[inside].astype(float), 50, (0, 5))[0])
    np.testing.assert_array_equal(
        both, np.histogram2d(z.astype(float), mag.astype(float), (7, 9), ((0, 5), (0, 40)))[0]
    )
    assert head["missing"] == [0, 0, rows["flux_halpha"].null_count]
    assert (head["rows"], head["part"]) == (GALAXIES_N, 1)


def test_a_join_is_counted(page):
    source = "galaxies JOIN galaxy_fluxes USING (id)"
    _, (counts,) = asked(page, source=source, axes=["f_nu_euclid_vis - bulge_fraction"],
                            charts=[{"axes": [0], "bins": [3], "spans": [[-1, 1]]}])  # fmt: skip
    # The flux was computed from this column, so the difference is zero in every row.
    assert counts.tolist() == [0, GALAXIES_N, 0]


def rows_by_sql(page, text):
    return page.json("sql", method="POST", body=json.dumps({"sql": text}).encode())["rows"]


def test_counts_of_identifiers_and_missing_values_are_duckdbs(page):
    """64-bit identifiers, NULL, values on edges of bins and infinite values are in the bins where DuckDB counts them.

    DuckDB counts with integers; the page uses 32-bit floats of the remainder of large identifiers.
    """
    odd = "CASE kind WHEN 0 THEN 'inf'::FLOAT WHEN 1 THEN 'nan'::FLOAT WHEN 2 THEN NULL ELSE z_obs END"
    source = f"(SELECT id, round(z_obs * 8)::BIGINT AS eighths, {odd} AS odd FROM galaxies) AS rows"
    # Only the last bin includes its upper edge. If n is an integer in [0, 20 k], its bin is n // k.
    axes = ["id % 1000000", "eighths / 8", "odd"]
    spans = [[0.0, 1e6], [0.0, 2.0], [0.0, 5.0]]
    charts_ = [
        {"axes": [k], "bins": [bins], "spans": [span]}
        for k, (bins, span) in enumerate(zip((20, 4, 5), spans, strict=True))
    ]
    head, found = asked(page, source=source, axes=axes, charts=charts_)
    places = ["(id % 1000000) // 50000", "least(eighths // 4, 3)", "least(floor(odd), 4)::INT"]
    within = ["true", "eighths BETWEEN 0 AND 16", "odd BETWEEN 0 AND 5"]
    for place, condition, counts in zip(places, within, found, strict=True):
        rows = rows_by_sql(page, f"SELECT {place}, count(*) FROM {source} WHERE {condition} GROUP BY ALL")
        assert len(rows) > 2
        expected = np.zeros(len(counts), int)
        for bin_, n in rows:
            expected[int(bin_)] = n
        np.testing.assert_array_equal(counts, expected)
    ((edges,),) = rows_by_sql(page, f"SELECT count(*) FROM {source} WHERE eighths % 4 = 0 AND eighths <= 16")
    assert edges > 100
    ((lost,),) = rows_by_sql(page, "SELECT count(*) FROM galaxies WHERE kind IN (0, 1, 2)")
    assert head["missing"] == [0, 0, lost]
    # A condition on an identifier selects one row, although neighbouring identifiers are the same float32 number.
    ((own,),) = rows_by_sql(page, "SELECT id FROM galaxies ORDER BY id LIMIT 1 OFFSET 7")
    one = asked(page, source="galaxies", where=f"id = {own}", axes=["ra"], charts=[{"axes": [0], "bins": [3]}])
    assert one[0]["rows"] == 1


def test_rows_outside_a_chart_are_counted(page, shown):
    """Count rows outside the span of a chart, and rows without a value on each axis."""
    rows = read.version(shown, "galaxies").rows(["id", "z_obs", "mag_r01"])
    identifiers, z, mag = (rows[name].to_numpy() for name in ("id", "z_obs", "mag_r01"))
    # A few values are far from all others.
    third = np.sort(identifiers)[-3]
    mag = np.where(identifiers >= third, 1e6, mag)
    axes = [
        "CASE WHEN z_obs < 1 THEN NULL ELSE z_obs END",
        f"CASE WHEN id >= {third} THEN 1e6 ELSE mag_r01 END",
        "'nan'::FLOAT",
    ]
    own = [{"axes": [0], "bins": [5], "spans": [[2.0, 3.0]]}, {"axes": [1, 0], "bins": [4, 4]}]
    head, (one, both) = asked(page, source="galaxies", axes=axes, limits=[[1, 10.0, 30.0]], charts=own)
    counts = (mag >= 10) & (mag <= 30) & (z >= 1)
    assert one.sum() == (counts & (z >= 2) & (z <= 3)).sum()
    assert head["charts"][0]["outside"] == (counts & ~((z >= 2) & (z <= 3))).sum() > 0
    assert head["missing"] == [(z < 1).sum(), 0, GALAXIES_N]
    (lo, hi), (bottom, top), _ = head["spans"]
    inside = (z >= lo) & (z <= hi) & (mag >= bottom) & (mag <= top)
    assert both.sum() == (inside & (z >= 1)).sum()
    assert head["charts"][1]["outside"] == (~inside & (z >= 1)).sum() > 0


def test_columns_are_inspected_once(page, monkeypatch):
    """Inspecting many rows takes as long as counting them, so it is not repeated at every move of a brush."""
    question = {"source": "galaxies", "axes": ["z_obs * 2.5"], "charts": [{"axes": [0], "bins": [5]}]}
    first, _ = asked(page, **question)

    def refuse(*given):
        raise AssertionError

    monkeypatch.setattr("truesky.explore.counting.span", refuse)
    monkeypatch.setattr("truesky.explore.counting.inspect_columns", refuse)
    assert asked(page, **question)[0] == first


def test_points_are_counted_rows(page, shown):
    rows = read.version(shown, "galaxies").rows(["z_obs", "mag_r01"])
    z, mag = (rows[name].to_numpy().astype(np.float32) for name in ("z_obs", "mag_r01"))
    span = [[0.0, 5.0], [0.0, 40.0]]
    chart = {"axes": [0, 1], "bins": [4, 4], "spans": span, "points": 20_000}
    question = {"source": "galaxies", "axes": ["z_obs", "mag_r01"], "limits": [[0, 1.0, 3.0]]}
    inside = (z >= 1.0) & (z <= 3.0) & (mag >= 0.0) & (mag <= 40.0)
    for limited, kept in (({"own": []}, inside), ({}, (z >= 0) & (z <= 5) & (mag >= 0) & (mag <= 40))):
        status, _, body = page.of_lake(
            "charts", method="POST", body=json.dumps({**question, "charts": [{**chart, **limited}]}).encode()
        )
        head, rest = unpacked(body)
        places = np.frombuffer(rest, "<f4", offset=64).reshape(-1, 2)
        assert (status, head["charts"][0]["points"], head["charts"][0]["points_part"]) == (200, kept.sum(), 1)
        np.testing.assert_array_equal(np.sort(places, axis=0), np.sort(np.stack([z[kept], mag[kept]], axis=1), axis=0))


def test_many_rows_are_sampled_first(page, monkeypatch):
    monkeypatch.setattr(charts, "ROWS_PER_CORE", 10)
    question = {"source": "galaxies", "axes": ["z_obs"], "charts": [{"axes": [0], "bins": [5]}]}
    head, _ = asked(page, **question)
    assert head["part"] == charts.SUBSAMPLING
    assert 0 < head["rows"] < GALAXIES_N / 16
    head, _ = asked(page, **question, part=1)
    assert (head["part"], head["rows"]) == (1, GALAXIES_N)


def test_densities(page):
    status, _, body = page.of_lake("sky/galaxies/parts")
    head, _ = unpacked(body)
    assert (status, head["rows"], head["cells"]) == (200, GALAXIES_N, 1)
    _, _, body = page.of_lake("sky/galaxies/density?order=9")
    head, rest = unpacked(body)
    density = np.frombuffer(rest, "<f4", head["cells"], 32 * head["cells"])
    assert head["rows"] == GALAXIES_N
    assert density.sum() * 41252.96 / 12 / 4**9 == pytest.approx(GALAXIES_N, rel=1e-5)
    _, _, body = page.of_lake("sky/galaxies/density?order=9&where=z_obs%20%3C%202%20--%20near")
    assert 0 < unpacked(body)[0]["rows"] < GALAXIES_N


def test_sources_of_a_field(page, shown, monkeypatch):
    rows = read.version(shown, "stars").rows(["id", "ra", "dec"])
    ra, dec, radius = rows["ra"][0].as_py(), rows["dec"][0].as_py(), 0.004
    found = page.json(f"sky/stars/sources?ra={ra}&dec={dec}&radius={radius}")
    inside = sky.separation(rows["ra"].to_numpy(), rows["dec"].to_numpy(), ra, dec) <= radius
    assert 1 < inside.sum() < len(rows)
    assert set(found["id"]) == {str(i) for i in rows.filter(pa.array(inside))["id"].to_pylist()}
    assert (found["total"], found["most"]) == (inside.sum(), sky_maps.MAX_SOURCES)
    nothing = page.json(f"sky/stars/sources?ra={ra}&dec={-dec}&radius={radius}")
    assert (nothing["id"], nothing["total"]) == ([], 0)
    monkeypatch.setattr(sky_maps, "MAX_SOURCES", 2)
    found = page.json(f"sky/stars/sources?ra={ra}&dec={dec}&radius={radius}")
    assert (len(found["id"]), found["total"], found["most"]) == (2, inside.sum(), 2)


def test_the_most_massive_halos_come_first(tmp_path, monkeypatch):
    root, rows = tmp_path / "lake", rows_of(HALOS, 300, seed=2)
    root.mkdir()
    part = Task(layout.cell_file(5, 1607), {})
    publish.make_version(root, Plan(HALOS, {}, (part,)), lambda lake, facts: Output(rows))
    ra, dec = CENTRE
    monkeypatch.setattr(sky_maps, "MAX_SOURCES", 20)
    with serving(root) as page:
        found = page.json(f"sky/halos/sources?ra={ra}&dec={dec}&radius=5")
    assert (found["by"], found["sense"], found["total"]) == ("log_mass", -1, 300)
    assert found["mag"] == sorted(rows["log_mass"].to_pylist(), reverse=True)[:20]


def test_the_mean_of_an_expression(page, shown):
    _, _, body = page.of_lake("sky/galaxies/density?order=5&value=z_obs%20%2B%201%20--%20one")
    head, rest = unpacked(body)
    mean = np.frombuffer(rest, "<f4", head["cells"], 32 * head["cells"])
    z = read.version(shown, "galaxies").rows(["z_obs"])["z_obs"].to_numpy().astype(float)
    assert mean == pytest.approx([z.mean() + 1], rel=1e-5)
    assert page.of_lake("sky/galaxies/density?order=5&value=1)%20FROM%20stars%20--")[0] == 400


def test_a_mean_ignores_rows_without_a_value(page, shown):
    odd = "CASE WHEN z_obs < 1 THEN 'nan'::DOUBLE WHEN z_obs < 1.5 THEN 'inf' WHEN z_obs < 2 THEN NULL ELSE z_obs END"
    _, _, body = page.of_lake(f"sky/galaxies/density?order=5&value={quote(odd)}")
    head, rest = unpacked(body)
    rows = read.version(shown, "galaxies").rows(["z_obs"])
    own = rows["z_obs"].to_numpy() >= 2
    assert 0 < own.sum() < GALAXIES_N
    assert (head["rows"], head["missing"]) == (GALAXIES_N, (~own).sum())
    mean = np.frombuffer(rest, "<f4", head["cells"], 32 * head["cells"])
    assert mean == pytest.approx([rows["z_obs"].to_numpy().astype(float)[own].mean()], rel=1e-5)


# ------------------------------------------------------------------------------------------------ images


def test_tiles_contain_the_pixels_of_the_image(page):
    about = page.json("image/1")
    assert (about["nx"], about["ny"], about["levels"]) == (NX, NY, [[700, 600], [350, 300]])
    pixels = np.zeros((NY, NX), np.float32)
    for row in range(2):
        for column in range(2):
            piece = np.frombuffer(page.of_lake(f"tile/1/0/{row}/{column}")[2], "<f4")
            view = pixels[512 * row : 512 * row + 512, 512 * column : 512 * column + 512]
            view[:] = piece.reshape(view.shape)
    coarse = np.frombuffer(page.of_lake("tile/1/1/0/0")[2], "<f4").reshape(300, 350)
    np.testing.assert_allclose(coarse, pixels.reshape(300, 2, 350, 2).mean((1, 3)), rtol=1e-5, atol=1e-4)
    # The true positions of the brightest stars are at peaks of the pixels.
    truth, checked = page.json("truth/1"), 0
    for x, y in zip(truth["x"][:60], truth["y"][:60], strict=True):
        c, r = round(x), round(y)
        if not (8 < c < NX - 8 and 8 < r < NY - 8):
            continue
        others = np.hypot(np.array(truth["x"]) - x, np.array(truth["y"]) - y)
        if (others < 16).sum() > 1:
            continue
        peak = np.unravel_index(pixels[r - 3 : r + 4, c - 3 : c + 4].argmax(), (7, 7))
        assert abs(peak[1] - 3 + c - x) <= 0.5 + 1e-6
        assert abs(peak[0] - 3 + r - y) <= 0.5 + 1e-6
        checked += 1
    assert checked >= 20
    assert truth["kind"][0] == "star"


def test_checksums_of_cached_data_are_verified_once(page, monkeypatch):
    """Verification reads all data, so it is not repeated at every tile or move of a brush."""
    charts_ = {"axes": [0], "bins": [5], "spans": [[0.0, 5.0]]}
    question = {"source": "galaxies", "axes": ["z_obs * 1.5"], "charts": [charts_]}
    first = asked(page, **question)[1][0].tolist(), page.of_lake("tile/0/0/0/0")[2]
    compared = []
    monkeypatch.setattr("truesky.numerics.cache.is_intact", lambda *given: compared.append(given) or True)
    for _ in range(3):
        assert asked(page, **question)[1][0].tolist() == first[0]
        assert page.of_lake("tile/0/0/0/0")[2] == first[1]
        assert page.of_lake("tile/0/0/1/0")[0] == 200
    assert compared == []


def test_cosmic_rays_on_and_off(page):
    with_, without = (
        np.frombuffer(page.of_lake(f"tile/0/0/0/0{words}")[2], "<f4").reshape(512, 512) for words in ("", "?mended=1")
    )
    hit = np.zeros((512, 512), bool)
    hit[200:205, 100:140] = True
    np.testing.assert_array_equal(with_[~hit], without[~hit])
    assert with_[hit].mean() > 4000
    assert 50 < np.median(without[hit]) < 200


def test_the_grid_gives_the_sky(page):
    """The interpolation of the browser between nodes, repeated in Python, agrees with the header."""
    grid = page.json("image/0")["grid"]
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, NX - 1, 50), rng.uniform(0, NY - 1, 50)
    xi, eta = (np.array(grid[name]).reshape(33, 33) for name in ("xi", "eta"))
    u, v = ((value - grid[axis][0]) / (grid[axis][1] - grid[axis][0]) for axis, value in (("x", x), ("y", y)))
    i, j = u.astype(int), v.astype(int)
    plane = [
        (1 - (v - j)) * ((1 - (u - i)) * t[j, i] + (u - i) * t[j, i + 1])
        + (v - j) * ((1 - (u - i)) * t[j + 1, i] + (u - i) * t[j + 1, i + 1])
        for t in (xi, eta)
    ]
    ra, dec = astrometry.sky_of_pixel(system(), x, y)
    a, d = np.radians([grid["ra"], grid["dec"]])
    east, north = (
        np.array([-np.sin(a), np.cos(a), 0]),
        np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)]),
    )
    centre = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    x, y, z = (np.radians(plane[0])[:, None] * east + np.radians(plane[1])[:, None] * north + centre).T
    found = np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))
    # The tolerance is 0.001 pixel.
    assert sky.separation(*found, ra, dec).max() < 3e-8


def test_a_source(page, shown):
    star = read.version(shown, "rendered_truth").rows()["id"][0].as_py()
    found = page.json(f"source/{star}")
    assert found["kind"] == "star"
    assert {row["name"]: row["value"] for row in found["tables"]["stars"]}["id"] == str(star)
    assert len(found["drawn"]) == 1
    assert {image["number"] for image in found["images"]} <= {0, 1, 2}
    x, y = found["images"][0]["x"], found["images"][0]["y"]
    assert (x, y) == pytest.approx((found["drawn"][0]["x"], found["drawn"][0]["y"]), abs=1e-3)
    assert found["images"][0]["is_north_up"] is False
    assert len(page.of_lake(f"cutout/0?x={x}&y={y}")[2]) == 64 * 64 * 4
    near = page.json(f"nearest?ra={found['place'][0]}&dec={found['place'][1]}&radius=0.001")
    assert near["id"] == str(star)
    assert page.of_lake("source/1")[0] == 400


def test_footprints_and_runs(page):
    (region,) = page.json("regions")
    assert (region["state"], region["images"], len(region["polygon"])) == ("observed", [0, 1, 2], 4)
    assert page.json("runs")["failures"] == []
    tree = page.json("provenance/0")
    assert tree["from"][0]["name"] == "products"
