"""Faulty FITS files of other programs are refused in one line, quickly and with little memory."""

import gzip
import resource
import time

import numpy as np
import pytest
from astropy.io import fits as astropy_fits

from lake_schema.errors import BadInput
from lake_schema.external import rows
from lake_schema.fits import external

READERS = {
    "read_numbers": lambda path: external.read_numbers(path, "catalogue of stars"),
    "read_batches": lambda path: list(external.read_batches(path, ["a", "b"], ["name"])),
    "read_table": lambda path: external.read_table(path, "curve"),
    "read_map": lambda path: external.read_map(path, "a"),
    "read_planes": lambda path: external.read_planes(path, "a"),
}
# Reading without limits takes minutes; imports on a slow machine take seconds.
MOST_SECONDS, MOST_BYTES = 30.0, 512 << 20


def table(*columns):
    columns = columns or (
        astropy_fits.Column("a", "D", array=np.arange(48.0)), astropy_fits.Column("b", "J", array=np.arange(48)),
        astropy_fits.Column("name", "8A", array=[f"n{i}" for i in range(48)]),
    )  # fmt: skip
    return astropy_fits.HDUList([astropy_fits.PrimaryHDU(), astropy_fits.BinTableHDU.from_columns(columns)])


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "x.fits"
    table().writeto(path)
    return path


def card(name, value):
    """Return the same file with a changed card of its table."""

    def change(data):
        start = data.index(f"{name:8}= ".encode(), 2880)
        return data[:start] + f"{name:8}= {value:>20}".ljust(80).encode() + data[start + 80 :]

    return change


def first_card(name, value):
    def change(data):
        start = data.index(f"{name:8}= ".encode())
        return data[:start] + f"{name:8}= {value:>20}".ljust(80).encode() + data[start + 80 :]

    return change


def without_end(data):
    return data[:2880].replace(b"END     ", b"COMMENT ") + b"COMMENT".ljust(80) * 72_000


BROKEN = {
    "nothing": lambda data: b"",
    "text": lambda data: b"a,b\n1,2\n",
    "a header alone, cut": lambda data: data[:1000],
    "cut in its table": lambda data: data[:5800],
    "no end of a header": without_end,
    "axes without end": first_card("NAXIS", 2147483648),
    "a table of many axes": card("NAXIS", 999),
    "a negative axis": card("NAXIS2", -48),
    "an axis of 18 digits": card("NAXIS2", "9" * 18),
    "a heap of 18 digits": card("PCOUNT", "9" * 18),
    "rows of no bytes": lambda data: card("NAXIS1", 0)(card("NAXIS2", 10**15)(data)),
    "no bits": card("BITPIX", "'x'"),
    "columns without end": card("TFIELDS", 10**9),
    "no number of columns": card("TFIELDS", "'x'"),
    "a form of nothing": card("TFORM1", "'0D'"),
    "a form that is none": card("TFORM1", "'?'"),
    "a form that is a number": card("TFORM1", 3),
    "a title that is a number": card("TTYPE1", 3),
    "no title": card("TTYPE1", "''"),
    "another kind of extension": card("XTENSION", "'DUMP'"),
    "a bomb": lambda data: gzip.compress(data[:2880]) + gzip.compress(bytes(30 << 20), 1) * 20,
    "half of an archive": lambda data: (packed := gzip.compress(data))[: len(packed) // 2],
}

UNSEEN = [BROKEN[name] for name in ("no title", "a title that is a number", "a form of nothing")]


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("change", BROKEN.values(), ids=BROKEN)
def test_broken_files_are_refused_in_one_line(good, name, change):
    good.write_bytes(change(good.read_bytes()))
    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10, time.process_time()
    # A reader need not notice faults in parts of a file that it does not use.
    said = f"{good}: a line" if change in UNSEEN else ""
    try:
        READERS[name](good)
    except BadInput as error:
        said = str(error)
    assert time.process_time() - started < MOST_SECONDS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10) - before < 2 * MOST_BYTES
    assert said.startswith(str(good))
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("name", ["read_batches", "read_map", "read_table"])
def test_lists_are_refused_before_they_are_read(tmp_path, name):
    rows = np.empty(3, object)
    rows[:] = [np.arange(2.0)] * 3
    lists = table(astropy_fits.Column("a", "PD()", array=rows), astropy_fits.Column("b", "J", array=np.arange(3)))
    lists.writeto(tmp_path / "x.fits")
    with pytest.raises(BadInput, match="column a holds lists"):
        READERS[name](tmp_path / "x.fits")


def test_compressed_images_are_not_decompressed(tmp_path):
    unit = astropy_fits.CompImageHDU(np.ones((30, 30), np.int16), compression_type="RICE_1")
    astropy_fits.HDUList([astropy_fits.PrimaryHDU(), unit]).writeto(tmp_path / "x.fits")
    with pytest.raises(BadInput, match="holds no image"):
        external.read_planes(tmp_path / "x.fits", "a")


def test_good_files_are_read_plain_or_compressed(good):
    for _ in range(2):
        ((numbers, _),) = external.read_batches(good, ["a", "b"], ["name"])
        assert (numbers["b"].tolist(), numbers["name"][3]) == (list(range(48)), "n3")
        assert (
            external.read_numbers(good, "catalogue of stars")["a"].sum()
            == external.read_map(good, "a")[0].sum()
            == 1128.0
        )
        assert external.read_table(good, "curve")["a"][2] == 2.0
        good.write_bytes(gzip.compress(good.read_bytes()))


def test_missing_integers_are_not_numbers(tmp_path):
    """TNULL is a stored value: a column with TSCAL and TZERO is compared before it is scaled."""
    path = tmp_path / "x.fits"
    columns = [
        astropy_fits.Column("scaled", "I", null=-99, array=np.array([-99, 2, 3], np.int16)),
        astropy_fits.Column("plain", "J", null=-1, array=np.array([5, -1, 7], np.int32)),
    ]
    table(*columns).writeto(path)
    data = path.read_bytes()
    end = data.index(b"END".ljust(80), 2880)
    cards = b"TSCAL1  =                  0.5".ljust(80) + b"TZERO1  =                 10.0".ljust(80)
    path.write_bytes(data[:end] + cards + data[end : end + 80] + data[end + 240 :])
    scaled, plain = [np.nan, 11.0, 11.5], [5.0, np.nan, 7.0]
    for read in (external.read_numbers(path, "catalogue"), next(external.read_batches(path, ["scaled", "plain"]))[0]):
        np.testing.assert_array_equal(read["scaled"], scaled)
        np.testing.assert_array_equal(read["plain"], plain)
    (batch,) = rows.read_batches(path, ["scaled"], text_columns=["plain"])
    assert batch.columns["plain"].tolist() == ["5", "", "7"]
    assert external.column_names(path, "catalogue") == ["scaled", "plain"]
