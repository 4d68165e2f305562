"""Catalogues in the format of Euclid's True Universe: complete, and read back without change."""

import shutil
import subprocess

import numpy as np
import pyarrow as pa
import pytest
from astropy.io import fits
from astropy.table import Table

from lake_schema.errors import BadInput
from lake_schema.external import euclid_catalogues
from lake_schema.external.euclid_catalogues import BANDS
from lake_schema.store import publish, read
from tests import requests
from tests.truesky.catalogue.exports.conftest import BANDS as LSST
from tests.truesky.catalogue.exports.conftest import bands
from truesky.catalogue import build_galaxies
from truesky.catalogue.exports import euclid
from truesky.catalogue.external import mapping, reading
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import band_fluxes, passbands
from truesky.fluxes.libraries import templates
from truesky.request.from_toml import parse

# Columns that truesky has no values for.
EMPTY = {"HEPSILON_LOGFLAM_EXT_MAG", "PEPSILON_LOGFLAM_EXT_MAG"}


@pytest.fixture(scope="module")
def written(lake, tmp_path_factory):
    """Return the exported galaxies and stars."""
    folder = tmp_path_factory.mktemp("euclid")
    return euclid.write_galaxies(lake, folder / "galaxies"), euclid.write_stars(lake, folder / "stars")


def exported_rows(lake, written):
    """Return the galaxies of the lake that are in the files, by identifier, and the rows of the files in this order."""
    rows = read.version(lake, "galaxies").rows()
    rows = rows.filter(pa.array(rows["kind"].to_numpy() < 2)).sort_by("id")
    found = np.concatenate([fits.getdata(path, 1).view(np.ndarray) for path in written[0].files])
    return rows, found[np.argsort(found["SOURCE_ID"])]


def test_the_format_has_69_columns_with_the_types_of_euclid():
    """In SHE_PPT 9.1: identifiers have 64 bits, positions are double, codes 16 bits, and everything else is single."""
    declared = euclid_catalogues.GALAXIES.columns
    assert len(declared) == 69
    others = {"SOURCE_ID": "int64", "HALO_ID": "int64", "KIND": "int16", "EXT_LAW_1": "int16", "EXT_LAW_2": "int16"}
    others |= {name: "float64" for name in ("RA", "DEC", "RA_MAG", "DEC_MAG")}
    assert {c.name: c.type for c in declared if c.type != "float32"} == others
    assert len(BANDS) == 27
    assert {name for name in BANDS.values() if name} <= set(passbands.names())
    # Descriptions fit into one header card.
    for column in (*declared, *euclid_catalogues.STARS.columns):
        assert len(column.doc) <= 68


def test_every_entry_of_the_mapping_is_a_column_that_can_be_inverted():
    for key, field in mapping.galaxy_columns("euclid", {}, FIDUCIAL).fields.items():
        assert field.column in euclid_catalogues.GALAXIES.names, key
        assert field.titles() == [field.column], key


def test_only_galaxies_in_halos_are_written(lake, written):
    rows, found = exported_rows(lake, written)
    assert np.array_equal(found["SOURCE_ID"], rows["id"].to_numpy())
    assert written[0].rows == rows.num_rows
    assert written[0].left_out == read.version(lake, "galaxies").num_rows - rows.num_rows > 0
    assert [path.name for path in written[0].files] == sorted(path.name for path in written[0].files)
    assert written[0].files[0].name.startswith("euclid_galaxies_nside32_nest_")


def test_fluxes_are_in_jansky_and_null_in_bands_without_fluxes(lake, written):
    rows, found = exported_rows(lake, written)
    flux = read.version(lake, "galaxy_fluxes").rows()
    own = dict(zip(flux["id"].to_pylist(), flux["f_nu_lsst_r"].to_pylist(), strict=True))
    expected = [1e-6 * own[key] for key in rows["id"].to_pylist()]
    assert found["TU_FNU_R_LSST_MAG"] == pytest.approx(expected, rel=1e-6, abs=0)
    null = {name for name in found.dtype.names if found.dtype[name].kind == "f" and np.isnan(found[name]).all()}
    assert null == EMPTY | {f"TU_FNU_{band}_MAG" for band, name in BANDS.items() if name not in LSST}


def test_galaxies_are_read_back_without_change(lake, written):
    """Values have the precision of the file: single, and line fluxes that of a logarithm in single precision."""
    columns = mapping.galaxy_columns("euclid", {}, FIDUCIAL)
    pieces = list(reading.read(written[0].files, columns))
    values = {key: np.concatenate([piece.values[key] for piece in pieces]) for key in columns.fields}
    order, rows = np.argsort(values["origin_id"]), exported_rows(lake, written)[0]
    inverse = np.abs((1 - values["kappa"]) ** 2 - values["gamma1"] ** 2 - values["gamma2"] ** 2)
    for key, given in values.items():
        own = rows[euclid._COLUMNS.get(key, key)].to_numpy()
        if key.startswith("flux_"):
            assert (given * inverse)[order] == pytest.approx(own, rel=1e-5, abs=0, nan_ok=True), key
        elif own.dtype == np.float64 or own.dtype.kind == "i":
            assert np.array_equal(given[order], own), key
        elif key == "frac_2":
            assert given[order] == pytest.approx(own, abs=1e-7)
        else:
            assert np.array_equal(given[order].astype(np.float32), own), key
    assert np.count_nonzero(values["flux_halpha"] == 0.0) > 0


def test_the_shear_has_the_signs_that_euclids_validation_expects(lake, written):
    """It compares -GAMMA1 and GAMMA2 with shears in axes west and north; ours have axes east and north."""
    rows, found = exported_rows(lake, written)
    west_north = rows["gamma1"].to_numpy(), -rows["gamma2"].to_numpy()
    assert np.array_equal(-found["GAMMA1"], west_north[0])
    assert np.array_equal(found["GAMMA2"], west_north[1])
    assert found["GAMMA1"].min() < 0.0 < found["GAMMA1"].max()


def test_ingested_galaxies_have_the_fluxes_of_the_file(lake, written, tmp_path, monkeypatch):
    """End to end: spectra, dust, lines, magnification and extinction come back as the same light in every band."""
    from truesky.catalogue.external import ingest

    monkeypatch.setattr(ingest, "cache_dir", lambda: tmp_path / "cache")
    ra, dec = (float(np.mean(read.version(lake, "galaxies").rows()[name].to_numpy())) for name in ("ra", "dec"))
    folder = written[0].files[0].parent
    area = f"cone = {{ ra = {ra}, dec = {dec}, radius = 2.2 }}"
    mapped = f'[ingest.galaxies]\nfiles = ["{folder}"]\nformat = "euclid"\n'
    wanted, new_lake = parse(requests.written(tmp_path, mapped, area)), tmp_path / "lake"
    new_lake.mkdir()
    for step in build_galaxies.steps(new_lake, wanted):
        publish.make_version(new_lake, step.plan, step.run_task)
    rows = read.version(new_lake, "galaxies").rows().sort_by("origin_id")
    found = exported_rows(lake, written)[1]
    assert np.array_equal(rows["origin_id"].to_numpy(), found["SOURCE_ID"])
    light = band_fluxes.galaxy_fluxes(rows, bands(), templates.galaxy_library())
    for band in LSST:
        given = found[f"TU_FNU_{band[-1].upper()}_LSST_MAG"]
        assert 1e-6 * light[f"f_nu_{band}"].to_numpy() == pytest.approx(given, rel=1e-4, abs=0), band
    assert np.array_equal(rows["ra_true"].to_numpy(), found["RA"])
    assert np.array_equal(rows["dec"].to_numpy(), found["DEC_MAG"])


def test_stars_have_the_values_of_the_lake(lake, written):
    (path,) = written[1].files
    found, rows = fits.getdata(path, 1), read.version(lake, "stars").rows()
    assert found.names == euclid_catalogues.STARS.names
    assert written[1].left_out == 0
    for name, own in (("SOURCE_ID", "id"), ("RA", "ra"), ("DEC", "dec"), ("SED_TEMPLATE", "sed"), ("AV", "a_v")):
        assert np.array_equal(found[name], rows[own].to_numpy()), name
    assert np.array_equal(found["TU_MAG_H_2MASS"], rows["mag_h"].to_numpy())
    assert np.isnan(found["DIST"]).all()
    flux = read.version(lake, "star_fluxes").rows()["f_nu_lsst_i"].to_numpy()
    assert found["TU_FNU_I_LSST"] == pytest.approx(1e-6 * flux, rel=1e-6, abs=0)


def test_other_programs_read_the_files(written):
    path = written[0].files[0]
    table = Table.read(path)
    assert table["BULGE_R50"].unit == "arcsec"
    assert table["TU_FNU_VIS_MAG"].unit == "Jy"
    assert table.meta["FITS_DEF"] == "sim.tuGalaxyCatalog"
    assert fits.getheader(path, 1)["TCOMM8"] == "redshift, with the peculiar velocity"
    for file in (*written[0].files, *written[1].files):
        if shutil.which("fitsverify"):
            done = subprocess.run(["fitsverify", "-q", file], capture_output=True, text=True)
            assert done.stdout.startswith("verification OK"), done.stdout
    if shutil.which("stilts"):
        words = ["stilts", "tpipe", f"in={path}", "cmd=meta name units description", "omode=out", "ofmt=csv"]
        done = subprocess.run(words, capture_output=True, text=True)
        assert 'Z_OBS,,"redshift, with the peculiar velocity"' in done.stdout, done.stderr


def test_the_same_lake_gives_the_same_bytes_for_any_size_of_batches(lake, written, tmp_path, monkeypatch):
    monkeypatch.setattr(euclid, "_BATCH", 7)
    again = euclid.write_galaxies(lake, tmp_path / "again")
    assert [path.read_bytes() for path in again.files] == [path.read_bytes() for path in written[0].files]


def test_a_folder_that_exists_is_refused_and_nothing_is_left_after_a_mistake(lake, tmp_path, monkeypatch):
    (tmp_path / "old").mkdir()
    with pytest.raises(BadInput, match="old: exists already; give the name of a new folder"):
        euclid.write_galaxies(lake, tmp_path / "old")
    monkeypatch.setattr(euclid, "_KINDS", ())
    with pytest.raises(BadInput, match="table galaxies has no galaxies in halos"):
        euclid.write_galaxies(lake, tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
