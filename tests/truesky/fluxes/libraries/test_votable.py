"""Refuse small VOTables that would take much time or memory to read."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from tests.truesky.fluxes.libraries.test_from_files import votable
from truesky.fluxes.libraries import from_files

FIELD = '<FIELD name="c" datatype="double"/>'
COLUMN = '<FIELD name="Transmission"'


@pytest.mark.parametrize(
    ("place", "more", "words"),
    [
        (COLUMN, FIELD * 2000, "more than 1000 elements"),
        ("</RESOURCE>", "<TABLE/>" * 2000, "more than 1000 elements"),
        ("<RESOURCE>", "<RESOURCE>" * 40, "more than 32 nested elements"),
        (COLUMN, FIELD.replace("/>", ' arraysize="1x99999999"/>'), "arraysize = '1x99999999' of FIELD"),
        (COLUMN, FIELD.replace("/>", ' arraysize="&#57;99999"/>'), "arraysize = '999999' of FIELD"),
        (COLUMN, FIELD.replace("/>", ' arraysize="500"/>') * 50, "more than 4000000 numbers"),
        (COLUMN, FIELD.replace("/>", f' unit="{"m." * 600}m"/>'), "more than 1000 characters"),
        ("<TD>5000", '<TD encoding="base64">', "not plain TABLEDATA"),
        ("<TABLEDATA>", "<BINARY2><STREAM/></BINARY2>", "not plain TABLEDATA"),
        ('<?xml version="1.0"?>', '<?xml version="1.0" encoding="utf-16"?>', "'utf-16'"),
    ],
)
def test_oversized_tables_are_refused(tmp_path, place, more, words):
    path = votable(tmp_path / "x.xml")
    text = path.read_text()
    assert place in text
    path.write_text(text.replace(place, more if place.startswith("<?") else more + place, 1))
    with pytest.raises(BadInput, match=rf"x\.xml: cannot be read as passband_svo: .*{words}"):
        from_files.read(path, "passband_svo")


def test_features_of_real_passbands_are_accepted(tmp_path):
    """Accept parameters with texts of any or fixed length, a column of texts, and another prefix of names."""
    path = votable(tmp_path / "x.xml")
    plain = from_files.read(path, "passband_svo")
    text = path.read_text().replace(
        COLUMN, '<PARAM name="d" value="a b" datatype="char" arraysize="*"/>' * 50 + COLUMN, 1
    )
    text = text.replace("<DATA>", '<FIELD name="n" datatype="char" arraysize="12*" width="12" precision="E3"/><DATA>')
    path.write_text(text.replace("</TR>", "<TD>abc</TD></TR>"))
    found = from_files.read(path, "passband_svo")
    np.testing.assert_array_equal(found.wavelength, plain.wavelength)
    np.testing.assert_array_equal(found.value, plain.value)
