"""External catalogues become table `galaxies`; errors name the file, the column and the row."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.table import Table

from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import publish, read, validate
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.quarantine import QUARANTINE
from tests import requests
from tests.lake_schema.external import opencosmo
from tests.truesky import nightly
from tests.truesky.catalogue import synthetic
from truesky.catalogue import build_galaxies
from truesky.catalogue.external import mapping
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import band_fluxes, sources
from truesky.fluxes.libraries import templates
from truesky.request.from_toml import parse
from truesky.running import submitted_job

FORMATS = ("flagship1", "flagship2", "euclid", "skycatalogs")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Remove the stored catalogue after the test, but keep the tables of the models."""
    from truesky.catalogue.external import ingest

    monkeypatch.setattr(ingest, "cache_dir", lambda: tmp_path / "cache")


# Where the table has positions of a catalogue that has both.
PLACES = {"ra": "ra_true", "dec": "dec_true", "ra_lensed": "ra", "dec_lensed": "dec"}


def asked(folder, file, more):
    """Return the path of a request for the galaxies of one file."""
    return requests.written(folder, f'[ingest.galaxies]\nfiles = ["{file}"]\n{more}\n', requests.FIELD.format(0.3))


def build(folder, file, more):
    """Return the published table of one file."""
    wanted, lake = parse(asked(folder, file, more)), folder / "lake"
    lake.mkdir(exist_ok=True)
    for step in build_galaxies.steps(lake, wanted):
        publish.make_version(lake, step.plan, step.run_task)
    return read.version(lake, "galaxies").rows()


def by_origin(rows, name):
    return rows[name].to_numpy()[np.argsort(rows["origin_id"].to_numpy())]


@nightly.parametrize("form", FORMATS, (1, 2))
def test_a_catalogue_comes_through(tmp_path, form):
    values = synthetic.columns()
    rows = build(tmp_path, synthetic.write(tmp_path, form, values), f'format = "{form}"')
    order = np.argsort(values["origin_id"])
    assert validate.find_violations(rows, GALAXIES) == []
    assert np.array_equal(by_origin(rows, "origin_id"), values["origin_id"][order])
    mapped = mapping.formats()[form]["columns"]
    seen = PLACES if "ra_lensed" in mapped else {}
    kept = [key for key in mapped if (key in GALAXIES.names or key in seen) and key != "origin_id"]
    assert len(kept) > 8
    for key in kept:
        assert by_origin(rows, seen.get(key, key)) == pytest.approx(values[key][order], rel=2e-6, abs=2e-7), key


def test_a_request_with_another_lensing_uses_true_positions(tmp_path):
    """The files also use true positions; with the catalogue's lensing they use observed positions."""
    values = synthetic.columns()
    file, order = synthetic.write(tmp_path, "flagship2", values), np.argsort(values["origin_id"])
    own = build(tmp_path, file, 'format = "flagship2"')
    still = build(tmp_path, file, 'format = "flagship2"\n[universe]\nlensing = { g1 = 0.02, g2 = -0.01 }')
    for rows, key in ((own, "ra_lensed"), (still, "ra")):
        assert by_origin(rows, "ra") == pytest.approx(values[key][order], rel=1e-12)
        assert by_origin(rows, "ra_true") == pytest.approx(values["ra"][order], rel=1e-12)
        assert np.array_equal(sky.healpix_29(*(rows[n].to_numpy() for n in ("ra", "dec"))), rows["_healpix_29"])


def test_one_template_of_real_index_is_two_neighbours(tmp_path):
    values = synthetic.columns()
    values["sed"][:3] = 0.0, 30.0, 12.25
    rows = build(tmp_path, synthetic.write(tmp_path, "flagship1", values), 'format = "flagship1"')
    order = np.argsort(values["origin_id"])
    first, second = (by_origin(rows, f"sed_{k}").astype(float) for k in "12")
    share = by_origin(rows, "frac_1")
    assert first * share + second * (1 - share) == pytest.approx(values["sed"][order], abs=1e-5)
    assert np.all(first - second == 1)
    assert np.array_equal(by_origin(rows, "ebv_1"), by_origin(rows, "ebv_2"))


def test_identifiers_name_halos(tmp_path):
    values = synthetic.columns()
    rows = build(tmp_path, synthetic.write(tmp_path, "flagship2", values), 'format = "flagship2"')
    own, halo, kind = (by_origin(rows, name) for name in ("id", "halo_id", "kind"))
    assert np.array_equal(ids.halo_from_id(own), halo)
    assert np.array_equal(ids.kind_from_id(own), kind)
    theirs = values["halo"][np.argsort(values["origin_id"])]
    cell = sky.cell_at(by_origin(rows, "ra"), by_origin(rows, "dec"), ids.GENERATION_ORDER)
    assert len(set(zip(theirs, cell, strict=True))) == len(set(halo.tolist()))


def test_observed_magnitudes_are_corrected_for_dust_and_lensing(tmp_path):
    """Independent check: LSST r of the rows' spectra with their dust and magnification equals `mag`."""
    from truesky.catalogue.galaxies import band_ratios
    from truesky.fluxes.libraries import templates

    values = synthetic.columns()
    rows = build(tmp_path, synthetic.write(tmp_path, "skycatalogs", values), 'format = "skycatalogs"')
    order = np.argsort(values["origin_id"])
    names = ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")
    sed = band_ratios.Sed(*(by_origin(rows, name) for name in names))
    z = by_origin(rows, "z_true").astype(float)
    table = band_ratios.load(templates.galaxy_library(), "lsst_r", 2.3, 0.5)
    found = by_origin(rows, "abs_mag_r01") + FIDUCIAL.distance_modulus(z) + band_ratios.offset(table, z, sed)
    kappa, gamma1, gamma2, a_v = (values[name][order] for name in ("kappa", "gamma1", "gamma2", "a_v"))
    found = found + 2.70 / 3.1 * a_v + 2.5 * np.log10((1 - kappa) ** 2 - gamma1**2 - gamma2**2)
    assert found == pytest.approx(values["mag"][order], abs=2e-3)


@pytest.mark.nightly
def test_a_request_replaces_the_lensing_and_turns_the_galaxies(tmp_path):
    """The magnification of the catalogue is removed from observed magnitudes."""
    file = synthetic.write(tmp_path, "skycatalogs", synthetic.columns())
    own = build(tmp_path, file, 'format = "skycatalogs"')
    more = 'format = "skycatalogs"\n[universe]\nlensing = { g1 = 0.02, g2 = -0.01 }\nrotation = 90'
    sheared = build(tmp_path, file, more)
    changed = {name for name in own.column_names if not own[name].equals(sheared[name])}
    assert changed == {"kappa", "gamma1", "gamma2", "position_angle"}
    assert np.unique(sheared["gamma1"]) == np.float32(0.02)
    assert np.unique(sheared["gamma2"]) == np.float32(-0.01)
    assert np.all(sheared["kappa"].to_numpy() == 0)
    away = (sheared["position_angle"].to_numpy() - own["position_angle"].to_numpy()) % 180.0
    assert away == pytest.approx(90.0, abs=1e-4)


def test_galaxies_at_a_caustic_are_kept_apart_and_counted(tmp_path):
    """These galaxies are in the table `quarantine` and not in the table `galaxies`."""
    values = synthetic.columns()
    values["kappa"][:4], values["gamma1"][:4], values["gamma2"][:4] = (0.9, 1.0, 1.5, 0.3), (0.0, 0.0, 0.1, 0.69), 0.0
    rows = build(tmp_path, synthetic.write(tmp_path, "skycatalogs", values), 'format = "skycatalogs"')
    apart = read.version(tmp_path / "lake", "quarantine").rows()
    assert (rows.num_rows, apart.num_rows) == (296, 4)
    assert validate.find_violations(rows, GALAXIES) == []
    assert validate.find_violations(apart, QUARANTINE) == []
    assert set(apart["origin_id"].to_pylist()) == set(values["origin_id"][:4].tolist())
    assert sorted(apart["determinant"].to_pylist()) == pytest.approx([0.0, 0.01, 0.0139, 0.24], abs=1e-6)
    assert not set(rows["id"].to_pylist()) & set(apart["id"].to_pylist())
    sources.table_magnification(rows)


def test_without_any_at_a_caustic_the_quarantine_is_an_empty_table(tmp_path):
    build(tmp_path, synthetic.write(tmp_path, "flagship2"), 'format = "flagship2"')
    assert read.version(tmp_path / "lake", "quarantine").rows().schema.equals(QUARANTINE.arrow_schema())
    assert read.version(tmp_path / "lake", "quarantine").num_rows == 0


def test_a_folder_and_a_text_file_with_a_mapping_of_ones_own(tmp_path):
    values = synthetic.columns()
    text = tmp_path / "synthetic.csv"
    Table({name: values[name] for name in ("origin_id", "ra", "dec", "z_obs", "mag")}).write(text)
    columns = "".join(f'{key} = "{key}"\n' for key in ("origin_id", "ra", "dec", "z_obs", "mag"))
    more = f'[ingest.galaxies.columns]\nband = "euclid_vis"\n{columns}'
    rows = build(tmp_path, text, more)
    assert rows.num_rows == 300
    hats = tmp_path / "hats" / "dataset" / "Norder=0" / "Dir=0"
    hats.mkdir(parents=True)
    for part in (0, 1):
        piece = {name: values[name][part::2] for name in ("origin_id", "ra", "dec", "z_obs", "mag")}
        pq.write_table(pa.table(piece), hats / f"Npix={part}.parquet")
    pq.write_table(pa.table({"other": [1]}), hats.parents[1] / "_metadata.parquet")
    assert build(tmp_path, tmp_path / "hats", more).equals(rows)


def test_a_region_without_galaxies_is_an_empty_table(tmp_path):
    values = synthetic.columns()
    values["ra"] += 90.0
    values["ra_lensed"] += 90.0
    rows = build(tmp_path, synthetic.write(tmp_path, "flagship2", values), 'format = "flagship2"')
    assert rows.num_rows == 0
    assert validate.find_violations(rows, GALAXIES) == []


def broken(values, key, row, value):
    values[key] = values[key].copy()
    values[key][row] = value
    return values


@nightly.parametrize(
    ("key", "row", "value", "column"),
    [
        ("ra", 41, np.nan, "ra_gal"),
        ("dec", 7, 95.0, "dec_gal"),
        ("z_true", 0, np.inf, "true_redshift_gal"),
        ("abs_mag_r01", 299, np.nan, "abs_mag_r01"),
        ("kind", 12, 9, "kind"),
        ("ext_law_1", 12, 9, "ext_curve_cosmos_1"),
    ],
    (0, 4),
)
def test_a_wrong_value_is_named(tmp_path, key, row, value, column):
    path = synthetic.write(tmp_path, "flagship2", broken(synthetic.columns(), key, row, value))
    with pytest.raises(BadInput, match=rf"synthetic\.parquet: column {column} .*of row {row + 1} is"):
        build(tmp_path, path, 'format = "flagship2"')
    assert not list((tmp_path / "lake").glob("galaxies/v-*"))


def test_an_identifier_twice_is_named(tmp_path):
    values = synthetic.columns()
    values = broken(values, "origin_id", 200, values["origin_id"][3])
    path = synthetic.write(tmp_path, "flagship2", values)
    with pytest.raises(BadInput, match=r"column unique_gal_id: the value \d+ is in rows 4 and 201, but every value"):
        build(tmp_path, path, 'format = "flagship2"')


@pytest.mark.parametrize("form", FORMATS)
def test_a_file_that_is_cut_short(tmp_path, form):
    path = synthetic.write(tmp_path, form)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    arguments = ["--lake", str(tmp_path / "lake"), "--request", str(asked(tmp_path, path, f'format = "{form}"'))]
    assert submitted_job.main(build_galaxies.JOB, arguments) != 0
    assert not list((tmp_path / "lake").glob("galaxies/v-*"))


def test_rows_beside_must_be_the_same_galaxies(tmp_path):
    path = synthetic.write(tmp_path, "skycatalogs")
    other = tmp_path / "galaxy_flux_1.parquet"
    table = pq.read_table(other)
    pq.write_table(table.take([1, 0, *range(2, 300)]), other)
    with pytest.raises(BadInput, match=r"galaxy_flux_1\.parquet: column galaxy_id of row 1 "):
        build(tmp_path, path, 'format = "skycatalogs"')
    pq.write_table(table.slice(0, 250), other)
    with pytest.raises(BadInput, match="ends before row 251"):
        build(tmp_path, path, 'format = "skycatalogs"')


def test_a_unit_that_the_file_itself_denies(tmp_path):
    path = synthetic.write(tmp_path, "flagship2")
    table = pq.read_table(path)
    field = table.schema.field("ra_gal").with_metadata({"unit": "rad"})
    pq.write_table(table.set_column(table.schema.get_field_index("ra_gal"), field, table["ra_gal"]), path)
    with pytest.raises(BadInput, match=r"column ra_gal \(ra\) has unit 'rad', but the mapping has 'deg'"):
        build(tmp_path, path, 'format = "flagship2"')


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('format = "flagship3"', "flagship3"),
        ('format = "flagship2"\ncolumns = { colour = "x" }', "columns.colour"),
        ('columns = { ra = "ra" }', "must have dec"),
        ('format = "flagship2"\ncolumns = { ra = { column = "ra", times = 2.0 } }', "columns.ra.times"),
        ('format = "flagship2"\ncolumns = { gamma2 = "" }', "kappa requires gamma2"),
    ],
)
def test_a_mapping_that_does_not_fit(tmp_path, more, said):
    with pytest.raises(BadInput, match=said):
        build(tmp_path, synthetic.write(tmp_path, "flagship2"), more)


# ------------------------------------------------------------------------------------------------ OpenCosmo


def test_a_diffsky_mock_comes_through(tmp_path):
    slices = [opencosmo.columns(seed=seed) for seed in (1, 2)]
    rows = build(tmp_path, opencosmo.write(tmp_path / "mock.hdf5", *slices), 'format = "opencosmo"')
    assert validate.find_violations(rows, GALAXIES) == []
    given = {name: np.concatenate([one[name] for one in slices]) for name in slices[0]}
    order = np.argsort(given["gal_id"])
    found = rows.sort_by("origin_id")
    assert found["origin_id"].to_pylist() == given["gal_id"][order].tolist()
    z = given["redshift_true"][order]
    arcsec = given["r50_disk_2d"][order] / FIDUCIAL.kpc_per_arcsec(z)
    for name, wanted in {
        "ra": given["ra"][order],
        "z_obs": given["redshift_obs"][order],
        "kind": 1 - given["central"][order],
        "log_sfr": (given["logssfr_obs"] + given["logsm_obs"])[order],
        "log_halo_mass": given["logmp_obs_host"][order] + np.log10(0.6766),
        "disk_half_light_radius": arcsec,
        "disk_axis_ratio": (given["beta_disk"] / given["alpha_disk"])[order],
    }.items():
        assert found[name].to_numpy() == pytest.approx(wanted, rel=1e-4, abs=1e-4), name
    # Magnitudes are of the continuum: lines are drawn.
    bare = found.drop_columns([name for name in found.column_names if name.startswith("flux_")])
    light = band_fluxes.galaxy_fluxes(bare, ["lsst_r"], templates.galaxy_library())["f_nu_lsst_r"].to_numpy()
    unseen = light / sources.table_magnification(found)
    dust = 0.87 * found["a_v"].to_numpy()
    mag = 23.9 - 2.5 * np.log10(unseen) - dust
    assert mag == pytest.approx(given["lsst_r"][order], abs=0.1)
    assert np.median(np.abs(mag - given["lsst_r"][order])) < 0.02


@nightly.parametrize(
    ("name", "value", "said"),
    [
        ("lsst_r", np.nan, r"column lsst_r \(mag\) of row 8 is NaN"),
        ("redshift_true", -0.3, r"column redshift_true \(z_true\) of row 8 is -0.3"),
        ("beta_disk", 0.0, r"column beta_disk and alpha_disk \(disk_axis_ratio\) of row 8 is 0"),
    ],
    (2,),
)
def test_a_wrong_value_of_a_mock_is_named(tmp_path, name, value, said):
    values = opencosmo.columns()
    values[name][7] = value
    with pytest.raises(BadInput, match=rf"mock\.hdf5: {said}"):
        build(tmp_path, opencosmo.write(tmp_path / "mock.hdf5", values), 'format = "opencosmo"')


def test_another_unit_of_a_mock_is_named(tmp_path):
    path = opencosmo.write(tmp_path / "mock.hdf5", opencosmo.columns(), units={**opencosmo.UNITS, "r50_disk_2d": "Mpc"})
    with pytest.raises(BadInput, match=r"r50_disk_2d .* has unit 'Mpc', but the mapping has 'kpc'"):
        build(tmp_path, path, 'format = "opencosmo"')


@nightly.parametrize("form", ["flagship2", "euclid"], (1,))
def test_all_missing_columns_are_named_at_once(tmp_path, form):
    path = synthetic.write(tmp_path, form)
    fields = mapping.formats()[form]["columns"]
    gone = [fields["kappa"], fields["position_angle"], fields["z_obs"]]
    if form == "euclid":
        table = Table.read(path)
        table.remove_columns(gone)
        table.write(path, overwrite=True)
    else:
        pq.write_table(pq.read_table(path).drop_columns(gone), path)
    with pytest.raises(BadInput) as caught:
        build(tmp_path, path, f'format = "{form}"')
    keys = ("kappa", "position_angle", "z_obs")
    assert all(
        any(line.startswith(f"ingest.galaxies.columns.{key}: ") for line in caught.value.messages) for key in keys
    )
    said = [line.partition("; it has")[0].partition("has no column ")[2] for line in caught.value.messages]
    assert {text.partition(" (did you mean ")[0] for text in said} == set(gone)
