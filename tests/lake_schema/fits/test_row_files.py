"""Rows that are written in batches are the table that astropy writes at once."""

import io

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema.columns import Column, Table
from lake_schema.fits import row_files

TABLE = Table(
    "mixed",
    1,
    (
        Column("ID", "int64", doc="identifier"),
        Column("CODE", "int16", doc="code", ucd="meta.code"),
        Column("NUMBER", "int32", doc="number"),
        Column("RA", "float64", "deg", "pos.eq.ra", "right ascension"),
        Column("SIZE", "float32", "arcsec", doc="size"),
    ),
    "A table of all types.",
)


def columns(n):
    rng = np.random.default_rng(n)
    return {
        "ID": rng.integers(-(2**63), 2**63 - 1, n),
        "CODE": rng.integers(-(2**15), 2**15, n),
        "NUMBER": rng.integers(-(2**31), 2**31, n),
        "RA": rng.uniform(0.0, 360.0, n),
        "SIZE": rng.uniform(0.0, 1.0, n),
    }


@settings(max_examples=20)
@given(n=st.integers(0, 200), size=st.integers(1, 90))
def test_any_batches_give_the_data_of_astropy(n, size, tmp_path_factory):
    values, path = columns(n), tmp_path_factory.mktemp("rows") / "x.fits"
    batches = ({name: given[i : i + size] for name, given in values.items()} for i in range(0, n, size))
    assert row_files.write(path, TABLE, batches, (("ORIGIN", "test", "a card"),)) == n
    codes = {"int64": "K", "int16": "I", "int32": "J", "float64": "D", "float32": "E"}
    reference = fits.BinTableHDU.from_columns(
        [fits.Column(c.name, codes[c.type], array=values[c.name], unit=c.unit or None) for c in TABLE.columns]
    )
    whole = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), reference]).writeto(whole)
    found = path.read_bytes()
    data = -(-n * 26 // 2880) * 2880
    assert len(found) % 2880 == 0
    assert found[len(found) - data :] == whole.getvalue()[len(whole.getvalue()) - data :]
    header = fits.getheader(path, 1)
    assert (header["NAXIS2"], header["TUNIT4"], header["TUCD2"]) == (n, "deg", "meta.code")
    assert (header["TCOMM5"], header["ORIGIN"]) == ("size", "test")


def test_a_missing_column_is_null_and_a_missing_integer_leaves_no_file(tmp_path):
    values = columns(3)
    row_files.write(tmp_path / "x.fits", TABLE, [{k: v for k, v in values.items() if k != "SIZE"}])
    assert np.isnan(fits.getdata(tmp_path / "x.fits", 1)["SIZE"]).all()
    with pytest.raises(KeyError, match="CODE"):
        row_files.write(tmp_path / "y.fits", TABLE, [{k: v for k, v in values.items() if k != "CODE"}])
    assert [path.name for path in tmp_path.iterdir()] == ["x.fits"]
