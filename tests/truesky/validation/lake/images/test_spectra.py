"""The check of spectra passes for synthetic traces, light and lines, and fails if one of them is off."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.store import validate
from lake_schema.tables.validation import VALIDATION
from tests.truesky import nightly
from tests.truesky.validation.lake import made
from truesky.validation.lake.images.spectra import SPECTRA
from truesky.validation.lake.measure.frame_context import FrameContext
from truesky.validation.lake.measure.frames import Frame
from truesky.validation.lake.measure.rows import Place
from truesky.validation.lake.suite import publishing
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS

SIDE, LONG, FIRST, LAST, LINE = 700, 500, 12_500.0, 18_500.0, 15_300.0


def frame(up=0.0, brighter=1.0, redder=0.0, n=12):
    """A frame with slightly sloping traces, and its rows; up and redder are shifts in pixels, brighter is a factor."""
    rng = np.random.default_rng(2)
    image = rng.poisson(np.full((SIDE, SIDE), 100.0)).astype(float)
    rows, axis = [], np.arange(SIDE)
    for i in range(n):
        x0, y0, light = 60.0 + 7.3 * i, 40.0 + 53.37 * i, 2e5
        t = (axis - x0) / LONG
        inside = (t >= 0.0) & (t < 1.0)
        y = y0 + 3.0 * t + up
        place = x0 + LONG * (LINE - FIRST) / (LAST - FIRST) + redder
        spectrum = brighter * light * (0.9 * inside / LONG + 0.1 * made_gauss(axis, place, 1.0))
        image += rng.poisson(np.maximum(spectrum * made_gauss(axis[:, None], y, 0.8), 0.0))
        rows.append({
            "id": i, "order": 1, "wavelength_first": FIRST, "wavelength_last": LAST, "x_first": x0, "y_first": y0,
            "x_last": x0 + LONG, "y_last": y0 + 3.0, "trace_x": [x0, LONG], "trace_y": [y0, 3.0], "expected": light,
            "drawn": light, "overlapped": 0.0, "line_wavelength": [LINE], "line_snr": [50.0],
        })  # fmt: skip
    header = {"CHANNEL": "NISP-S", "IMAGETYP": "science"}
    still = np.zeros(n)
    known = made.known(still, still, still + 20.0)
    known.id[:] = np.arange(n)
    of = FrameContext(
        Place("NISP-S", "nisp_red", 1, "DET11"), Frame(image.astype(np.float32), (), None, header, None), known
    )
    of.spectra, of.noise = pa.Table.from_pylist(rows), 10.0
    return of


def made_gauss(x, middle, sigma):
    return np.exp(-0.5 * ((x - middle) / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)


def test_correct_spectra_pass():
    assert made.verdicts(SPECTRA, frame()) == dict.fromkeys(("flux", "trace", "wavelength", "lines"), PASS)


@pytest.mark.parametrize(
    ("wrong", "quantity"), [({"up": 0.3}, "trace"), ({"brighter": 1.1}, "flux"), ({"redder": 0.8}, "wavelength")]
)
def test_faulty_spectra_fail(wrong, quantity):
    found = made.verdicts(SPECTRA, frame(**wrong))
    assert found.pop(quantity) == FAIL
    assert set(found.values()) == {PASS}


@nightly.parametrize("redder", [5.0, 8.0, -20.0], (1,))
def test_lines_far_from_expected_positions_fail(redder):
    """The expected positions then contain noise, whose centroids scatter around 0."""
    found = made.verdicts(SPECTRA, frame(redder=redder))
    assert found["lines"] == FAIL
    assert found["wavelength"] != PASS


def test_too_few_spectra_are_not_applicable():
    found = SPECTRA.run(frame(n=2))
    assert [row.verdict for row in found] == [NOT_APPLICABLE] * 3
    assert found[0].note.startswith("flux: 2 isolated and bright spectra")
    # Quantities differ because they are part of the key of the table.
    validate.check_rows(publishing.build_table(found), VALIDATION)
