"""Reference catalogues for SCAMP."""

import pyarrow as pa
import pytest
from astropy.io import fits

from truesky.catalogue.exports import ldac


def test_unknown_proper_motion_has_a_large_error(tmp_path):
    known = {
        "source_id": 7, "ref_epoch": 2015.5, "ra": 10.0, "dec": -5.0, "ra_error": 0.2, "dec_error": 0.1,
        "pmra": 3.0, "pmra_error": 0.3, "pmdec": -4.0, "pmdec_error": 0.4,
        "phot_g_mean_mag": 20.0, "phot_g_mean_flux_over_error": 100.0,
    }  # fmt: skip
    unknown = {**known, "source_id": 8, **dict.fromkeys(("pmra", "pmra_error", "pmdec", "pmdec_error"))}
    ldac.write(tmp_path / "gaia.cat", pa.Table.from_pylist([known, unknown]))
    found = fits.getdata(tmp_path / "gaia.cat", "LDAC_OBJECTS")
    assert found["PMALPHA_J2000"].tolist() == [3.0, 0.0]
    assert found["PMALPHAERR_J2000"] == pytest.approx([0.3, 100.0])
    assert found["PMDELTAERR_J2000"] == pytest.approx([0.4, 100.0])
