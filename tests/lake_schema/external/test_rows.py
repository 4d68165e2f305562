"""Tables of other programs that are refused before memory is allocated for them."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows


def rows(path):
    return [piece.columns["ra"] for piece in external_rows.read_batches(path, ["ra"])]


@pytest.mark.parametrize("title", ["c{}", ""])
def test_a_csv_of_any_number_of_columns_is_refused(tmp_path, title):
    """Arrow allocates memory for all columns: some gigabytes for a header of some megabytes."""
    path = tmp_path / "x.csv"
    for count in (4000, 5000):
        titles = ",".join(title.format(i) for i in range(count - 1))
        path.write_text(f"ra,{titles}\n" + "1.5" + "," * (count - 1) + "\n")
        if count == 4000:
            np.testing.assert_array_equal(rows(path), [[1.5]])
    with pytest.raises(BadInput, match=r"x\.csv: has more than 4096 columns"):
        rows(path)


def test_titles_of_any_length_are_refused(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("ra," + "x" * 70_000 + "\n1,2\n")
    with pytest.raises(BadInput, match="titles that are too long"):
        rows(path)


@pytest.mark.parametrize("primary", ["/", "../other", "a/../..", "x\0", "x" * 300, "missing"])
def test_the_catalogue_of_a_collection_is_a_folder_in_it(tmp_path, primary):
    """Otherwise all files of a disc might be read."""
    (tmp_path / "collection.properties").write_text(f"hats_primary_table_url = {primary}\n")
    with pytest.raises(BadInput, match="is not a folder of the collection"):
        external_rows._files_of_folder(tmp_path)


def test_a_folder_has_files_of_one_format(tmp_path):
    """Parquet files come first, as in HATS catalogues, then HDF5 files, then FITS files."""
    (tmp_path / "sub").mkdir()
    for names in (["a.fits", "sub/b.fit"], ["c.hdf5"], ["d.parquet", "sub/e.parq"]):
        for name in names:
            (tmp_path / name).touch()
        assert [str(path.relative_to(tmp_path)) for path in external_rows.find_files(tmp_path)] == names
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match="no Parquet, HDF5 or FITS file in this folder"):
        external_rows.find_files(tmp_path / "empty")
