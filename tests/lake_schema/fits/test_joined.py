"""Files of images are joined into one: all arrays are unchanged, and common cards are stored once."""

import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput, Damaged
from lake_schema.fits import images, joined
from lake_schema.fits.images import Image

DTYPES = (np.uint16, np.uint8, np.float32, np.int32)
SHARED = ("CAMERA", "GAIN", "LAMP")


def array(number, dtype, depth=()):
    rng = np.random.default_rng(number)
    return (rng.integers(0, 60_000 if dtype is np.uint16 else 200, (*depth, 21, 34))).astype(dtype)


def of_extensions(number, gain=2.0):
    cards = (("CAMERA", "x", "of all"), ("GAIN", gain, ""), ("BUNIT", "adu", ""), ("DETECTOR", f"D{number}", "name"))
    own = (("DETECTOR", "own", "its own"), ("CRPIX1", float(number), ""))
    arrays = [Image(array(10 * number + i, t), own if i else (), f"D{number}.{i}") for i, t in enumerate(DTYPES)]
    return [Image(None, cards), *arrays]


def of_one(number):
    cards = (("CAMERA", "x", "of all"), ("GAIN", 2.0, ""), ("DETECTOR", f"D{number}", "name"), ("CRPIX1", 5.0, ""))
    return [Image(array(number, np.uint16), cards)]


def written(folder, found, rice=False):
    files = []
    for number, units in enumerate(found):
        files.append((f"D{number}", folder / f"{number}.fits"))
        images.write_images(files[-1][1], units, rice)
    return files


@pytest.mark.parametrize("rice", [False, True])
@pytest.mark.parametrize("make", [of_extensions, of_one])
def test_every_array_is_as_it_was(tmp_path, make, rice):
    files, path = written(tmp_path, [make(number) for number in range(3)], rice), tmp_path / "all.fits"
    joined.join(path, files, SHARED, (("NDETECT", 3, "files"),))
    found = images.read_images(path)
    before = [unit for _, file in files for unit in images.read_images(file) if unit.data is not None]
    assert found[0].data is None
    assert [card[:2] for card in found[0].cards] == [("CAMERA", "x"), ("GAIN", 2.0), ("NDETECT", 3)]
    names = [f"D{n}.{i}" for n in range(3) for i in range(4)] if make is of_extensions else ["D0", "D1", "D2"]
    assert [unit.name for unit in found[1:]] == names
    for one, other in zip(found[1:], before, strict=True):
        assert one.data.dtype == other.data.dtype
        np.testing.assert_array_equal(one.data, other.data)
        keys = [card[0] for card in one.cards]
        assert len(keys) == len(set(keys))
        assert not {"CAMERA", "GAIN"} & set(keys)
        assert {"DETECTOR", "CRPIX1"} <= set(keys) or make is of_extensions
    with fits.open(path, checksum=True) as units:
        units.verify("exception")
        assert len(units) == len(names) + 1
    again = tmp_path / "again.fits"
    joined.join(again, files, SHARED, (("NDETECT", 3, "files"),))
    assert again.read_bytes() == path.read_bytes()


def test_differing_cards_are_stored_with_each_array(tmp_path):
    """A card of an array takes precedence over a card of its file's first header."""
    files, path = written(tmp_path, [of_extensions(0), of_extensions(1, 3.0)]), tmp_path / "all.fits"
    joined.join(path, files, SHARED, ())
    first, *found = images.read_images(path)
    assert [card[0] for card in first.cards] == ["CAMERA"]
    about = [{key: value for key, value, _ in unit.cards} for unit in found]
    assert [one["GAIN"] for one in about] == [2.0] * 4 + [3.0] * 4
    assert [one["DETECTOR"] for one in about] == ["D0", "own", "own", "own", "D1", "own", "own", "own"]
    assert all(one["BUNIT"] == "adu" for one in about)


def test_cubes_and_one_file_alone(tmp_path):
    files = written(tmp_path, [[Image(array(1, np.uint16, (4,)), (("CAMERA", "x", ""),))]])
    joined.join(tmp_path / "all.fits", files, SHARED, ())
    first, cube = images.read_images(tmp_path / "all.fits")
    np.testing.assert_array_equal(cube.data, array(1, np.uint16, (4,)))
    assert [card[0] for card in first.cards] == ["CAMERA"]


def test_nothing_and_a_file_cut_short_leave_no_file(tmp_path):
    path = tmp_path / "all.fits"
    with pytest.raises(BadInput, match="no files to join"):
        joined.join(path, [], SHARED, ())
    files = written(tmp_path, [of_extensions(0), of_extensions(1)])
    with files[1][1].open("r+b") as stream:
        stream.truncate(9000)
    with pytest.raises(Damaged, match=r"1\.fits"):
        joined.join(path, files, SHARED, ())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["0.fits", "1.fits"]


def test_one_file_at_a_time_is_in_memory(tmp_path):
    import tracemalloc

    big = np.zeros((1000, 1000), np.float32)
    files = written(tmp_path, [[Image(None), *(Image(big, (), f"{n}.{i}") for i in range(2))] for n in range(8)])
    tracemalloc.start()
    joined.join(tmp_path / "all.fits", files, SHARED, ())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 6 * big.nbytes


@pytest.mark.parametrize("rice", [False, True])
def test_arrays_with_equal_names_get_different_names(tmp_path, rice):
    """For example, all detectors have amplifiers of the same names."""
    units = [Image(None, (("CAMERA", "x", ""),)), *(Image(array(i, np.uint16), (), f"C0{i}") for i in range(2))]
    joined.join(tmp_path / "all.fits", written(tmp_path, [units, units], rice), SHARED, ())
    names = [unit.name for unit in images.read_images(tmp_path / "all.fits")[1:]]
    assert names == ["D0.C00", "D0.C01", "D1.C00", "D1.C01"]
