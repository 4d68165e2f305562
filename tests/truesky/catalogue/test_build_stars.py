"""The job makes files with similar numbers of stars, and the rows do not depend on the division into files."""

import numpy as np
import pytest
from astropy.table import Table

from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read
from lake_schema.tables import stars
from tests import hats_readers, requests
from truesky.catalogue import build_stars
from truesky.catalogue.exports import fits_files
from truesky.fluxes import compute_fluxes
from truesky.render.planning import preconditions
from truesky.request.from_toml import from_table
from truesky.running import submitted_job

# l = 0, b = 12
AREA = {"cone": {"ra": 255.4, "dec": -22.2, "radius": 0.5}}


def wanted(**keys):
    table = {"name": "test", "seed": 1, "area": AREA, "universe": {"star_limit": 14.0}}
    return from_table(table | {"fluxes": {"bands": ["euclid_vis"]}} | keys)


def made(lake, **keys):
    (step,) = build_stars.steps(lake, wanted(**keys))
    publish.make_version(lake, step.plan, step.run_task)
    return read.version(lake, "stars")


@pytest.fixture(scope="module")
def versions(tmp_path_factory):
    """Build the same sky with three divisions into files."""
    cuts = (1_000_000, 6200, 1)
    return [made(tmp_path_factory.mktemp("lake"), stars={"rows_a_file": rows}) for rows in cuts]


def test_the_rows_do_not_depend_on_the_files(versions):
    whole, mixed, fine = versions
    orders = [{layout.cell_of_file(part)[0] for part in one.partitions} for one in versions]
    assert [len(found) for found in orders] == [1, 3, 1]
    assert orders[2] == {ids.GENERATION_ORDER}
    rows = whole.rows()
    assert rows.num_rows > 10_000
    assert mixed.rows().equals(rows)
    assert fine.rows().equals(rows)
    keys = {one.key for one in versions}
    assert len(keys) == 3


def test_files_hold_about_what_was_planned(versions):
    """Sample of all files; significance 3e-7 for each (5 standard errors)."""
    _, mixed, _ = versions
    coarse = [part for part in mixed.partitions if layout.cell_of_file(part)[0] < ids.GENERATION_ORDER]
    rows = [mixed.rows(["id"], [part]).num_rows for part in coarse]
    assert max(rows) < 6200 + 5 * np.sqrt(6200)


def test_every_order_is_valid_for_others(versions):
    for one in versions[:2]:
        assert hats_readers.is_valid(one.folder)
        assert read.find_faults(one, deep=True) == []


def test_selections_do_not_depend_on_the_files(versions, rng):
    whole, mixed, _ = versions
    _, dec, ra = (whole.rows(["_healpix_29", "dec", "ra"])[k].to_numpy() for k in range(3))
    for i in rng.integers(0, ra.size, 5):
        circle = whole.cone(float(ra[i]), float(dec[i]), 0.3)
        assert circle.num_rows > 10
        assert mixed.cone(float(ra[i]), float(dec[i]), 0.3).equals(circle)
        cells = sky.cells_in_cone(float(ra[i]), float(dec[i]), 0.3, 8).tolist()
        assert mixed.rows_in_cells(cells, 8).equals(whole.rows_in_cells(cells, 8))


def test_fluxes_lie_beside_their_stars(versions):
    """In the same files and the same order, so that reading both needs no join."""
    mixed = versions[1]
    lake = mixed.folder.parents[1]
    step = compute_fluxes.flux_step("star", lake, wanted())
    publish.make_version(lake, step.plan, step.run_task)
    fluxes = read.version(lake, "star_fluxes")
    assert fluxes.partitions == mixed.partitions
    assert hats_readers.is_valid(fluxes.folder)
    cells = sky.cells_in_cone(AREA["cone"]["ra"], AREA["cone"]["dec"], 0.3, 8).tolist()
    stars, beside = (one.rows_in_cells(cells, 8, ["id"]) for one in (mixed, fluxes))
    assert stars.num_rows > 1000
    assert stars.equals(beside)
    preconditions.refuse_uncovered(mixed, set(cells))
    with pytest.raises(BadInput, match="lacks 1 order-8 cells"):
        preconditions.refuse_uncovered(mixed, {*cells, 0})


def test_variable_stars_change_no_other_column(versions, tmp_path):
    """Without them, facts and schema of the table have no trace of them, so that its key and bytes stay the same."""
    variable = made(tmp_path / "lake", universe={"star_limit": 14.0, "variables": True})
    plain = versions[0]
    assert "variables" not in plain.manifest["facts"]
    assert plain.schema.names == stars.STARS.names
    assert variable.manifest["facts"]["variables"] is True
    assert variable.schema.names == stars.stars(True).names
    assert variable.rows(stars.STARS.names).equals(plain.rows())
    assert hats_readers.is_valid(variable.folder)
    assert read.find_faults(variable, deep=True) == []
    code = variable.rows(["variability"])["variability"].drop_null().to_numpy()
    assert set(np.unique(code)) > {5, 6}
    fits_files.write(tmp_path / "lake", stars.STARS, tmp_path / "fits")
    written = Table.read(next((tmp_path / "fits").iterdir()))
    assert {"variability", "tidal_amplitude"} <= set(written.colnames)


def test_crowded_areas_are_refused_before_any_work(lake, tmp_path, capsys):
    plane = {"cone": {"ra": 266.4, "dec": -28.9, "radius": 0.1}}
    with pytest.raises(BadInput, match=r"within 5 deg of the Galactic plane"):
        build_stars.steps(lake, wanted(area=plane))
    with pytest.raises(BadInput, match=r"set a brighter stars\.plane_limit"):
        build_stars.steps(lake, wanted(area=plane, stars={"plane_limit": 26.0}))
    path = requests.written(tmp_path, area="cone = { ra = 266.4, dec = -28.9, radius = 0.1 }")
    assert submitted_job.main(build_stars.JOB, ["--lake", str(tmp_path / "l"), "--request", str(path)]) == 2
    assert "stars.plane_limit" in capsys.readouterr().err
    assert not (tmp_path / "l").exists()


def test_the_plane_has_a_separate_limit(lake):
    """Both sides of b = 5 deg, away from the bulge."""
    ra, dec = (float(x) for x in sky.equatorial(60.0, 5.0))
    version = made(lake, area={"cone": {"ra": ra, "dec": dec, "radius": 0.2}}, stars={"plane_limit": 12.0})
    rows = version.rows(["ra", "dec", "mag_h", "a_v"])
    cell = sky.cell_at(rows["ra"].to_numpy(), rows["dec"].to_numpy(), ids.GENERATION_ORDER)
    _, b = sky.galactic(*sky.cell_centres(ids.GENERATION_ORDER, cell))
    seen = rows["mag_h"].to_numpy() + 0.178 * rows["a_v"].to_numpy()
    assert 11.5 < seen[np.abs(b) < 5].max() <= 12.001
    assert 13.5 < seen[np.abs(b) >= 5].max() <= 14.001
