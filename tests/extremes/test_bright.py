"""The brightest sources in the longest exposures have their flux, no negative pixels, and are all drawn."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.ids import kind_from_id
from lake_schema.store import validate
from lake_schema.tables.galaxies import GALAXIES
from tests.extremes.test_stamps import source_of
from tests.truesky.render import nominal
from tests.truesky.render.fields import psf_of, small
from truesky.render.drawing import reference, stamp_sizes, stamps
from truesky.render.drawing.kernels import fourier, frame
from truesky.render.drawing.settings import settings_for
from truesky.render.psf.seeing import moffat_psf
from truesky.request.accuracy import DRAFT, SURVEY

NOISE = {"vis": 12.0, "lsstcam": 38.0}
# Magnitudes from the Moon's to faint stars', in no time and in eleven days: electrons.
LIGHT = st.floats(0.0, 16.9).map(lambda x: 10.0**x)


def drawn(camera, electrons, seeing=None, side=256, accuracy=SURVEY, most=1024, **shape):
    """Return (frame, size, light of the stamp on it) for one source with a limit on its stamp size."""
    source = source_of(camera, electrons, column=side / 2 + 0.3, row=side / 2 - 0.4, **shape)
    beam = psf_of(camera) if seeing is None else moffat_psf(seeing, 3.0, 0.2)
    settings, noise = settings_for(accuracy), NOISE[camera]
    sizes = stamp_sizes.stamp_sizes(source.electrons, source.shape, source.shapes, beam, noise, settings)
    light = np.zeros(1)
    sizes, neglected = np.minimum(sizes, most), stamp_sizes.neglected_flux(source.electrons, noise, settings)
    return (
        stamps.draw(source, sizes, beam, side, side, neglected=neglected, tally=stamps.Tally(light)),
        sizes[0],
        light[0],
    )


@given(
    LIGHT,
    st.sampled_from(["vis", "lsstcam"]),
    st.sampled_from([DRAFT, SURVEY]),
    st.sampled_from([{}, {"bulge_fraction": 0.5}]),
)
@example(5e13, "vis", SURVEY, {})
@example(1e17, "lsstcam", SURVEY, {"inclination": 80.0})
def test_no_pixel_overflows(electrons, camera, accuracy, shape):
    image, _, light = drawn(camera, electrons, accuracy=accuracy, most=256, **shape)
    rounding = image.size / fourier.units_of(np.array([electrons]))
    assert image.sum() == pytest.approx(electrons, rel=2e-3, abs=rounding)
    assert light == pytest.approx(electrons, rel=2e-3, abs=rounding)
    assert image.max() > 0.01 * electrons - rounding


@given(LIGHT, st.floats(0.4, 1.4), st.sampled_from([DRAFT, SURVEY]))
@example(30.0 * 10 ** (0.4 * (28.17 + 1.0)), 0.73, SURVEY)
@example(30.0 * 10 ** (0.4 * 28.17), 0.73, SURVEY)
@example(10.0**10.5, 0.4375, DRAFT)
@example(10.0**9.5, 0.4, DRAFT)
def test_bright_stars_have_no_ringing(electrons, seeing, accuracy):
    """For any sampled seeing, no pixel of the frame is negative by more than a tenth of its noise."""
    image, *_ = drawn("lsstcam", electrons, seeing, accuracy=accuracy)
    unit = fourier.units_of(np.array([electrons]))
    assert image.min() > -0.1 * NOISE["lsstcam"] - 1.0 / unit - 1e-12 * electrons * (electrons > 1e14)


def test_frame_resolution_depends_only_on_the_total_charge():
    """The resolution of the frame's integers is as fine as their sum allows, in any order."""
    assert fourier.units_of(np.array([])) == fourier.units_of(np.full(10, 1e11)) == frame.FIXED_POINT
    light = 10.0 ** np.random.default_rng(1).uniform(0, 17, 1000)
    unit = fourier.units_of(light)
    assert unit == fourier.units_of(light[::-1])
    assert 2.0**60 <= unit * light.sum() * 2.0 <= 2.0**62
    assert np.log2(unit) == np.rint(np.log2(unit))


@pytest.mark.parametrize(("mag", "seconds"), [(-1.46, 560.5), pytest.param(8.0, 1e6, marks=pytest.mark.nightly)])
def test_the_brightest_star_in_the_longest_exposure(mag, seconds):
    """The star is in the truth, and its pixels are saturated, without a dark centre."""
    quiet = nominal.off("cosmic_rays", "readout_cosmic_rays")
    one = nominal.rendered(
        small("vis", "3-4", 256), [mag, 20.0], [100.2, 30.0], [110.7, 220.0], seconds=seconds, forced=quiet
    )
    # Asteroids may cross the field in an exposure of many days.
    assert (kind_from_id(one.sources.ids) == 5).sum() == 2
    assert one.noise_free.min() >= 0.0
    bright = int(np.argmax(one.sources.electrons))
    assert one.drawn_electrons[bright] == pytest.approx(one.sources.electrons[bright], rel=0.02)
    assert one.noise_free[111, 100] == one.noise_free.max() > 0.05 * one.sources.electrons[bright]
    # Its column is full.
    full = one.science[:128, 100].astype(float)
    assert full.min() > 0.9 * full.max()


def test_more_charge_than_the_maximum_is_refused():
    with pytest.raises(BadInput, match="electrons"):
        nominal.rendered(small("vis", "3-4", 64), [-20.0], [30.0], [30.0], seconds=1e6)


@pytest.mark.parametrize("ratio", [0.01, pytest.param(0.02, marks=pytest.mark.nightly)])
def test_axis_ratio_is_drawn_exactly(ratio):
    """Compare with an ellipse of galsim, also for ratios below the limit of the table of galaxies."""
    source = source_of(
        "vis", 1e6, column=64.0, row=64.0, bulge_fraction=1.0, bulge_sersic_index=1.0, bulge_axis_ratio=ratio
    )
    asked = replace(source, shapes=replace(source.shapes, bulge_axis_ratio=np.array([ratio])))
    image = stamps.draw(source, np.array([128]), psf_of("vis"), 128, 128)
    expected = reference.draw_reference(asked, 0, psf_of("vis"), 128)
    np.testing.assert_allclose(image[34:94, 34:94], expected[34:94, 34:94], atol=1e-3 * expected.max())


def test_a_bulge_slimmer_than_the_limit_is_refused():
    (column,) = (c for c in GALAXIES.columns if c.name == "bulge_axis_ratio")
    for ratio, wrong in ((0.01, 1), (0.02, 0)):
        values = pa.chunked_array([pa.array([1.0, ratio], pa.float32())])
        assert len(validate._content_violations(values, column, "galaxies")) == wrong
