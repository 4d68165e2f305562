"""Tables that list all sources of a request: the catalogue contains their values, and errors name their rows."""

import numpy as np
import pytest

from lake_schema import sky, units
from lake_schema.errors import BadInput
from lake_schema.store import publish, read, validate
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from tests import requests
from truesky.catalogue import build_galaxies, build_stars, given_sources
from truesky.fluxes import integration, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import galaxies_from_table, stars_from_table
from truesky.request.from_toml import parse

TWO = "ra,dec,mag,position_angle,gamma1,stamp\n53.10,-27.80,20.0,30.0,0.05,3\n53.11,-27.81,24.5,140.0,-0.02,-1\n"
STAR = "ra,dec,mag,teff\n53.12,-27.80,18.0,4000\n"


def asked(folder, more='only = "table"', galaxies=TWO, stars=STAR, extra="", radius=0.05):
    names = {"galaxies": galaxies, "stars": stars}
    for name, text in names.items():
        (folder / f"{name}.csv").write_text(text or "")
    files = "".join(f'{name} = "{name}.csv"\n' for name, text in names.items() if text is not None)
    text = f"{extra}\n[sources]\n{more}\n{files}"
    return parse(requests.written(folder, text, requests.FIELD.format(radius)))


def made(folder, *args, **keys):
    """Return tables `galaxies` and `stars` of a request."""
    wanted, lake = asked(folder, *args, **keys), folder / "lake"
    lake.mkdir(exist_ok=True)
    for module in (build_galaxies, build_stars):
        for step in module.steps(lake, wanted):
            publish.make_version(lake, step.plan, step.run_task)
    rows = [read.version(lake, name).rows() for name in ("galaxies", "stars")]
    for found, table in zip(rows, (GALAXIES, STARS), strict=True):
        assert validate.find_violations(found, table) == []
    return rows


def vis_magnitudes(rows, stars):
    (vis,) = (passbands.load("euclid_vis"),)
    galaxies = integration.galaxy_fluxes(
        galaxies_from_table(rows, templates.galaxy_library()), [vis], templates.galaxy_library()
    )
    points = integration.star_fluxes(
        stars_from_table(stars, templates.stellar_library()), [vis], templates.stellar_library()
    )
    return tuple(units.mag_of_f_nu(found[:, 0]) for found in (galaxies, points))


def test_the_tables_are_the_catalogue(tmp_path):
    rows, points = made(tmp_path)
    rows = rows.sort_by("origin_id")
    assert rows["origin_id"].to_pylist() == [1, 2]
    assert rows["ra"].to_pylist() == rows["ra_true"].to_pylist() == [53.10, 53.11]
    assert rows["position_angle"].to_pylist() == [30.0, 140.0]
    assert rows["stamp"].to_pylist() == [3, None]
    assert rows["gamma1"].to_numpy() == pytest.approx([0.05, -0.02], abs=1e-8)
    for name in ("bulge_fraction", "bulge_sersic_index", "disk_half_light_radius", "a_v"):
        assert np.all(rows[name].to_numpy() == np.float32(given_sources.GALAXIES[name]))
    assert rows["flux_halpha"].null_count == 2
    assert (points["ra"].to_pylist(), points["dec"].to_pylist()) == ([53.12], [-27.80])
    galaxies, stars = vis_magnitudes(rows, points)
    magnified = -2.5 * np.log10(1.0 / (1.0 - np.array([0.05, 0.02]) ** 2))
    assert galaxies == pytest.approx(np.array([20.0, 24.5]) + magnified, abs=1e-3)
    assert stars == pytest.approx([18.0], abs=1e-4)


def test_lensing_and_rotation_apply_to_given_galaxies(tmp_path):
    keys = "[universe]\nlensing = { g1 = 0.0, g2 = 0.1 }\nrotation = 90.0"
    rows, points = made(tmp_path, stars=None, extra=keys)
    assert rows.sort_by("origin_id")["position_angle"].to_pylist() == [120.0, 50.0]
    assert np.all(rows["gamma1"].to_numpy() == 0.0)
    assert np.all(rows["gamma2"].to_numpy() == np.float32(0.1))
    assert len(points) == 0


def test_rows_stand_on_a_grid_in_turn(tmp_path):
    without = [",".join(line.split(",")[2:]) for line in TWO.splitlines()]
    star = "mag,teff\n18.0,4000\n"
    rows, points = made(tmp_path, 'only = "grid"\nspacing = 20.0', galaxies="\n".join(without), stars=star)
    numbers = np.array([np.sum(rows["origin_id"].to_numpy() == row) for row in (1, 2)] + [len(points)])
    assert numbers.sum() == pytest.approx(np.pi * (0.05 * 3600.0 / 20.0) ** 2, rel=0.05)
    assert np.ptp(numbers) <= 1
    ra = np.concatenate([rows["ra"].to_numpy(), points["ra"].to_numpy()])
    dec = np.concatenate([rows["dec"].to_numpy(), points["dec"].to_numpy()])
    apart = 3600.0 * sky.separation(ra[:, None], dec[:, None], ra[None], dec[None])
    np.fill_diagonal(apart, np.inf)
    assert apart.min(axis=1) == pytest.approx(20.0, rel=1e-4)


BAD = [
    ({"galaxies": TWO.replace("24.5", "")}, r"galaxies.csv: mag of row 2 is nan"),
    ({"galaxies": TWO.replace("24.5", "faint")}, r"galaxies.csv: .*faint"),
    ({"galaxies": TWO.replace("-27.81", "-97.81")}, r"galaxies.csv: dec of row 2 is -97.81"),
    ({"galaxies": TWO.replace("53.11", "63.11")}, r"galaxies.csv: ra, dec of row 2 must be in the request's area"),
    ({"galaxies": TWO.replace("-0.02", "-0.95")}, r"galaxies.csv: kappa, gamma1, gamma2 of row 2 are near a caustic"),
    ({"galaxies": TWO.replace("gamma1", "shear")}, r"galaxies.csv: unknown column shear, must be one of ra, dec, mag"),
    ({"galaxies": TWO.replace("gamma1", "mag")}, r"galaxies.csv: has column mag more than once"),
    (
        {"galaxies": TWO.replace("gamma1", "ext_law")},
        "ext_law of row 2 is -0.02",
    ),
    ({"galaxies": TWO.replace("gamma1", "ext_law").replace("-0.02", "2")}, "ext_law of row 1 is not a whole number"),
    ({"galaxies": "ra,dec\n53.1,-27.8\n"}, r"galaxies.csv: column mag is missing"),
    ({"galaxies": "ra,dec,mag\n"}, r"galaxies.csv: the table has no rows"),
    ({"galaxies": ""}, r"galaxies.csv: .*mpty"),
    ({"stars": STAR.replace("4000", "4")}, r"stars.csv: teff of row 1 is 4"),
    ({"more": 'only = "grid"\nspacing = 20.0'}, r"galaxies.csv: unknown column ra, must be one of mag"),
    ({"more": 'only = "grid"'}, r"sources.spacing is missing"),
    ({"more": 'only = "table"\nspacing = 20.0'}, r"sources.spacing requires only"),
    ({"more": 'only = "some"'}, r"sources.only = 'some'"),
    ({"more": 'only = "table"\nband = "johnson_q"'}, r"sources.band = 'johnson_q' is not one of"),
    ({"galaxies": None, "stars": None}, r"sources must have galaxies or stars"),
    ({"extra": "[stars]\nbright_limit = 15.0"}, r"sources: .* section stars"),
    ({"extra": '[ingest.halos]\nfiles = ["x.csv"]'}, r"sources: .* section ingest"),
]


@pytest.mark.parametrize(("keys", "words"), BAD, ids=range(len(BAD)))
def test_bad_tables_are_refused(tmp_path, keys, words):
    with pytest.raises(BadInput, match=words) as caught:
        made(tmp_path, **keys)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "lake" / "galaxies").exists()


def test_a_table_that_changes_while_it_is_read_is_refused(tmp_path):
    wanted = asked(tmp_path)
    step = build_galaxies.steps(tmp_path, wanted)[0]
    asked(tmp_path, galaxies=TWO.replace("20.0", "20.1"))
    with pytest.raises(BadInput, match="has changed since the job began"):
        step.run_task(tmp_path, {**step.plan.facts, **step.plan.tasks[0].facts})
    assert build_galaxies.steps(tmp_path, wanted)[0].plan.key != step.plan.key


def test_a_grid_of_too_many_places_is_refused(tmp_path):
    with pytest.raises(
        BadInput, match=r"sources.spacing = 0.01: the grid around the area must have at most 4000000 positions"
    ):
        made(tmp_path, 'only = "grid"\nspacing = 0.01', galaxies="mag\n20\n", stars=None)
