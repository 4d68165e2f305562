"""Gaia's measurements: published errors, the same result for a star in any file, no star lost at an edge."""

import numpy as np
import pyarrow as pa
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import ids, sky, units
from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read, validate
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.gaia import EXPORT, GAIA
from lake_schema.tables.stars import EPOCH, STARS
from lake_schema.tables.stars import stars as star_table
from tests import hats_readers
from tests.universe import rows_of
from truesky.catalogue import build_gaia, parameters
from truesky.catalogue.exports import gaia_archive
from truesky.catalogue.stars import gaia
from truesky.commands import __main__ as truesky
from truesky.fluxes import passbands
from truesky.fluxes.libraries.vega import vega_magnitude
from truesky.request.from_toml import from_table

VEGA = gaia.ab_minus_vega()


def test_the_table_has_the_epoch_of_the_stars():
    assert parameters.section("gaia.toml", "astrometry")["epoch"] == EPOCH


MAS = 1 / 3.6e6


def stars_of(g, bp_rp=1.0, distance=500.0, place=(40.0, 30.0), seed=1):
    """n stars of magnitude G and colour, within 0.2 deg: rows of both tables' columns."""
    n = len(g)
    rng = np.random.default_rng(seed)
    ra, dec = place[0] + 0.2 * rng.uniform(-1, 1, n), place[1] + 0.2 * rng.uniform(-1, 1, n)
    columns = {"id": (5 << 60) + np.arange(n), "ra": ra, "dec": dec, "distance": np.full(n, distance)}
    columns |= dict(zip(("pm_ra", "pm_dec"), rng.normal(0.0, 8.0, (2, n)).astype(np.float32), strict=True))
    mags = np.stack([g, g + 0.5 * bp_rp, g - 0.5 * bp_rp])
    flux = {f"f_nu_{b}": units.f_nu_of_mag(m + v) for b, m, v in zip(gaia.BANDS, mags, VEGA, strict=True)}
    return pa.table(columns), pa.table(flux)


def test_the_zero_points_are_vega_s():
    """To the few per cent by which its spectrum in use is fainter at 5500 A than the one of Gaia's definition."""
    ours = np.array([vega_magnitude(passbands.load(band)) for band in gaia.BANDS])
    assert pytest.approx([0.105, 0.03, 0.36], abs=0.01) == VEGA
    assert ours - VEGA == pytest.approx(0.03, abs=0.025)


@pytest.mark.parametrize(("g", "published"), [(15.0, 0.037), (17.0, 0.098), (20.0, 0.765), (21.0, 1.79)])
def test_errors_of_parallax(g, published):
    """mas; Lindegren et al. 2018 give 0.04, 0.1, 0.7 and 2."""
    ra, dec, parallax = gaia.astrometric_errors(np.array([g]))
    assert parallax == pytest.approx(published, rel=0.1)
    assert ra / parallax == pytest.approx(0.8)
    assert dec / parallax == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("g", "parallax_mas", "g_mag"), [(15.0, 0.037, 8.5e-4), (17.0, 0.098, 2e-3), (20.0, 0.765, 0.01)]
)
def test_measurements_have_the_stated_errors(g, parallax_mas, g_mag):
    """Sample of 20,000 stars; significance 6e-7 of means (5 standard errors); errors within 5 %."""
    n = 20_000
    stars, flux = stars_of(np.full(n, g))
    found = gaia.observe(stars, flux, 7)
    listed = found["id"].to_numpy() - (5 << 60)
    assert len(listed) == n
    ra, dec = (stars[name].to_numpy()[listed] for name in ("ra", "dec"))
    east = (found["ra"].to_numpy() - ra) * np.cos(np.radians(dec)) / MAS
    north = (found["dec"].to_numpy() - dec) / MAS
    assert east.std() == pytest.approx(0.8 * parallax_mas, rel=0.05)
    assert north.std() == pytest.approx(0.7 * parallax_mas, rel=0.05)
    assert (found["parallax"].to_numpy() - 2.0).std() == pytest.approx(parallax_mas, rel=0.05)
    off = found["phot_g_mean_mag"].to_numpy() - g
    assert off.std() == pytest.approx(g_mag, rel=0.1)
    assert np.median(found["phot_g_mean_flux_over_error"].to_numpy()) == pytest.approx(1.0857 / off.std(), rel=0.1)
    assert abs(off.mean()) < 5 * g_mag / n**0.5
    assert abs(east.mean()) < 5 * parallax_mas / n**0.5
    ab = found["mag_g_ab"].to_numpy() - found["phot_g_mean_mag"].to_numpy()
    assert ab == pytest.approx(VEGA[0], abs=1e-5)


def test_red_stars_are_worse_in_bp():
    stars, flux = stars_of(np.full(5000, 18.0), bp_rp=4.0)
    found = gaia.observe(stars, flux, 7)
    snr = {band: np.median(found[f"phot_{band}_mean_flux_over_error"].to_numpy()) for band in ("bp", "rp")}
    assert snr["bp"] == pytest.approx(1.0857 / 0.2, rel=0.05)
    assert snr["rp"] > 15 * snr["bp"]


def test_a_flux_below_zero_has_no_magnitude():
    stars, flux = stars_of(np.full(5000, 19.5), bp_rp=6.0)
    found = gaia.observe(stars, flux, 7)
    missing = found["phot_bp_mean_mag"].null_count
    assert 100 < missing < 2500
    assert found["mag_bp_ab"].null_count == found["phot_bp_mean_flux_over_error"].null_count == missing
    assert found["phot_g_mean_mag"].null_count == 0
    assert validate.find_violations(found, GAIA) == []


def test_completeness():
    law = gaia.completeness([10.0, 20.0, 21.0, 21.15, 22.0])
    assert law == pytest.approx([1.0, 1.0, 0.5, 0.159, 0.0], abs=1e-3)
    stars, flux = stars_of(np.full(4000, 21.0))
    assert len(gaia.observe(stars, flux, 7)) == pytest.approx(2000, abs=5 * 32)


def test_a_star_without_a_distance_has_no_parallax():
    stars, flux = stars_of(np.full(20, 9.0))
    stars = stars.set_column(3, "distance", pa.nulls(20, pa.float64()))
    stars = stars.set_column(4, "pm_ra", pa.nulls(20, pa.float32()))
    found = gaia.observe(stars, flux, 7)
    assert found["parallax"].null_count == found["pmra"].null_count == 20
    assert found["pmdec"].null_count == 0
    assert found["parallax_error"].null_count == 0


@given(st.sets(st.integers(0, 199), min_size=1), st.integers(0, 5))
def test_a_measurement_does_not_depend_on_other_stars(chosen, seed):
    stars, flux = stars_of(np.linspace(10.0, 21.5, 200))
    whole = gaia.observe(stars, flux, seed)
    rows = pa.array(sorted(chosen))
    alone = gaia.observe(stars.take(rows), flux.take(rows), seed)
    assert whole.filter(np.isin(whole["id"].to_numpy(), [(5 << 60) + i for i in chosen])).equals(alone)


def test_near_a_pole_positions_stay_on_the_sky():
    stars, flux = stars_of(np.full(500, 20.0))
    stars = stars.set_column(2, "dec", pa.array(np.full(500, 90.0 - 1e-7)))
    found = gaia.observe(stars, flux, 7)
    assert validate.find_violations(found, GAIA) == []
    apart = sky.separation(found["ra"].to_numpy(), found["dec"].to_numpy(), 0.0, 90.0) / MAS
    assert apart.max() < 6.0


# ------------------------------------------------------------------------------------------------ the job

# Two cells meet here. Every star is within 2 mas of their edge at G = 21, where the error has this size.
EDGE = 1607, 1608
BANDS = list(gaia.BANDS)


def edge_stars():
    corners = sky.cell_corners(5, [EDGE[0]])[0]
    rng = np.random.default_rng(3)
    centre = corners[0]
    n = 4000
    along = rng.uniform(-300, 300, n)
    step = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    place = centre + MAS * (along[:, None] * step + rng.normal(0.0, 1.5, (n, 2)))
    return place[:, 0] % 360, place[:, 1]


def filled(lake, variables=False):
    ra, dec = edge_stars()
    index = sky.healpix_29(ra, dec)
    order = np.argsort(index)
    ra, dec, index = ra[order], dec[order], index[order]
    files = np.unique(index >> 48).tolist()
    assert len(files) >= 2
    flux_table, declared = fluxes("star", BANDS), star_table(variables)

    def stars(root, facts):
        here = np.flatnonzero(index >> 48 == facts["cell"])
        rows = rows_of(STARS, here.size, 1)
        given_columns = {"_healpix_29": index[here], "ra": ra[here], "dec": dec[here]}
        given_columns["id"] = ids.source_id(5, facts["cell"] << 6, here)
        given_columns["distance"] = np.full(here.size, 1000.0)
        given_columns |= {"pm_ra": np.full(here.size, 3.0), "pm_dec": np.full(here.size, -7.0)}
        if variables:
            given_columns |= {"variability": [1 if row % 2 else None for row in here]}
            given_columns |= {"amplitude": [0.01 * (row % 4) if row % 2 else None for row in here]}
        return Output(declared.build({name: rows[name] for name in STARS.names} | given_columns))

    def beside(root, facts):
        rows = read.version(root, "stars").rows(partitions=[layout.cell_file(5, facts["cell"])])
        flux = {f"f_nu_{b}": np.full(len(rows), units.f_nu_of_mag(20.5 + v)) for b, v in zip(BANDS, VEGA, strict=True)}
        flux["integrated"] = np.zeros(len(rows), bool)
        return Output(flux_table.build({name: rows[name] for name in ("id", "ra", "dec", "_healpix_29")} | flux))

    parts = tuple(Task(layout.cell_file(5, cell), {"cell": cell}) for cell in files)
    seen = {"variables": True} if variables else {}
    publish.make_version(lake, Plan(declared, {"seed": asked().seed, **seen}, parts), stars)
    publish.make_version(lake, Plan(flux_table, {"input": read.version(lake, "stars").key}, parts), beside)
    return index


def asked(**universe):
    area = {"cone": {"ra": 10.0, "dec": 10.0, "radius": 1.0}}
    return from_table({"name": "x", "seed": 7, "area": area, "fluxes": {"bands": BANDS}, "universe": universe})


def built(lake, **universe):
    (step,) = build_gaia.steps(lake, asked(**universe))
    publish.make_version(lake, step.plan, step.run_task)
    return read.version(lake, "gaia")


def test_stars_measured_in_another_cell_are_listed_once(lake):
    index = filled(lake)
    version = built(lake)
    rows = version.rows()
    assert hats_readers.is_valid(version.folder)
    stars = read.version(lake, "stars").rows(gaia.STAR_COLUMNS)
    flux = read.version(lake, "star_fluxes").rows(gaia.FLUX_COLUMNS)
    wanted = gaia.observe(stars, flux, 7)
    assert rows.equals(wanted)
    was = dict(zip(stars["id"].to_pylist(), (index >> 48).tolist(), strict=True))
    moved = sum(
        was[i] != cell
        for i, cell in zip(rows["id"].to_pylist(), (rows["_healpix_29"].to_numpy() >> 48).tolist(), strict=True)
    )
    assert moved > 300


def exported(words):
    return truesky.main(["export", "gaia", *words])


def test_files_under_gaia_s_own_names(lake, tmp_path, capsys):
    filled(lake)
    rows = built(lake).rows()
    assert exported([str(lake), "--out", str(tmp_path / "gaia.csv")]) == 0
    assert f"{len(rows):,} stars" in capsys.readouterr().out
    text = np.genfromtxt(tmp_path / "gaia.csv", delimiter=",", names=True, dtype=None, encoding=None, max_rows=50)
    names = ["source_id", "ref_epoch", "ra", "dec", "ra_error", "dec_error", "parallax", "parallax_error"]
    assert list(text.dtype.names) == EXPORT.names
    assert EXPORT.names[:8] == ["source_id", "ref_epoch", "ra", "dec", *names[4:]]
    assert text["source_id"].tolist() == rows["id"].to_pylist()[:50]
    assert text["ra"] == pytest.approx(rows["ra"].to_numpy()[:50], abs=1e-12)
    assert set(text["ref_epoch"]) == {2015.5}
    assert exported([str(lake), "--out", str(tmp_path / "gaia.fits")]) == 0
    table = fits.getdata(tmp_path / "gaia.fits", 1)
    assert table["source_id"].tolist() == rows["id"].to_pylist()
    colour = table["phot_bp_mean_mag"] - table["phot_rp_mean_mag"]
    known = np.isfinite(colour)
    assert known.mean() > 0.9
    assert table["bp_rp"][known] == pytest.approx(colour[known], abs=1e-5)
    assert fits.getheader(tmp_path / "gaia.fits", 1)["TUNIT5"] == "mas"
    assert exported([str(lake), "--out", str(tmp_path / "gaia.txt")]) == 2
    assert "must end in .csv" in capsys.readouterr().err
    assert exported([str(tmp_path), "--out", str(tmp_path / "g.csv")]) == 2
    assert not (tmp_path / "g.csv").exists()


def test_missing_inputs_are_named(lake):
    with pytest.raises(BadInput, match=r"has no tables: run truesky run REQUEST .*, or first truesky build$"):
        build_gaia.steps(lake, asked())
    filled(lake)
    flux = fluxes("star", ["lsst_r"])
    rows = {
        "f_nu_lsst_r": np.zeros(0),
        "integrated": np.zeros(0, bool),
        **{name: np.zeros(0, flux.column(name).type) for name in ("id", "ra", "dec", "_healpix_29")},
    }
    part = (Task(layout.cell_file(5, 1607), {}),)
    publish.make_version(lake, Plan(flux, {}, part), lambda root, facts: Output(flux.build(rows)))
    with pytest.raises(BadInput, match=r"no column f_nu_gaia_g, .* into fluxes\.bands and run truesky fluxes"):
        build_gaia.steps(lake, asked())


# ------------------------------------------------------------------------------------------------ proper motions


def test_proper_motions_change_no_other_column():
    """Each quantity has separate random numbers, so that stars without proper motions are measured in the same way."""
    stars, flux = stars_of(np.linspace(10.0, 21.5, 200))
    listed = gaia.observe(stars, flux, 7)
    moved = pa.array(np.linspace(-900.0, 900.0, 200, dtype=np.float32))
    unknown = pa.nulls(200, pa.float32())
    motions = {"pmra", "pmra_error", "pmdec", "pmdec_error"}
    for values in (moved, unknown):
        for name in ("pm_ra", "pm_dec"):
            stars = stars.set_column(stars.column_names.index(name), name, values)
        again = gaia.observe(stars, flux, 7)
        assert [n for n in listed.column_names if not listed[n].equals(again[n])] == sorted(
            motions & set(listed.column_names), key=listed.column_names.index
        )[:: 1 if values is unknown else 2]


@pytest.mark.parametrize(("g", "published"), [(15.0, 0.06), (17.0, 0.2), (20.0, 1.2)])
def test_errors_of_proper_motions(g, published):
    """mas/yr, Lindegren et al. 2018; measurements have the stated errors, not correlated with other quantities.

    Sample of 20,000 stars; significance 6e-7 of correlations (5 standard errors).
    """
    n = 20_000
    east, north = gaia.proper_motion_errors(np.array([g]))
    assert (east + north) / 2 == pytest.approx(published, rel=0.3)
    stars, flux = stars_of(np.full(n, g))
    found = gaia.observe(stars, flux, 7)
    place = [stars[name].to_numpy()[found["id"].to_numpy() - (5 << 60)] for name in ("ra", "dec")]
    true = [stars[name].to_numpy()[found["id"].to_numpy() - (5 << 60)] for name in ("pm_ra", "pm_dec")]
    off = [found[name].to_numpy() - own for name, own in zip(("pmra", "pmdec"), true, strict=True)]
    assert off[0].std() == pytest.approx(east[0], rel=0.05)
    assert off[1].std() == pytest.approx(north[0], rel=0.05)
    noise = [*off, found["parallax"].to_numpy() - 2.0]
    apart = [(found["ra"].to_numpy() - place[0]) * np.cos(np.radians(place[1])), found["dec"].to_numpy() - place[1]]
    correlation = np.corrcoef([*noise, *apart])
    assert np.abs(correlation - np.eye(5)).max() < 5 / n**0.5
    ruwe = found["ruwe"].to_numpy()
    assert ruwe.mean() == pytest.approx(1.0, abs=0.01)
    assert ruwe.std() == pytest.approx(0.05, rel=0.05)


def test_names_of_dr3_in_its_order_and_fluxes_that_are_the_magnitudes(lake, tmp_path):
    filled(lake)
    rows = built(lake).rows()
    path = tmp_path / "dr3.fits"
    assert exported([str(lake), "--out", str(path), "--release", "dr3"]) == 0
    table = fits.getdata(path, 1)
    of_five = ["ra", "ra_error", "dec", "dec_error", "parallax", "parallax_error", "parallax_over_error", "pm", "pmra"]
    assert table.names[:13] == ["source_id", "ref_epoch", *of_five, "pmra_error", "pmdec"]
    assert sum(name.endswith("_corr") for name in table.names) == 10
    assert table.names[-1] == "bp_rp"
    assert np.array_equal(table["pmra"], rows["pmra"].to_numpy())
    assert table["pm"] == pytest.approx(np.hypot(table["pmra"], table["pmdec"]), rel=1e-6)
    assert set(table["astrometric_params_solved"]) == {31}
    assert not table["pmra_pmdec_corr"].any()
    for band, zero in (("g", 25.6884), ("bp", 25.3514), ("rp", 24.7619)):
        mag, flux = table[f"phot_{band}_mean_mag"], table[f"phot_{band}_mean_flux"]
        known = np.isfinite(mag)
        assert flux[known] == pytest.approx(10 ** (0.4 * (zero - mag[known].astype(float))), rel=1e-6)
        over = table[f"phot_{band}_mean_flux_over_error"][known]
        assert flux[known] / table[f"phot_{band}_mean_flux_error"][known] == pytest.approx(over, rel=1e-5)


def test_positions_at_another_epoch_agree_with_astropy(lake, tmp_path):
    filled(lake)
    rows = built(lake).rows()
    gaia_archive.write(lake, tmp_path / "moved.fits", epoch=2027.5)
    moved = fits.getdata(tmp_path / "moved.fits", 1)
    assert set(moved["ref_epoch"]) == {2027.5}
    there = SkyCoord(
        rows["ra"].to_numpy() * u.deg,
        rows["dec"].to_numpy() * u.deg,
        pm_ra_cosdec=rows["pmra"].to_numpy() * u.mas / u.yr,
        pm_dec=rows["pmdec"].to_numpy() * u.mas / u.yr,
        obstime=Time(2015.5, format="jyear"),
    ).apply_space_motion(Time(2027.5, format="jyear"))
    apart = sky.separation(there.ra.deg, there.dec.deg, moved["ra"], moved["dec"]) / MAS
    assert apart.max() < 1e-2
    assert sky.separation(moved["ra"], moved["dec"], rows["ra"].to_numpy(), rows["dec"].to_numpy()).min() > 0.0
    with pytest.raises(BadInput, match=r"^--epoch 20275: give a year from 1900 to 2100$"):
        gaia_archive.write(lake, tmp_path / "never.fits", epoch=20275.0)


def test_ldac_as_scamp_names_it(lake, tmp_path):
    filled(lake)
    rows = built(lake).rows()
    assert exported([str(lake), "--out", str(tmp_path / "gaia.cat"), "--form", "ldac"]) == 0
    with fits.open(tmp_path / "gaia.cat") as units:
        assert [unit.name for unit in units] == ["PRIMARY", "LDAC_IMHEAD", "LDAC_OBJECTS"]
        found = units["LDAC_OBJECTS"].data
        cards = units["LDAC_IMHEAD"].data["Field Header Card"].ravel()
        assert "".join(cards).rstrip().endswith("END")
    assert np.array_equal(found["X_WORLD"], rows["ra"].to_numpy())
    assert np.array_equal(found["Y_WORLD"], rows["dec"].to_numpy())
    assert found["ERRA_WORLD"] == pytest.approx(rows["ra_error"].to_numpy() / 3.6e6, rel=1e-6, abs=0)
    assert found["ERRB_WORLD"] == pytest.approx(rows["dec_error"].to_numpy() / 3.6e6, rel=1e-6, abs=0)
    assert found["PMALPHA_J2000"] == pytest.approx(rows["pmra"].to_numpy(), rel=1e-6)
    assert found["MAGERR"] == pytest.approx(1.0857 / rows["phot_g_mean_flux_over_error"].to_numpy(), rel=1e-4)
    assert set(found["OBSDATE"]) == {2015.5}
    assert exported([str(lake), "--out", str(tmp_path / "gaia.csv"), "--form", "ldac"]) == 2


@pytest.mark.parametrize("release", ["dr2", "dr3"])
def test_variable_stars_have_a_flag(lake, tmp_path, release):
    """Every second star varies, by 0.01 or 0.03 mag. All other columns are those of constant stars."""
    filled(lake)
    constant = built(lake).rows()
    filled(lake, variables=True)
    rows = built(lake, variables=True).rows()
    assert rows.column_names == [*constant.column_names, "phot_variable_flag"]
    assert rows.select(constant.column_names).equals(constant)
    number = rows["id"].to_numpy() >> ids.MEMBER_BITS
    assert len(rows) > 1000
    flags = np.where(number % 4 == 3, "VARIABLE", "NOT_AVAILABLE")
    assert rows["phot_variable_flag"].to_pylist() == flags.tolist()
    for path in (tmp_path / "gaia.csv", tmp_path / "gaia.fits"):
        assert exported([str(lake), "--out", str(path), "--release", release]) == 0
    table = fits.getdata(tmp_path / "gaia.fits", 1)
    assert table.names[-1] == "phot_variable_flag"
    assert table["phot_variable_flag"].tolist() == flags.tolist()
    with open(tmp_path / "gaia.csv") as file:
        assert next(file).strip().endswith('phot_variable_flag"')
        assert flags[0] in next(file)
