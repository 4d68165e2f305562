"""FITS files: bytes, checksums, and the refusal of damaged or hostile files."""

import numpy as np
import pytest
from astropy.io import fits as astropy_fits
from astropy.table import Table as AstropyTable
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput, Damaged
from lake_schema.fits import external, tables, write
from lake_schema.fits.images import Image, cards_to_text, read_head_file, read_images, write_images
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.products import PRODUCTS
from tests.universe import rows_of

CARDS = (
    ("EXPTIME", 560.53, "[s]"),
    ("SEED", "17", "of the numbers"),
    ("NSOURCES", 12, ""),
    ("GOOD", True, ""),
)
TYPES = ["u1", "i2", "u2", "i4", "f4", "f8"]


def science(ny=30, nx=40):
    return np.random.default_rng(1).integers(0, 65536, (ny, nx)).astype(np.uint16)


@given(st.sampled_from(TYPES).flatmap(lambda t: hnp.arrays(t, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9))))
def test_written_images_are_read_unchanged(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("fits") / "a.fits"
    write_images(path, [Image(data, CARDS), Image(data, name="COPY")])
    first, second = read_images(path)
    assert first.cards == CARDS
    assert (first.name, second.name) == ("", "COPY")
    for image in (first, second):
        assert image.data.dtype == data.dtype
        np.testing.assert_array_equal(image.data, data)


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_images(tmp_path / name, [Image(science(), CARDS), Image(None, CARDS, "EMPTY")])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


@settings(max_examples=12)
@given(st.sampled_from(TYPES).flatmap(lambda t: hnp.arrays(t, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9))))
def test_compressed_images_are_read_unchanged(tmp_path_factory, data):
    """Images are compressed as the first or another unit of a file, with integers or floats."""
    path = tmp_path_factory.mktemp("fits") / "a.fits"
    for images in ([Image(data, CARDS), Image(data, name="COPY")], [Image(None, CARDS),
                   Image(data, CARDS, "COPY")]):  # fmt: skip
        write_images(path, images, rice=True)
        found = read_images(path)
        assert [(image.cards, image.name) for image in found] == [(image.cards, image.name) for image in images]
        for image, wanted in zip(found, images, strict=True):
            assert (image.data is None) == (wanted.data is None)
            if image.data is not None:
                assert image.data.dtype == data.dtype
                np.testing.assert_array_equal(image.data, data)


@pytest.mark.parametrize("shape", [(1, 7), (15, 7), (16, 7), (33, 7), (2, 17, 7), (3, 1, 1)])
def test_tiles_are_sixteen_rows_or_what_is_left_of_an_image(tmp_path, shape):
    data = np.arange(np.prod(shape), dtype=np.uint16).reshape(shape) * 211
    write_images(tmp_path / "a.fits", [Image(data)], rice=True)
    with astropy_fits.open(tmp_path / "a.fits", disable_image_compression=True) as units:
        tile = [units[1].header[f"ZTILE{axis + 1}"] for axis in range(len(shape))]
    assert tile == [shape[-1], min(16, shape[-2]), *[1] * (len(shape) - 2)]
    (back,) = read_images(tmp_path / "a.fits")
    assert (back.data == data).all()


def test_cards_that_are_equal_are_written_each_as_it_is():
    """In Python, 0.0 equals -0.0, and 1 equals 1.0 and True; each must be written as given."""
    values = (0.0, -0.0, 1, 1.0, True, "1", -0.0, True, 1.0, 1, 0.0)
    lines = cards_to_text([("A", value, "") for value in values]).splitlines()
    assert lines == [str(astropy_fits.Card("A", value, "")).rstrip() for value in values]
    assert len(set(lines)) == 6


def test_cards_of_many_images_are_written_as_if_each_were_the_first(tmp_path):
    """Cards are kept from image to image, with values that Python counts as equal; headers must not change them."""
    values = (0.0, -0.0, 1, 1.0, True, "1", "a" * 100)
    units = [Image(None, tuple((f"K{number}", value, "of many") for number, value in enumerate(values, start)), "U")
             for start in (0, 0, 1)]  # fmt: skip
    written = []
    for name in ("a", "b"):
        write_images(tmp_path / name, units)
        written.append((tmp_path / name).read_bytes())
        with astropy_fits.open(tmp_path / name, mode="update") as stored:
            stored[1].header["K0"] = 5.0
    assert written[0] == written[1]
    expected = astropy_fits.HDUList([(astropy_fits.ImageHDU if i else astropy_fits.PrimaryHDU)() for i in range(3)])
    for hdu, unit in zip(expected, units, strict=True):
        for card in unit.cards:
            hdu.header.append(astropy_fits.Card(*card), end=True)
        hdu.header["EXTNAME"] = "U"
    write.write_atomically(tmp_path / "c", expected)
    assert (tmp_path / "c").read_bytes() == written[0]


def test_packed_images_are_small_sound_and_the_same_every_time(tmp_path):
    noise = np.rint(np.random.default_rng(1).normal(2000.0, 3.0, (200, 300))).astype(np.uint16)
    for name in ("a", "b"):
        write_images(tmp_path / name, [Image(noise, CARDS, "1-1.E")], rice=True)
    good = (tmp_path / "a").read_bytes()
    assert good == (tmp_path / "b").read_bytes()
    # This noise contains 3.5 bits per pixel; the rest are headers.
    assert len(good) < 0.35 * noise.nbytes + 6 * 2880
    with astropy_fits.open(tmp_path / "a", checksum=True, disable_image_compression=True) as units:
        units.verify("exception")
        assert all(unit.verify_checksum() == unit.verify_datasum() == 1 for unit in units)
    with astropy_fits.open(tmp_path / "a") as units:
        assert units["1-1.E"].header["EXPTIME"] == 560.53
        np.testing.assert_array_equal(units["1-1.E"].data, noise)


@pytest.mark.parametrize("where", ["pixels", "card", "end"])
def test_a_changed_byte_of_a_packed_image_is_noticed(tmp_path, where):
    path = tmp_path / "a.fits"
    write_images(path, [Image(science(), CARDS)], rice=True)
    good = path.read_bytes()
    place = {"pixels": len(good) - 2880 + 50, "card": good.index(b"560.53") + 1, "end": 0}[where]
    path.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :] if place else good[:-2880])
    with pytest.raises(Damaged, match=r"a\.fits"):
        read_images(path)


def test_images_too_large_when_decompressed_are_refused(tmp_path):
    path = tmp_path / "a.fits"
    write_images(path, [Image(np.zeros((300, 300), np.uint16))], rice=True)
    with pytest.raises(BadInput, match="more than 100000 bytes"):
        read_images(path, max_bytes=100_000)


def test_other_tools_find_it_sound(tmp_path):
    path = tmp_path / "a.fits"
    write_images(path, [Image(science(), CARDS)])
    with astropy_fits.open(path, checksum=True) as units:
        units.verify("exception")
        assert units[0].verify_checksum() == units[0].verify_datasum() == 1
        assert units[0].data.dtype == np.uint16
        assert units[0].header.comments["EXPTIME"] == "[s]"
        assert "DATE" not in units[0].header
    assert path.stat().st_mode & 0o444 == 0o444


def test_a_changed_byte_is_noticed(tmp_path):
    path = tmp_path / "a.fits"
    write_images(path, [Image(science(), CARDS)])
    good = path.read_bytes()
    # Change a byte of the data, and a byte of a card's value.
    for place in (2880 + 100, good.index(b"560.53") + 1):
        path.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
        with pytest.raises(Damaged, match=r"a\.fits"):
            read_images(path)
    path.write_bytes(good[: len(good) - 2880])
    with pytest.raises(Damaged):
        read_images(path)
    path.write_bytes(b"")
    with pytest.raises(Damaged):
        read_images(path)


def test_a_file_without_checksums_is_refused(tmp_path):
    path = tmp_path / "a.fits"
    astropy_fits.PrimaryHDU(science()).writeto(path)
    with pytest.raises(Damaged, match="no checksum"):
        read_images(path)


def test_size_is_checked_from_the_header(tmp_path):
    path = tmp_path / "a.fits"
    write_images(path, [Image(science())])
    with pytest.raises(BadInput, match="more than 1000 bytes"):
        read_images(path, max_bytes=1000)
    promises = path.read_bytes().replace(b"NAXIS1  =                   40", b"NAXIS1  =           2000000000")
    path.write_bytes(promises)
    with pytest.raises((BadInput, Damaged)):
        read_images(path)


def test_a_number_of_axes_up_to_which_astropy_would_count_is_refused(tmp_path):
    path = tmp_path / "a.fits"
    write_images(path, [Image(science())])
    path.write_bytes(path.read_bytes().replace(b"NAXIS   =                    2", b"NAXIS   =           4294967296"))
    with pytest.raises(Damaged, match=r"a\.fits: has 4294967296 axes"):
        read_images(path)


@pytest.mark.parametrize(
    "card",
    [
        ("NAXIS1", 5, ""),
        ("bitpix", 8, ""),
        ("X", float("nan"), ""),
        ("X", float("inf"), ""),
        ("X", "é", ""),
        ("TOOLONGKEY", 1, ""),
        ("X", 1.0, "c" * 80),
    ],
)
def test_a_card_that_fits_cannot_hold_is_refused(tmp_path, card):
    with pytest.raises(BadInput, match=card[0]):
        write_images(tmp_path / "a.fits", [Image(science(), (card,))])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("data", [np.zeros(3), np.zeros((2, 2), complex), np.zeros((1, 2, 2, 2)), np.array([["a"]])])
def test_arrays_that_are_not_images_are_refused(tmp_path, data):
    with pytest.raises(BadInput, match="image"):
        write_images(tmp_path / "a.fits", [Image(data)])
    with pytest.raises(BadInput, match="at least one"):
        write_images(tmp_path / "a.fits", [])


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.fits"
    write_images(path, [Image(science())])
    before = path.read_bytes()
    with pytest.raises(BadInput):
        write_images(path, [Image(science(), (("X", float("nan"), ""),))])
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.fits"]


def test_tables_carry_units_and_ucds(tmp_path):
    rows = rows_of(GALAXIES, 7)
    path = tmp_path / "galaxies.fits"
    tables.table_to_fits(path, rows, GALAXIES)
    with astropy_fits.open(path, checksum=True) as units:
        units.verify("exception")
        table, header = units[1].data, units[1].header
        assert header["EXTNAME"] == "GALAXIES"
        for number, column in enumerate(GALAXIES.columns, start=1):
            assert header[f"TTYPE{number}"] == column.name
            assert header.get(f"TUNIT{number}", "") == column.unit
            assert header.get(f"TUCD{number}", "") == column.ucd
        for name in ("id", "ra", "kappa", "sed_1", "log_halo_mass"):
            np.testing.assert_array_equal(table[name], rows[name].to_numpy())


def test_tables_with_texts_gaps_and_lists(tmp_path):
    rows = rows_of(PRODUCTS, 3)
    path = tmp_path / "products.fits"
    tables.table_to_fits(path, rows, PRODUCTS)
    with astropy_fits.open(path) as units:
        assert list(units[1].data["detector"]) == rows["detector"].to_pylist()
    holes = rows_of(GALAXIES, 3)
    masses = np.ma.MaskedArray([1.0, 2.0, 3.0], [False, True, False])
    columns = {name: holes[name] for name in holes.column_names} | {"log_halo_mass": masses + 10}
    tables.table_to_fits(path, GALAXIES.build(columns), GALAXIES)
    with astropy_fits.open(path) as units:
        np.testing.assert_array_equal(units[1].data["log_halo_mass"], [11.0, np.nan, 13.0])


def exported(path, table, **columns):
    """Return the table as an independent reader reads it, and its raw bytes."""
    tables.table_to_fits(path, table.build({"id": np.arange(3), **columns}), table)
    with astropy_fits.open(path, character_as_bytes=True) as units:
        raw = np.array(units[1].data.view(np.ndarray))
    return AstropyTable.read(path, hdu=1), raw


@pytest.mark.parametrize("kind", ["int8", "int16", "int32", "int64"])
def test_null_differs_from_every_number(tmp_path, kind):
    table = Table("t", 1, (Column("id", "int64"), Column("x", kind, lo=0, nullable=True)), "t")
    limits = np.iinfo(kind)
    for values in ([limits.min, limits.max, 0], [-1, -(2**15) % limits.max, 5], [limits.min, limits.min + 1, 7]):
        masked = np.ma.MaskedArray(np.array(values, kind), [False, False, True])
        found, _ = exported(tmp_path / "a.fits", table, x=masked)
        assert found["x"].mask.tolist() == [False, False, True]
        assert found["x"][:2].tolist() == values[:2]


def test_a_column_with_all_values_has_none_left_for_null():
    with pytest.raises(ValueError, match="every number of int8"):
        tables._lowest_unused_value(np.arange(-128, 128).astype(np.int8))
    assert tables._lowest_unused_value(np.array([], np.int16)) == -(2**15)


def test_a_missing_boolean_is_neither_true_nor_false(tmp_path):
    table = Table("t", 1, (Column("id", "int64"), Column("x", "bool", nullable=True)), "t")
    _, raw = exported(tmp_path / "a.fits", table, x=np.ma.MaskedArray([True, False, True], [False, False, True]))
    assert raw["x"].view("i1").tolist() == [ord("T"), ord("F"), 0]
    with astropy_fits.open(tmp_path / "a.fits", checksum=True) as units:
        assert units[1].verify_checksum() == units[1].verify_datasum() == 1


def test_lists_are_arrays_of_variable_length(tmp_path):
    kinds = ("list<int64>", "list<float32>")
    table = Table("t", 1, (Column("id", "int64"), *(Column(f"x{i}", k) for i, k in enumerate(kinds))), "t")
    lists = [[1, 2, 3], [], [2**62]]
    found, _ = exported(tmp_path / "a.fits", table, x0=lists, x1=[[0.5], [1.5, 2.5], []])
    assert [list(value) for value in found["x0"]] == lists
    assert [list(value) for value in found["x1"]] == [[0.5], [1.5, 2.5], []]


@pytest.mark.parametrize("name", ["é", "x" * 69, "a\nb", ""])
def test_a_name_that_fits_cannot_hold_is_refused(tmp_path, name):
    table = Table("t", 1, (Column(name, "int64"),), "t", key=())
    with pytest.raises(BadInput, match="give it another"):
        tables.table_to_fits(tmp_path / "a.fits", table.build({name: [1]}), table)
    assert list(tmp_path.iterdir()) == []


def test_units_have_the_spelling_of_fits():
    assert tables.fits_unit("GB") == "Gbyte"
    assert tables.fits_unit("erg s-1 cm-2") == "erg s-1 cm-2"
    assert tables.fits_unit("electron pix-1 s-1") == "electron pix-1 s-1"


def somebodys(path):
    """Write a table of another program: integers (one missing), floats, booleans, texts, and lists of two lengths."""
    columns = [
        astropy_fits.Column("number", "J", null=-9, array=np.array([3, -9, 5])),
        astropy_fits.Column("id", "K", array=np.array([2**60, 2, 3])),
        astropy_fits.Column("flux", "D", unit="mJy", array=np.array([0.5, np.nan, 2.5])),
        astropy_fits.Column("good", "L", array=np.array([True, False, True])),
        astropy_fits.Column("name", "4A", array=np.array(["a", "bc", "def"])),
        astropy_fits.Column("pair", "2E", array=np.arange(6.0).reshape(3, 2)),
        astropy_fits.Column("list", "PE()", array=np.array([[1.0], [1.0, 2.0], []], dtype=object)),
    ]
    table = astropy_fits.BinTableHDU.from_columns(columns)
    table.header["ORDERING"] = "NESTED"
    astropy_fits.HDUList([astropy_fits.PrimaryHDU(np.ones((2, 2))), table]).writeto(path)
    return path


@pytest.mark.parametrize("rows", [1, 2, 3, 100])
def test_external_columns_are_read_in_batches(tmp_path, rows):
    path = somebodys(tmp_path / "a.fits")
    names = ("number", "id", "flux", "good")
    batches = list(external.read_batches(path, names, ("name", "absent"), rows))
    assert [len(numbers["id"]) for numbers, _ in batches] == [min(rows, 3 - k) for k in range(0, 3, rows)]
    whole = {name: np.concatenate([numbers[name] for numbers, _ in batches]) for name in (*names, "name")}
    assert whole["id"].tolist() == [2**60, 2, 3]
    assert whole["id"].dtype == np.int64
    np.testing.assert_array_equal(whole["number"], [3.0, np.nan, 5.0])
    np.testing.assert_array_equal(whole["flux"], [0.5, np.nan, 2.5])
    assert whole["good"].tolist() == [1, 0, 1]
    assert whole["name"].tolist() == ["a", "bc", "def"]
    assert all(said == {"flux": "mJy"} for _, said in batches)


@pytest.mark.parametrize(
    ("name", "words"),
    [("absent", "has no column absent; it has number, id"), ("name", "must be one number per row"),
     ("pair", "must be one number per row"), ("list", "column list holds lists")],
)  # fmt: skip
def test_columns_without_one_number_per_row_are_refused(tmp_path, name, words):
    path = somebodys(tmp_path / "a.fits")
    with pytest.raises(BadInput, match=words):
        list(external.read_batches(path, [name]))


def test_a_map_is_read_in_the_order_of_its_file(tmp_path):
    """A row of a map has one pixel or many."""
    path = somebodys(tmp_path / "a.fits")
    for name, wanted in (("id", [2**60, 2, 3]), ("pair", [0, 1, 2, 3, 4, 5])):
        values, header = external.read_map(path, name)
        assert values.dtype == np.float64
        assert values.tolist() == wanted
        assert header["ORDERING"] == "NESTED"
    for name, words in (("absent", "no column absent"), ("name", "but must have at most"), ("list", "holds lists")):
        with pytest.raises(BadInput, match=words):
            external.read_map(path, name)
    astropy_fits.PrimaryHDU(np.ones((2, 2))).writeto(tmp_path / "image.fits")
    with pytest.raises(BadInput, match="but a catalogue must be a binary table"):
        external.read_map(tmp_path / "image.fits", "id")


def test_planes_are_an_image_s_or_those_of_a_table_s_first_row(tmp_path):
    cube = np.arange(24.0).reshape(2, 3, 4)
    astropy_fits.PrimaryHDU(cube).writeto(tmp_path / "image.fits")
    column = astropy_fits.Column("psf", "24D", dim="(4,3,2)", array=np.stack([cube, 2 * cube]))
    astropy_fits.BinTableHDU.from_columns([column]).writeto(tmp_path / "table.fits")
    for name in ("image.fits", "table.fits"):
        np.testing.assert_array_equal(external.read_planes(tmp_path / name, "psf")[0], cube)
    with pytest.raises(BadInput, match="no image of two or three axes and no table with a column other"):
        external.read_planes(tmp_path / "table.fits", "other")


def test_bytes_are_on_the_disc_before_the_file_has_its_name(tmp_path, monkeypatch):
    done = []
    for name in ("fsync", "replace"):
        real = getattr(write.os, name)
        monkeypatch.setattr(write.os, name, lambda *args, name=name, real=real: (done.append(name), real(*args))[1])
    write_images(tmp_path / "a.fits", [Image(science(), CARDS)])
    assert done[:2] == ["fsync", "replace"]
    assert (tmp_path / "a.fits").stat().st_mode & 0o777 == 0o666 & ~write._umask()


@pytest.mark.parametrize("text", [b"CRVAL1  = 1\xb2\n", b"CTYPE2  = 'RA--\n", b"CRVAL1  = 1" + b" " * 80])
def test_a_head_file_that_is_not_cards_is_damaged(tmp_path, text):
    path = tmp_path / "x.head"
    path.write_bytes(text)
    with pytest.raises(Damaged, match=r"x\.head"):
        read_head_file(path)
