"""Tycho-2 in the place of the model's bright stars: read as it is published, handed over without gap or overlap."""

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput, Damaged
from tests.truesky.catalogue.conftest import SEED
from truesky.catalogue.stars import bright_stars, stars
from truesky.fluxes.libraries import stellar

TYPES = stellar.types()
CELL = 402_512
# Two records of the catalogue as published: the second has no mean position; and one of the supplement.
MEAN = (
    "0001 00008 1| |  2.31750494|  2.23184345|  -16.3|   -9.0| 68| 73| 1.7| 1.8|1958.89|1951.94| 4|1.0|1.0|0.9|1.0|"
    "12.146|0.158|12.146|0.223|999| |         |  2.31754222|  2.23186444|1.67|1.54| 88.0|100.8| |-0.2"
)
OBSERVED = (
    "0001 00013 1|X|            |            |       |       |   |   |    |    |       |       |  |   |   |   |   |"
    "10.488|0.038| 8.670|0.015|999|T|         |  1.12551111|  2.26708611|1.72|1.50|  9.3| 12.7| |-0.2"
)
SUPPLEMENT = (
    "0002 01137 1|H|  2.23184345| -1.31750494|   12.3|   -4.1|  2.1|  1.7|  2.2|  1.9| | 5.340|0.005| 4.995|0.009|999|"
    "T|    88 "
)


def written(path, *records, end="\n"):
    path.write_bytes((end.join(records) + end).encode())
    return path


def loaded(*files):
    return bright_stars.load(files, bright_stars.sha256(files))


def record(ra="  2.31750494", dec="  2.23184345", bt=" 9.000", vt=" 8.000"):
    fields = MEAN.split("|")
    fields[2], fields[3], fields[17], fields[19] = ra, dec, bt, vt
    return "|".join(fields)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_records_as_they_are_published(tmp_path, end):
    main = written(tmp_path / "tyc2.dat", MEAN, OBSERVED, record(), end=end)
    found = loaded(main, written(tmp_path / "suppl_1.dat", SUPPLEMENT, end=end))
    assert (found.record_count, found.without_color, found.without_magnitude) == (4, 0, 0)
    order = np.argsort(found.mag_v)
    # V = 12.1 is left to the model.
    assert found.mag_v[order] == pytest.approx([4.995 - 0.09 * 0.345, 8.0 - 0.09, 8.67 - 0.09 * 1.818])
    assert found.color_bv[order] == pytest.approx([0.85 * 0.345, 0.85, 0.85 * 1.818])
    assert found.ra[order] == pytest.approx([2.23184345, 2.31750494, 1.12551111])
    assert found.dec[order] == pytest.approx([-1.31750494, 2.23184345, 2.26708611])
    assert np.all(np.diff(found.index) > 0)


def test_blank_magnitudes(tmp_path):
    blank = "      "
    main = written(tmp_path / "tyc2.dat", record(bt=blank), record(vt=blank), record(bt=blank, vt=blank))
    found = loaded(main)
    assert (found.record_count, found.without_color, found.without_magnitude) == (3, 2, 1)
    assert found.mag_v == pytest.approx([8.0 - 0.063, 9.0 - 0.7 - 0.063])


def test_the_fits_form_says_the_same(tmp_path):
    text = loaded(written(tmp_path / "tyc2.dat", OBSERVED, record()))
    table = Table(
        {
            "RAmdeg": [np.nan, 2.31750494],
            "DEmdeg": [np.nan, 2.23184345],
            "RA(ICRS)": [1.12551111, 0.0],
            "DE(ICRS)": [2.26708611, 0.0],
            "BTmag": np.array([10.488, 9.0]),
            "VTmag": np.array([8.67, 8.0]),
            "TYC1": [1, 1],
            "pflag": ["X", " "],
        }
    )
    table.write(tmp_path / "tyc2.fits")
    found = loaded(tmp_path / "tyc2.fits")
    for name in ("index", "ra", "dec", "mag_v", "color_bv"):
        assert np.array_equal(getattr(found, name), getattr(text, name))
    table["V"] = table["VTmag"]
    table.remove_column("VTmag")
    table.write(tmp_path / "other.fits")
    with pytest.raises(BadInput, match=r"other.fits: has no column VTmag or VT"):
        loaded(tmp_path / "other.fits")
    whole = (tmp_path / "tyc2.fits").read_bytes()
    (tmp_path / "short.fits").write_bytes(whole[:6000])
    with pytest.raises((BadInput, Damaged), match=r"short\.fits"):
        loaded(tmp_path / "short.fits")


@pytest.mark.parametrize(
    ("records", "words"),
    [
        ([MEAN, record(bt=" 9.x00")], "record 2: '9.x00' is not a number .1 bad record"),
        ([MEAN, record(dec=" 92.23184345")], "record 2 lies at 2.3175, 92.2318"),
        ([MEAN, record(bt="-1e300")], "B_T of record 2 is -1e.300, but must be from -3 to 20 mag"),
        ([record(vt=" 1e999")], "V_T of record 1 is inf, but must be"),
        ([record(vt="   nan")], "record 1: 'nan' is not a number"),
        ([MEAN, MEAN[:100]], "Expected 32 columns"),
        (["a,b,c"], "records have 1 fields between bars, must have 32"),
        ([MEAN + " " * 1000 + "|" * 5000], "the first record has 1000 characters or more"),
    ],
)
def test_bad_records_are_named(tmp_path, records, words):
    with pytest.raises(BadInput, match=words) as caught:
        loaded(written(tmp_path / "tyc2.dat", *records))
    assert "tyc2.dat" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_file():
    with pytest.raises(BadInput, match=r"stars.tycho2: .*no such file"):
        bright_stars.sha256((Path("/nowhere/tyc2.dat"),))


@given(st.lists(st.tuples(st.floats(2.0, 14.0), st.floats(-0.3, 2.0)), min_size=1, max_size=50))
def test_every_star_of_the_catalogue_has_the_type_of_its_colour(found):
    v, bv = np.array(found).T
    n = len(v)
    order = np.arange(n)
    bright = bright_stars.BrightStars(11.0, order, np.zeros(n), np.zeros(n), v, bv, n, 0, 0)
    columns = bright_stars.columns(bright, slice(0, n), TYPES)
    assert columns["mag_h"] + TYPES.v_minus_h[columns["sed"]] == pytest.approx(v)
    off = np.abs(TYPES.color_bv[columns["sed"]] - bv)
    assert np.all(off <= np.abs(TYPES.color_bv[:, None] - bv).min(0) + 1e-12)


def sky_of(model_stars, universe):
    """A Tycho-2 of the model's own stars: what the catalogue would hold if the sky were the model's."""
    lot = {name: model_stars[name].to_numpy().astype(float) for name in ("mag_h", "a_v")}
    lot["sed"] = model_stars["sed"].to_numpy()
    lot |= {
        f"{name}_{k}": model_stars[f"{name}_{k}"].fill_null(0).to_numpy() for k in (2, 3, 4) for name in ("sed", "frac")
    }
    v = stars.mag_v(universe, lot)
    return v, v - lot["a_v"]


def test_the_hand_over_has_no_gap_and_no_overlap(tmp_path, dust):
    """The model's bright stars, written as Tycho-2 and read back, leave the counts as they were around V = 11."""
    cells = range(CELL, CELL + 48)
    plain = stars.model(13.5, brown_dwarf_boost=0.0)
    before = {cell: stars.draw(cell, SEED, plain, dust) for cell in cells}
    records, truth = [], []
    for rows in before.values():
        v, _ = sky_of(rows, plain)
        bv = plain.types.color_bv[stars.nearest_template(plain.types.teff, rows["teff"].to_numpy())]
        truth.append(v)
        for ra, dec, mag, color in zip(rows["ra"].to_numpy(), rows["dec"].to_numpy(), v, bv, strict=True):
            if mag < 12.5:
                vt = mag + 0.09 * color / 0.85
                records.append(record(f"{ra:12.8f}", f"{dec:12.8f}", f"{vt + color / 0.85:6.3f}", f"{vt:6.3f}"))
    files = (written(tmp_path / "tyc2.dat", *records),)
    joined = stars.model(13.5, brown_dwarf_boost=0.0, bright=bright_stars.load(files, bright_stars.sha256(files)))
    both, handed = [], 0
    for cell in cells:
        rows = stars.draw(cell, SEED, joined, dust)
        v, _ = sky_of(rows, joined)
        catalogued = rows["component"].to_numpy() == stars.BRIGHT
        assert np.all(catalogued == (v < 11.0005))
        assert np.all(rows["a_v"].to_numpy()[catalogued] == 0.0)
        assert np.unique(rows["id"].to_numpy()).size == len(rows)
        assert np.all(np.diff(rows["_healpix_29"].to_numpy()) >= 0)
        both.append(v)
        handed += catalogued.sum()
    edges = np.arange(8.0, 13.1, 0.5)
    wanted, found = (np.histogram(np.concatenate(values), edges)[0] for values in (truth, both))
    assert handed > 15
    # Magnitudes are rounded to 0.001 mag in the file.
    assert np.abs(found - wanted).max() <= 1
    assert found.sum() == pytest.approx(wanted.sum(), abs=1)


def test_model_stars_beyond_the_hand_over_stay_as_they_were(tmp_path, dust):
    empty = loaded(written(tmp_path / "tyc2.dat", MEAN))
    plain, joined = stars.model(14.0), stars.model(14.0, bright=empty)
    before, after = (stars.draw(CELL, SEED, universe, dust) for universe in (plain, joined))
    v, _ = sky_of(before.filter(before["component"].to_numpy() != stars.BROWN), plain)
    assert len(before) - len(after) == np.sum(v < 11)
    kept = np.isin(before["id"].to_numpy(), after["id"].to_numpy())
    assert before.filter(kept).equals(after)
    assert sky.cell_at(empty.ra, empty.dec, 8).size == 0
