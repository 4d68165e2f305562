"""Requests with an external file that is wrong: one line that names it, with its column and row; nothing published."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests import requests
from tests.truesky import nightly
from tests.truesky.catalogue import synthetic, test_dust_map
from tests.truesky.catalogue.galaxies import test_nearest_sed
from tests.truesky.catalogue.halos import test_halo_catalogue
from truesky.catalogue import build_galaxies, dust_map
from truesky.running import submitted_job

GALAXIES = '[ingest.galaxies]\nfiles = ["theirs.parquet"]\nformat = "flagship2"\n'
HALOS = (
    '[ingest.halos]\nfiles = ["theirs.parquet"]\n[ingest.halos.columns]\norigin_id = "halo_id"\nra = "ra"\n'
    'dec = "dec"\nz_true = "z"\nlog_mass = { column = "mass", log10 = true }\n'
)
TRAINING = '[ingest.training]\nfiles = ["theirs.parquet"]\n[ingest.training.columns]\n' + "".join(
    f'{key} = "{key}"\n' for key in ("z_true", "abs_mag_r01", "color_gr_01", "sed", "ext_law", "ebv")
)
DUST = '[ingest.dust]\nfile = "theirs.fits"\ncolumn = "EBV"\n'


def refused(folder, text, capsys):
    """Return the error message of a job for a request."""
    path, lake = requests.written(folder, text, requests.FIELD.format(0.1)), folder / "lake"
    assert submitted_job.main(build_galaxies.JOB, ["--lake", str(lake), "--request", str(path)]) in (1, 2)
    assert not list(lake.glob("*/v-*"))
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    return said


def halos():
    return test_halo_catalogue.synthetic(100)


def galaxies():
    return synthetic.theirs("flagship2", synthetic.columns())[0]


def changed(values, key, row, value):
    values[key] = np.array(values[key], copy=True)
    values[key][row] = value
    return values


def without(values, key):
    return {name: column for name, column in values.items() if name != key}


@nightly.parametrize(
    ("text", "values", "said"),
    [
        (HALOS, changed(halos(), "ra", 4, np.nan), ("column ra", "row 5")),
        (HALOS, changed(halos(), "halo_id", 7, halos()["halo_id"][2]), ("column halo_id", "row 8", "row 3")),
        (HALOS, changed(halos(), "mass", 9, 13.2), ("column mass", "row 10")),
        (HALOS, without(halos(), "mass"), ("mass",)),
        (GALAXIES, changed(galaxies(), "dec_gal", 4, np.nan), ("column dec_gal", "row 5")),
        (GALAXIES, without(galaxies(), "kappa"), ("kappa",)),
        (TRAINING, changed(test_nearest_sed.observed(), "sed", 6, 31.5), ("column sed", "row 7", "30")),
        (TRAINING, changed(test_nearest_sed.observed(), "ebv", 6, np.nan), ("column ebv", "row 7")),
        (TRAINING, without(test_nearest_sed.observed(), "z_true"), ("z_true",)),
    ],
    (0, 1, 5, 6),
)
def test_a_wrong_value_or_a_missing_column(tmp_path, monkeypatch, capsys, text, values, said):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(dust_map, "map_for_request", lambda seed, own: None)
    pq.write_table(pa.table(values), tmp_path / "theirs.parquet")
    found = refused(tmp_path, text, capsys)
    assert all(part in found for part in ("theirs.parquet", *said)), found


@pytest.mark.parametrize(("text", "values"), [(HALOS, halos()), (GALAXIES, galaxies())])
def test_a_file_that_is_cut_short(tmp_path, monkeypatch, capsys, text, values):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(dust_map, "map_for_request", lambda seed, own: None)
    path = tmp_path / "theirs.parquet"
    pq.write_table(pa.table(values), path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "theirs.parquet" in refused(tmp_path, text, capsys)


def test_a_band_that_is_not_there(tmp_path, capsys):
    said = refused(tmp_path, '[universe]\ngalaxy_band = "euclid_x"\n', capsys)
    assert "universe.galaxy_band = 'euclid_x' is not allowed: allowed with euclid: euclid_vis, euclid_y" in said


def test_a_map_in_the_wrong_ordering(tmp_path, capsys):
    test_dust_map.written_map(tmp_path / "theirs.fits", test_dust_map.synthetic_map(), ORDERING="NESTED")
    found = refused(tmp_path, DUST, capsys)
    assert "theirs.fits: column EBV: ORDERING is NESTED in the header or request" in found


def test_a_map_with_an_invalid_pixel(tmp_path, capsys):
    values = test_dust_map.synthetic_map()
    values[41] = np.nan
    test_dust_map.written_map(tmp_path / "theirs.fits", values)
    assert "theirs.fits: column EBV of row 42 is nan" in refused(tmp_path, DUST, capsys)
