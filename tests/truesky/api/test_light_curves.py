"""Light curves of a lake with supernovae: fluxes at any dates, and mistakes."""

import numpy as np
import pytest

import truesky
from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read
from tests import requests
from truesky.catalogue import build_active_nuclei, build_galaxies, build_stars, build_transients
from truesky.fluxes import compute_fluxes
from truesky.request import from_toml

WANTED = f"""
{requests.shallow(22.0, 18.0)}
transients = {{ start = 61000.0, end = 61100.0, boost = 30.0 }}
[fluxes]
bands = ["lsst_r"]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a lake with supernovae."""
    folder = tmp_path_factory.mktemp("transients")
    request = from_toml.parse(requests.written(folder, WANTED, area=requests.FIELD.format(0.02), name="sky", seed=3))
    root = layout.resolve_lake(folder / "lake")
    for job in (build_galaxies, build_stars, compute_fluxes, build_transients):
        for step in job.steps(root, request):
            publish.make_version(root, step.plan, step.run_task)
    return folder


@pytest.fixture(scope="module")
def lake(folder):
    with truesky.open(folder / "lake") as opened:
        yield opened


def test_the_table_is_in_the_galaxies(lake):
    rows = lake.sql(
        "SELECT t.id, g.z_true AS z, t.z_true, t.offset_east FROM transients t JOIN galaxies g ON g.id = t.host_id"
    )
    assert len(rows) == len(lake.table("transients")) > 100
    np.testing.assert_array_equal(rows["z"], rows["z_true"])


def test_light_curves_are_finite_and_rise_and_fall(lake):
    rows = lake.sql("SELECT id, peak_mjd, z_obs FROM transients WHERE type = 1 ORDER BY mag_b LIMIT 5")
    for source, peak, z in rows.itertuples(index=False):
        curve = lake.light_curve(int(source), "lsst_r", peak + (1.0 + z) * np.array([-50.0, -10.0, 0.0, 60.0, 900.0]))
        assert (curve["f_nu"][[0, 4]] == 0.0).all()
        assert np.isinf(curve["mag"][[0, 4]]).all()
        assert curve["f_nu"][2] > curve["f_nu"][1] > 0.0
        assert curve["f_nu"][2] > curve["f_nu"][3] > 0.0
        np.testing.assert_allclose(curve["mag"][1:4], 23.9 - 2.5 * np.log10(curve["f_nu"][1:4]))


def test_sources_and_dates_may_be_in_any_order(lake):
    ids = lake.table("transients", "id")["id"].to_numpy()[[40, 3, 17, 3]]
    dates = np.array([61090.0, 61010.0])
    together = lake.light_curve(ids, "lsst_r", dates)
    assert together["id"].tolist() == np.repeat(ids, 2).tolist()
    assert together["mjd"].tolist() == np.tile(dates, 4).tolist()
    alone = lake.light_curve(int(ids[1]), "lsst_r", 61010.0)
    assert alone["f_nu"][0] == together["f_nu"][3] == together["f_nu"][7]
    assert len(lake.light_curve([], "lsst_r", dates)) == 0


@pytest.mark.parametrize(
    ("source", "band", "mjd", "message"),
    [
        (17, "lsst_r", 61000.0, "there is no source 17 in this lake"),
        ("a", "lsst_r", 61000.0, "id must be an integer"),
        (None, "lsst_r", float("nan"), "mjd nan is not a date"),
        (None, "lsst_r", [[1.0]], "array of 2 dimensions"),
        (None, "lsst_r", "today", "mjd must be a number"),
        (None, "lsst_q", 61000.0, "lsst_q"),
    ],
)
def test_mistakes(lake, source, band, mjd, message):
    known = int(lake.table("transients", "id")["id"][0])
    with pytest.raises(BadInput, match=message):
        lake.light_curve(known if source is None else source, band, mjd)


def test_an_unknown_supernova_is_named(lake):
    with pytest.raises(BadInput, match=r"there is no source .* in this lake"):
        lake.light_curve(int(lake.table("transients", "id")["id"][0]) ^ 1, "lsst_r", 61000.0)


def test_a_shorter_window_has_the_same_rows(folder):
    """The rows of a short window are those of the long window that shine in it."""
    text = WANTED.replace("end = 61100.0", "end = 61001.0")
    request = from_toml.parse(requests.written(folder, text, area=requests.FIELD.format(0.02), name="short", seed=3))
    root = layout.resolve_lake(folder / "lake")
    long = read.version(root, "transients").rows()
    publish_again = [step for job in (build_galaxies, build_transients) for step in job.steps(root, request)]
    for step in publish_again:
        publish.make_version(root, step.plan, step.run_task)
    short = read.version(root, "transients").rows()
    assert 0 < len(short) < len(long)
    assert set(short["id"].to_pylist()) <= set(long["id"].to_pylist())


VARIABLE = f"""
{requests.shallow(22.0, 18.0)}
variables = true
quasar_boost = 6.0
[fluxes]
bands = ["lsst_r"]
"""


@pytest.fixture(scope="module")
def varying(tmp_path_factory):
    """Return a lake with variable stars and active nuclei."""
    folder = tmp_path_factory.mktemp("varying")
    request = from_toml.parse(requests.written(folder, VARIABLE, area=requests.FIELD.format(0.02), name="sky", seed=3))
    root = layout.resolve_lake(folder / "lake")
    for job in (build_galaxies, build_stars, compute_fluxes, build_active_nuclei):
        for step in job.steps(root, request):
            publish.make_version(root, step.plan, step.run_task)
    with truesky.open(root) as opened:
        yield opened


def test_quasars_and_galaxies_with_nuclei_vary(varying):
    """The mean light of a quasar over a long time is that of the catalogue; a galaxy has that of its nucleus more."""
    dates = np.linspace(40000.0, 90000.0, 4000)
    nuclei = varying.sql(
        "SELECT n.id, n.kind, n.point_id, n.type, f.f_nu_lsst_r AS mean FROM active_nuclei n "
        "JOIN galaxy_fluxes f ON f.id = n.id WHERE n.type = 1"
    )
    quasars, others = nuclei[nuclei["kind"] == 2], nuclei[nuclei["kind"] < 2]
    assert len(quasars) > 5
    assert len(others) > 5
    for source, mean in quasars[["id", "mean"]].head(5).itertuples(index=False):
        curve = varying.light_curve(int(source), "lsst_r", dates)["f_nu"].to_numpy()
        assert 0.5 < curve.mean() / mean < 2.0
        assert curve.std() > 0.02 * mean
    for source, point, mean in others[["id", "point_id", "mean"]].head(5).itertuples(index=False):
        galaxy, nucleus = (varying.light_curve(int(each), "lsst_r", dates[:50])["f_nu"] for each in (source, point))
        np.testing.assert_allclose(galaxy, mean + nucleus, rtol=1e-6)
        assert (nucleus > 0.0).all()


def test_other_galaxies_and_stars_are_constant(varying):
    galaxy = varying.sql("SELECT id FROM galaxies WHERE id NOT IN (SELECT id FROM active_nuclei) LIMIT 1")["id"][0]
    star = varying.sql("SELECT id FROM stars WHERE variability IS NULL LIMIT 1")["id"][0]
    curves = varying.light_curve([int(galaxy), int(star)], "lsst_r", [50000.0, 60000.0])
    fluxes = [
        varying.sql(f"SELECT f_nu_lsst_r FROM {table} WHERE id = $id", id=int(source))["f_nu_lsst_r"][0]
        for table, source in (("galaxy_fluxes", galaxy), ("star_fluxes", star))
    ]
    np.testing.assert_allclose(curves["f_nu"], np.repeat(fluxes, 2))


def test_variable_stars_vary(varying):
    star = varying.sql("SELECT id, period FROM stars WHERE variability IS NOT NULL ORDER BY amplitude DESC LIMIT 1")
    if len(star):
        dates = 61000.0 + np.linspace(0.0, float(star["period"][0]), 500)
        curve = varying.light_curve(int(star["id"][0]), "lsst_r", dates)["f_nu"].to_numpy()
        assert curve.max() > 1.001 * curve.min()


def test_images_show_nuclei_and_supernovae(lake, varying):
    """An image of a place with a bright nucleus or supernova has its light; without it, the image lacks this light."""
    inside, date = "abs(ra - 53.117) < 0.1 AND abs(dec + 27.808) < 0.08", 61050.0
    supernova = f"type = 1 AND abs(peak_mjd - 61045) < 20 AND {inside} ORDER BY mag_b LIMIT 1"
    nucleus = f"kind < 2 AND type = 1 AND {inside} ORDER BY mag_1450 LIMIT 1"
    for opened, query in (
        (lake, f"SELECT id, ra, dec FROM transients WHERE {supernova}"),
        (varying, f"SELECT point_id AS id, ra, dec FROM active_nuclei WHERE {nucleus}"),
    ):
        source, ra, dec = next(opened.sql(query).itertuples(index=False))
        place = {"ra": ra, "dec": dec, "size": 30.0, "band": "lsst_r", "date": date}
        image, without = opened.render(**place), opened.render(**place, without=[int(source)])
        assert int(source) in image.truth["id"].tolist()
        assert int(source) not in without.truth["id"].tolist()
        expected = image.truth.set_index("id")["expected"][int(source)]
        assert expected > 100.0
        assert (image.electrons - without.electrons).sum() == pytest.approx(expected, rel=0.1)
