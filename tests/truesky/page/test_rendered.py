"""Rendered images: true positions agree with the light in the images."""

import numpy as np
import pytest
import sep

from lake_schema.store import layout, publish
from tests import requests
from tests.truesky.page.conftest import serving, unpacked
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.page import pictures
from truesky.page.lake_session import LakeSession
from truesky.render import plan_exposures, render_exposures
from truesky.request.from_toml import parse

SIDE, COUNT, STARS = 1024, 260, 200
# Rms of the window of centroids: 0.1 arcsec, in pixels.
WINDOW = 1.0
POINTING = """
[[pointing]]
channel = "{}"
camera = "{}"
band = "{}"
ra = 53.117
dec = -27.808
mjd = 60905.0
detectors = ["{}"]
centre_on = "{}"
"""
TEXT = f"""
accuracy = "draft"
[mission]
overrides = {{"vis.fpa.nx" = {{value = {SIDE}, unit = "pix"}}, "vis.fpa.ny" = {{value = {SIDE}, unit = "pix"}}}}
[sources]
only = "table"
band = "euclid_vis"
stars = "stars.csv"
[products]
truth = ["noise_free"]
"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Return a lake with a VIS detector and a grism detector with the same stars."""
    folder, rng = tmp_path_factory.mktemp("rendered"), np.random.default_rng(11)
    x, y = rng.uniform(-0.48, 0.48, (2, COUNT)) * SIDE * 0.1 / 3600.0
    ra, dec, mags = 53.117 + x / np.cos(np.radians(-27.808)), -27.808 + y, rng.uniform(15.0, 22.0, COUNT)
    lines = [f"{a},{d},{m}" for a, d, m in zip(ra, dec, mags, strict=True)]
    (folder / "stars.csv").write_text("\n".join(["ra,dec,mag", *lines]) + "\n")
    pointings = POINTING.format("VIS", "vis", "euclid_vis", "3-4", "3-4")
    pointings += POINTING.format("NISP-S", "nisp", "nisp_red", "DET22", "DET22")
    request = parse(requests.written(folder, TEXT + pointings, requests.FIELD.format(0.25), seed=5))
    root = layout.resolve_lake(folder / "lake")
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        for step in module.steps(root, request):
            publish.make_version(root, step.plan, step.run_task)
    return root


@pytest.mark.nightly
def test_the_brightest_stars_are_where_the_truth_says(rendered):
    """Use the noise-free image, because saturation, charge trails and noise shift the stars of a raw image.

    Positions are centroids in a Gaussian window; coma moves the peak by 0.03 pixels.
    """
    lake = LakeSession(rendered, memory=1e9)
    try:
        (number,) = (
            n for n, one in enumerate(pictures.pictures(lake))
            if (one.row["content"], one.row["channel"]) == ("noise_free", "VIS")
        )  # fmt: skip
        image, truth = pictures.picture(lake, number).levels()[0], pictures.bright_sources(lake, number)
    finally:
        lake.close()
    place = np.array([truth["x"], truth["y"]]).T
    inside = ((place > 6) & (place < SIDE - 7)).all(axis=1)
    # Rows of charge injection contain no light.
    dark = np.flatnonzero((image == 0.0).all(axis=1))
    inside &= (np.abs(place[:, 1, None] - dark) > 3.0).all(axis=1)
    # Stars in the light of a brighter star have no separate peak.
    apart = np.array([all(np.hypot(*(place[:k] - at).T) > 12.0) for k, at in enumerate(place)])
    brightest = place[inside & apart][:STARS]
    assert len(brightest) == STARS
    x, y, _ = sep.winpos(image.astype(float), *brightest.T, WINDOW, subpix=0)
    away = np.stack([x, y], axis=1) - brightest
    # The light of other stars moves the centroid of a faint one.
    assert np.abs(np.median(away, axis=0)).max() <= 0.005
    assert np.abs(away).max() <= 0.05


@pytest.mark.nightly
def test_the_trace_lies_on_the_spectrum(rendered):
    with serving(rendered) as page:
        listed = page.json("images")
        number = next(one["number"] for one in listed if (one["channel"], one["content"]) == ("NISP-S", "noise_free"))
        brightest = page.json(f"truth/{number}")["id"][:12]
        strips = [unpacked(page.of_lake(f"trace/{number}/{one}?order=1")[2]) for one in brightest]
    for head, rest in strips:
        pixels = np.frombuffer(rest, "<f4").reshape(head["rows"], head["columns"])
        middle = head["rows"] // 2
        # Among the nearest rows, the row of the trace has the most light. Rows farther away may contain other spectra.
        assert np.nanmedian(pixels, axis=1)[middle - 3 : middle + 4].argmax() == 3
