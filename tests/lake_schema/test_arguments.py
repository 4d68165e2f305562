"""Wrong arguments are refused by name, and NumPy numbers are accepted."""

import inspect

import numpy as np
import pytest
from astropy.coordinates import Longitude, SkyCoord
from astropy.units import Quantity

from lake_schema import arguments
from lake_schema.errors import BadInput


def test_good_arguments_are_returned_as_pythons():
    assert arguments.check_number("radius", np.float32(0.5), 0.0, 1.0) == 0.5
    assert type(arguments.check_number("radius", 1, 0.0, 1.0)) is float
    assert type(arguments.check_integer("bins", np.int64(3), 1, 3)) is int
    assert arguments.check_names("columns", "ra") == ("ra",)
    assert arguments.check_names("columns", np.array(["ra", "dec"])) == ("ra", "dec")


@pytest.mark.parametrize("value", [float("nan"), -0.1, 1.1, float("inf"), "0.5", None, [0.5], np.arange(2.0), 10**400])
def test_another_number_is_refused(value):
    with pytest.raises(BadInput, match=r"^radius = .*(outside \[0\.0, 1\.0\]|not a number)$"):
        arguments.check_number("radius", value, 0.0, 1.0)


@pytest.mark.parametrize(
    ("value", "remedy"),
    [
        ("1 arcmin", "got '1 arcmin': write 0.016667"),
        ("30''", "is not a number"),
        ('18"', "write 0.005"),
        ("0.1", "got '0.1' in quotes: write 0.1"),
        ("0.1deg", "write 0.1"),
        ("3 Jy", "is not a number"),
        (Quantity(2.0, "arcmin"), "got 2.0 arcmin: write 0.033333"),
        (Quantity(2.0, "Jy"), "is not a number"),
        (Quantity([1.0, 2.0], "deg"), "is not a number"),
        (Longitude("03:32:48", "hourangle"), "write 53.2"),
        (SkyCoord(53.2, -28.1, unit="deg"), "got a SkyCoord: write c.ra.deg, c.dec.deg"),
        (SkyCoord(53.2, -28.1, unit="deg").galactic, "got a SkyCoord: write c.icrs.ra.deg, c.icrs.dec.deg"),
    ],
)
def test_angles_with_units_are_refused_with_their_number_of_degrees(value, remedy):
    with pytest.raises(BadInput) as caught:
        arguments.check_degrees("radius", value, 0.0, 180.0)
    assert str(caught.value).endswith(remedy)
    assert arguments.check_degrees("radius", 1, 0.0, 180.0) == 1.0


@pytest.mark.parametrize("value", ["30 arcsec", "0.5'", Quantity(0.5, "arcmin"), " 30 arcsec "])
def test_angles_with_units_are_refused_with_their_number_of_arcsec(value):
    with pytest.raises(BadInput, match=r"^size must be a number of arcsec from 0 to 60, got .*: write 30$"):
        arguments.refuse_angle("size", value, "of arcsec from 0 to 60", "arcsec")


def test_a_number_in_quotes_has_the_unit_of_the_argument():
    with pytest.raises(BadInput, match=r"^size must be a number of arcsec, got '30' in quotes: write 30$"):
        arguments.refuse_angle("size", "30", "of arcsec", "arcsec")


@pytest.mark.parametrize(
    ("ra", "dec", "is_exchanged"),
    [(-27.8, 153.1, True), (np.int64(2), np.float32(150.0), True), (153.1, -27.8, False), (153.1, 100.0, False),
     (1.0, 400.0, False), ("1", 150.0, False), (True, 150.0, False), (None, 150.0, False)],
)  # fmt: skip
def test_exchanged_positions_are_asked_about(ra, dec, is_exchanged):
    assert arguments.exchanged_question(ra, dec) == ("are ra and dec exchanged?" if is_exchanged else "")


def test_a_missing_argument_is_named():
    @arguments.refuse_missing("area(ra, dec)")
    def area(ra, dec, /, *, band, size=1.0, **options):
        return ra, dec, band, size, options

    assert area(1, 2, band="r", b=3) == (1, 2, "r", 1.0, {"b": 3})
    with pytest.raises(BadInput, match=r"^dec and band are missing: write area\(ra, dec\)$"):
        area(1, size=3.0)
    with pytest.raises(BadInput, match=r"^ra must be a number in degrees, got a SkyCoord: write c\.ra\.deg"):
        area(SkyCoord(53.2, -28.1, unit="deg"), band="r")
    with pytest.raises(BadInput, match=r"^ra and dec are missing: write area\(ra, dec\)$"):
        area(ra=1, dec=2, band="r")
    assert list(inspect.signature(area).parameters) == ["ra", "dec", "band", "size", "options"]


def test_an_unknown_argument_is_named():
    @arguments.refuse_missing("area(ra, dec)")
    def area(ra, dec, band="r"):
        return ra, dec, band

    assert area(1, dec=2) == (1, 2, "r")
    with pytest.raises(BadInput, match=r"^area has no argument bands: did you mean band\? allowed: ra, dec, band$"):
        area(1, 2, bands="i")


@pytest.mark.parametrize("value", [2.0, np.float64(2.0), "2", None, 0, 4, np.arange(2)])
def test_another_whole_number_is_refused(value):
    with pytest.raises(BadInput, match=r"^bins = .*(outside \[1, 3\]|not a whole number)$"):
        arguments.check_integer("bins", value, 1, 3)


@pytest.mark.parametrize("value", [3, None, [3], ["ra", None]])
def test_other_names_are_refused(value):
    with pytest.raises(BadInput, match=r"^columns = .* is not a name or a list of names$"):
        arguments.check_names("columns", value)
