"""A CSV file must have a line with the names of its columns, separated by commas."""

import pytest

from lake_schema.errors import BadInput
from lake_schema.external import rows

LINES = {
    "semicolons": ("ra;dec;mag\n53;-27;20\n", "x.csv: the columns are separated by semicolons, but must be separated"),
    "decimal commas": ("ra;dec;mag\n53,1;-27,8;20,5\n", "separated by semicolons, but must be separated by commas"),
    "tabs": ("ra\tdec\tmag\n53\t-27\t20\n", "the columns are separated by tabs"),
    "blanks": ("# ra dec mag\n53 -27 20\n", "the columns are separated by blanks"),
    "comment": ("# ra,dec,mag\n53,-27,20\n", "the first line begins with #, but must have only the names"),
    "no header": ("53,-27,20\n54,-27,20.5\n", "the first line has numbers, but must have the names of the columns"),
}


@pytest.mark.parametrize(("text", "message"), LINES.values(), ids=LINES)
def test_a_wrong_first_line_is_named(tmp_path, text, message):
    path = tmp_path / "x.csv"
    path.write_text(text)
    for read in (lambda: list(rows.read_batches(path, ["ra", "dec"])), lambda: rows.column_names(path)):
        with pytest.raises(BadInput) as caught:
            read()
        assert message in str(caught.value)


def test_unusual_names_that_are_mapped_are_read(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("#ra,my mag\n53,20\n")
    (batch,) = rows.read_batches(path, ["#ra", "my mag"])
    assert batch.columns["#ra"].tolist() == [53.0]
