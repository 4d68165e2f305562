"""A source through a grism: its traces in the lake, and the pixels along them."""

import json

import numpy as np
import pytest

from lake_schema.fits import images
from lake_schema.store import layout, parquet, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
from tests.truesky.page.conftest import CENTRE, NX, NY, serving, system, unpacked
from tests.universe import rows_of
from truesky.fluxes.spectra import lines
from truesky.render.camera import astrometry
from truesky.render.products.sidecar_files import spectra_file, truth_file

# Polynomials of a bent trace, its wavelength range (angstrom), and pixel values of the continuum and of the line.
TRACE_X, TRACE_Y = [80.0, 500.0, 0.0], [300.0, -40.0, 12.0]
FIRST, LAST = 12060.0, 18920.0
LEVEL, LINE = 50.0, 900.0


def galaxy():
    """Return galaxies, the id of one whose H-alpha line is near 15000 angstrom, and the wavelength of this line."""
    rows = rows_of(GALAXIES, 20, seed=4)
    z = rows["z_obs"].to_numpy()
    halpha = next(line.vacuum for line in lines.line_list() if line.name == "halpha")
    own = int(np.argmin(np.abs((1.0 + z) * halpha - 15000.0)))
    return rows, rows["id"][own].as_py(), float((1.0 + z[own]) * halpha)


def spectrum_image(wavelength):
    """Return an image with a bright band, one pixel wide, along the trace, and a brighter line."""
    out = np.full((NY, NX), 1.0)
    t = np.linspace(0.0, 1.0, 20_000)
    x, y = (np.rint(np.polynomial.polynomial.polyval(t, part)).astype(int) for part in (TRACE_X, TRACE_Y))
    out[y, x] = LEVEL
    at = (wavelength - FIRST) / (LAST - FIRST)
    near = np.abs(t - at) < 0.5 / TRACE_X[1]
    out[y[near], x[near]] = LINE
    return out.astype(np.float32)


def published(root, trace_x=TRACE_X, name=None, band="nisp_red", seconds=0):
    """Publish galaxies, a grism image of one of them and its truth; return its id and the wavelength of its line.

    `name` is the name of the request. A different number of `seconds` gives a different version.
    """
    rows, own, wavelength = galaxy()
    cards = (*astrometry.cards(system()), ("BUNIT", "electron", "unit"))
    corners = astrometry.sky_of_pixel(system(), [0, NX - 1, NX - 1, 0], [0, 0, NY - 1, NY - 1])
    path = "images/000007/nisp_science.fits"
    products = PRODUCTS.build({
        "path": [path], "content": ["science"], "exposure_id": [7], "detector": ["DET22"], "channel": ["NISP-S"],
        "band": [band], "ra": [CENTRE[0]], "dec": [CENTRE[1]], "mission": ["m"], "sources": [1],
        "s_region": ["POLYGON ICRS " + " ".join(f"{a:.7f} {d:.7f}" for a, d in zip(*corners, strict=True))],
    })  # fmt: skip
    place = {"exposure_id": [7], "detector": ["DET22"], "id": [own]}
    truth = RENDERED_TRUTH.build({
        **place, "x": [330.0], "y": [290.0], "expected": [5e4], "drawn": [4e4], "stamp": [19], "method": [1],
        "trail_x": [None], "trail_y": [None],
    })  # fmt: skip
    ends = {f"{axis}_{end}": [at(part)] * 2 for axis, part in (("x", trace_x), ("y", TRACE_Y))
            for end, at in (("first", lambda p: p[0]), ("last", sum))}  # fmt: skip
    spectra = RENDERED_SPECTRA.build({
        **{key: value * 2 for key, value in place.items()}, "order": [0, 1], **ends,
        "wavelength_first": [FIRST] * 2, "wavelength_last": [LAST] * 2,
        "trace_x": [trace_x] * 2, "trace_y": [TRACE_Y] * 2, "expected": [10.0, 4e4], "drawn": [9.0, 3.9e4],
        "overlapped": [None, 0.25], "contaminants": [[], [int(own) + 1]],
        "line_wavelength": [[], [wavelength]], "line_expected": [[], [850.0]], "line_snr": [[], [7.5]],
    })  # fmt: skip
    pixels = spectrum_image(wavelength)
    files = {
        path: lambda to: images.write_images(to, [images.Image(pixels, cards)]),
        truth_file(7, "DET22"): lambda to: parquet.write(to, truth, RENDERED_TRUTH),
        spectra_file(7, "DET22"): lambda to: parquet.write(to, spectra, RENDERED_SPECTRA),
    }
    part = Task("000007-det22.parquet", {"exposure_id": 7, "detector": "DET22"})
    cell = Task(layout.cell_file(5, 1607), {})
    publish.make_version(root, Plan(GALAXIES, {}, (cell,)), lambda lake, facts: Output(rows), name=name)
    for table, made in (
        (PRODUCTS, Output(products, files)), (RENDERED_TRUTH, Output(truth)), (RENDERED_SPECTRA, Output(spectra)),
    ):  # fmt: skip
        plan = Plan(table, {"seconds": seconds} if seconds else {}, (part,))
        publish.make_version(root, plan, lambda lake, facts, made=made: made, name=name)
    return own, wavelength


@pytest.fixture(scope="module")
def grism(tmp_path_factory):
    root = tmp_path_factory.mktemp("grism") / "lake"
    root.mkdir()
    own, wavelength = published(root)
    with serving(root) as page:
        yield page, own, wavelength


def test_traces_of_a_source(grism):
    page, own, wavelength = grism
    zeroth, first = page.json(f"source/{own}")["spectra"]
    assert (zeroth["order"], zeroth["lines"], zeroth["overlapped"]) == (0, [], None)
    assert (first["trace_x"], first["trace_y"]) == (TRACE_X, TRACE_Y)
    assert (first["channel"], first["band"], first["images"]) == ("NISP-S", "nisp_red", {"science": 0})
    assert first["contaminants"] == [str(own + 1)]
    assert first["lines"] == [{"name": "halpha", "wavelength": wavelength, "expected": 850.0, "snr": 7.5}]


def test_pixels_along_a_trace(grism):
    page, own, wavelength = grism
    status, _, body = page.of_lake(f"trace/0/{own}?order=1")
    head, rest = unpacked(body)
    assert (status, head["first"], head["last"]) == (200, FIRST, LAST)
    pixels = np.frombuffer(rest, "<f4").reshape(head["rows"], head["columns"])
    middle = head["rows"] // 2
    # In the straightened pixels, the light is in the middle row, or one row off where the trace is between rows.
    bright = pixels >= LEVEL
    assert set(np.flatnonzero(bright.any(axis=1))) <= {middle - 1, middle, middle + 1}
    assert bright[middle].mean() > 0.95
    # The line is at its wavelength, within about a pixel.
    column = pixels[middle].argmax()
    step = (LAST - FIRST) / (head["columns"] - 1)
    assert FIRST + column * step == pytest.approx(wavelength, abs=1.5 * step)
    assert pixels[middle, column] == LINE


def test_the_source_of_a_pixel_behind_a_grism(grism):
    """A click anywhere on the first order finds its source, and none is found beside it."""
    page, own, _ = grism
    for t in (0.0, 0.31, 1.0):
        x, y = (np.polynomial.polynomial.polyval(t, part) for part in (TRACE_X, TRACE_Y))
        for shift in (0.0, 3.0):
            assert page.json(f"trace_at/0?x={x}&y={y + shift}") == {"id": str(own)}
        assert page.json(f"trace_at/0?x={x}&y={y + 6.0}") == {}
    # The position of the source in an image without a grism.
    assert page.json("trace_at/0?x=330&y=250") == {}
    status, _, _ = page.of_lake("trace_at/9?x=1&y=1")
    assert status == 400


@pytest.mark.parametrize("path", ["trace/0/{}?order=2", "trace/0/{}", "trace/1/{}?order=1", "trace/0/5?order=1",
                                  "trace/0/x?order=1", "trace/0/{}?order=nan"])  # fmt: skip
def test_sources_without_a_trace_are_refused(grism, path):
    page, own, _ = grism
    status, _, body = page.of_lake(path.format(own))
    assert status == 400
    assert json.loads(body)["error"]


def test_beyond_the_image_there_is_nothing(tmp_path):
    """Pixels of a trace outside the detector are NaN."""
    root = tmp_path / "lake"
    root.mkdir()
    own, _ = published(root, [500.0, 500.0, 0.0])
    with serving(root) as page:
        head, rest = unpacked(page.of_lake(f"trace/0/{own}?order=1")[2])
    pixels = np.frombuffer(rest, "<f4").reshape(head["rows"], head["columns"])
    assert np.isfinite(pixels[:, :190]).all()
    assert np.isnan(pixels[:, 210:]).all()
