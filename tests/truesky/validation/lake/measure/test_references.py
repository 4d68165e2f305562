"""Reference data for the sources of a frame."""

import numpy as np
import pyarrow as pa

from truesky.validation.lake.measure import references


def test_a_lake_of_galaxies_alone():
    n = 3
    truth = pa.table({
        "id": np.arange(n), "x": np.ones(n), "y": np.ones(n), "expected": np.ones(n), "method": np.ones(n, np.int8),
        "psf_x": pa.nulls(n, pa.float64()), "psf_y": pa.nulls(n, pa.float64()),
    })  # fmt: skip
    nobody = references.load_catalogue({}, np.zeros(0, np.int64), ["euclid_vis"])
    found = references.build_reference(truth, nobody, "euclid_vis", 60_000.0)
    assert len(found) == n
    assert not found.point.any()
    assert np.isnan([found.ra, found.dec, found.mag]).all()
