"""Bytes of FITS_LDAC files."""

import warnings

import numpy as np
import pytest
from astropy.io import fits

from lake_schema.fits import ldac

LONG = "long: on, margin " * 8


@pytest.mark.parametrize("cards", [(), (("EXPTIME", 90.0, "[s]"), ("TEXT", LONG, ""), ("NAME", "it's", ""))])
def test_the_header_of_a_field_is_stored_as_cards(tmp_path, cards):
    """Cards have 80 characters, padded with spaces, and the checksums fit the stored bytes."""
    path = tmp_path / "a.cat"
    ldac.write(path, [("NUMBER", "J", "", np.arange(3)), ("X_IMAGE", "D", "pixel", np.arange(3.0))], cards)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with fits.open(path, checksum=True) as units:
            units.verify("exception")
            assert [unit.name for unit in units] == ["PRIMARY", "LDAC_IMHEAD", "LDAC_OBJECTS"]
            where, width = units[1].fileinfo()["datLoc"], units[1].header["NAXIS1"]
            assert units[1].header["TDIM1"].replace(" ", "") == f"(80,{width // 80})"
            assert units[2].data["X_IMAGE"].tolist() == [0.0, 1.0, 2.0]
    text = path.read_bytes()[where : where + width].decode("ascii")
    assert (len(text) % 80, text[-80:]) == (0, "END".ljust(80))
    header = fits.Header.fromstring(text)
    assert [header[key] for key, *_ in cards] == [value.strip() if key == "TEXT" else value for key, value, _ in cards]
