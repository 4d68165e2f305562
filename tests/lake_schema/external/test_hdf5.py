"""HDF5 files in OpenCosmo's layout are read correctly in bounded pieces, or refused in one line."""

import h5py
import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.external import hdf5, rows
from tests.lake_schema.external import opencosmo

WANTED = ["gal_id", "ra", "lsst_r"]


def read(path, columns=WANTED):
    pieces = list(rows.read_batches(path, columns, integer_columns=["gal_id"]))
    return {name: np.concatenate([piece.columns[name] for piece in pieces]) for name in columns}, pieces


def test_rows_and_units_of_one_slice_and_of_several(tmp_path):
    one, two = opencosmo.columns(seed=1), opencosmo.columns(seed=2)
    values, pieces = read(opencosmo.write(tmp_path / "one.hdf5", one))
    assert all(np.array_equal(values[name], one[name]) for name in WANTED)
    assert values["gal_id"].dtype == np.int64
    assert pieces[0].units == {"ra": "deg", "lsst_r": "mag(AB)"}
    values, pieces = read(opencosmo.write(tmp_path / "two.h5", one, two))
    assert all(np.array_equal(values[name], np.append(one[name], two[name])) for name in WANTED)
    assert [piece.first_row for piece in pieces] == [1, 201]


def test_slices_follow_one_another_by_number(tmp_path):
    assert sorted(["487", "99", "a", "475"], key=hdf5._numeric_sort_key) == ["99", "475", "487", "a"]


def test_a_piece_is_bounded(tmp_path):
    n = 2 * 65_536 + 10
    path = opencosmo.write(tmp_path / "long.hdf5", {"ra": np.arange(n, dtype=float)})
    values, pieces = read(path, ["ra"])
    assert [len(piece.columns["ra"]) for piece in pieces] == [65_536, 65_536, 10]
    assert np.array_equal(values["ra"], np.arange(n))


def test_all_missing_columns_are_named_at_once(tmp_path):
    path = opencosmo.write(tmp_path / "few.hdf5", {"ra": np.zeros(3), "x": np.zeros(3)})
    with pytest.raises(BadInput, match=r"few\.hdf5 has no column gal_id, lsst_r; it has ra, x$"):
        read(path)


def damaged(path):
    data = bytearray(path.read_bytes())
    middle = data.find(b"TREE")
    data[middle : middle + 4] = b"EERT"
    path.write_bytes(data)


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def changed(change):
    def work(path):
        with h5py.File(path, "r+") as file:
            change(file)

    return work


def replaced(name, values):
    def change(file):
        del file["data"][name]
        file["data"][name] = values

    return changed(change)


def linked(file):
    del file["data/ra"]
    file["data/ra"] = h5py.ExternalLink("other.hdf5", "/data/ra")


@pytest.mark.parametrize(
    ("work", "said"),
    [
        (lambda path: path.write_bytes(b""), r"is not a hdf5 file"),
        (lambda path: path.write_bytes(b"SIMPLE  = T" * 100), r"is not a hdf5 file"),
        (cut, "truncated file"),
        (damaged, r"."),
        (replaced("ra", np.zeros(3)), r"dataset /data/ra has 3 rows, but /data/gal_id has 200"),
        (replaced("ra", np.zeros((200, 3))), r"dataset /data/ra is not a column of numbers"),
        (replaced("ra", np.array([b"x"] * 200)), r"dataset /data/ra is not a column of numbers"),
        (changed(linked), r"/data/ra must not be a link"),
        (changed(lambda file: file.move("data", "rows")), r"has no group data with columns"),
        (changed(lambda file: file["header/file"].attrs.update(data_type="halo_properties")), "holds halo_properties"),
    ],
)
def test_faulty_files_are_refused_in_one_line(tmp_path, work, said):
    path = opencosmo.write(tmp_path / "wrong.hdf5", opencosmo.columns())
    work(path)
    with pytest.raises(BadInput, match=said) as caught:
        read(path)
    assert "wrong.hdf5" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_without_rows(tmp_path):
    path = opencosmo.write(tmp_path / "none.hdf5", opencosmo.columns(0))
    with pytest.raises(BadInput, match=r"none\.hdf5: dataset /data/gal_id has no rows"):
        read(path)


def test_slices_in_different_units(tmp_path):
    path = opencosmo.write(tmp_path / "two.hdf5", opencosmo.columns(seed=1), opencosmo.columns(seed=2))
    with h5py.File(path, "r+") as file:
        file["487/data/ra"].attrs["unit"] = "rad"
    with pytest.raises(BadInput, match=r"dataset /487/data/ra has another type or unit than in the first slice"):
        read(path)
