"""Refuse small text tables that would take much time or memory to read."""

import numpy as np
import pytest
from astropy.table import Table

from lake_schema.errors import BadInput
from truesky.fluxes.libraries import from_files

WAVELENGTH = np.linspace(4000.0, 6000.0, 101)


@pytest.fixture
def ecsv(tmp_path):
    """Return the text of a passband and its path."""
    path = tmp_path / "x.ecsv"
    Table({"wavelength": WAVELENGTH, "throughput": np.ones(101)}).write(path, format="ascii.ecsv")
    return path.read_text(), path


@pytest.mark.parametrize(
    ("place", "instead", "words"),
    [
        ("# schema", "# - {name: c, datatype: float64}\n" * 3000 + "# schema", "its header has more than 65536"),
        ("datatype: float64", 'datatype: string, subtype: "float64[99999999]"', "columns of a curve must be numbers"),
        ("datatype: float64", '"datatyp\\x65": 9999999D', "'9999999D' is not a datatype"),
        ("# schema", "# meta: {a: &b [1], c: *b}\n# schema", "'b' in its header must not be a reference"),
        ("# schema", "# meta: {a: !numpy.ndarray {shape: [9]}}\n# schema", "'!numpy.ndarray' in its header"),
        ("6000.0 1.0", "6000.0 " + "9" * 4000 + "\n1 1" * 9000, "9[0-9]* rows of 2 words are too many"),
    ],
)
def test_oversized_headers_and_tables_are_refused(ecsv, place, instead, words):
    text, path = ecsv
    assert place in text
    path.write_text(text.replace(place, instead, 1))
    with pytest.raises(BadInput, match=rf"x\.ecsv: cannot be read as passband_ecsv: {words}"):
        from_files.read(path, "passband_ecsv")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("," * 501 + "\n" + (",x" * 400 + "\n") * 400, "rows of 502 words are too many"),
        ('"' + "x\n" * 2000 + '",1\n', "a text in quotes must not span more than one line"),
    ],
)
def test_long_words_in_wide_tables_are_refused(tmp_path, more, words):
    path = tmp_path / "x.csv"
    rows = "".join(f"{x:g},1\n" for x in WAVELENGTH)
    path.write_text("wavelength,flux\n" + rows)
    assert len(from_files.read(path, "spectrum_csv").value) == 101
    path.write_text("wavelength,flux\n" + rows + more)
    with pytest.raises(BadInput, match=rf"x\.csv: cannot be read as spectrum_csv: .*{words}"):
        from_files.read(path, "spectrum_csv")
