"""Throughput curves are parsed once for all tests of the folder, most of which check a request with every camera."""

import pytest

from lake_schema.mission import checks


@pytest.fixture(scope="package", autouse=True)
def _curves_are_parsed_once():
    """Keep the curve of each file, by its checksum."""
    read, curves = checks._read_curve, {}

    def read_once(key, configuration):
        record = configuration.model(key)
        if record not in curves:
            curves[record] = read(key, configuration)
        return curves[record]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checks, "_read_curve", read_once)
        yield
