"""Detection of sources that are in the image, and of sources that are only in the truth table."""

from dataclasses import replace

import numpy as np
import pytest

from tests.truesky.validation.lake import made
from truesky.validation.lake.images.completeness import COMPLETENESS
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS


@pytest.fixture(scope="module")
def faint(tmp_path_factory):
    """Points down to undetectable magnitudes."""
    of = made.scene(np.random.default_rng(3), 900, faintest=28.5)
    return made.vis(tmp_path_factory.mktemp("faint"), of=of)[0]


def test_half_are_found_at_the_expected_limit(faint):
    assert made.verdicts(COMPLETENESS, faint) == {"half": PASS, "bright": PASS}


def test_sources_that_were_not_drawn(faint):
    """Every third source is drawn at another position."""
    known = faint.sources
    off = np.where(np.arange(len(known)) % 3 == 0, 14.0, 0.0)
    wrong = replace(faint, sources=replace(known, x=known.x + off), series={})
    assert made.verdicts(COMPLETENESS, wrong)["bright"] == FAIL


def test_an_image_of_another_sky(faint):
    """No source is at its position, so there is no 50 % limit; the check must fail nevertheless."""
    known = faint.sources
    wrong = replace(faint, sources=replace(known, x=known.x + 14.0), series={})
    assert made.verdicts(COMPLETENESS, wrong) == {"bright": FAIL}


def test_sources_that_are_fainter_than_they_should_be(faint):
    known = faint.sources
    wrong = replace(faint, sources=replace(known, expected=6.0 * known.expected), series={})
    assert made.verdicts(COMPLETENESS, wrong)["half"] == FAIL


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("noise", "why"), [(0.07, "objects cover"), (0.01, "sep: internal pixel buffer full")])
def test_crowded_frames_are_not_applicable(faint, noise, why):
    """With noise that is too small most pixels belong to objects, and with even smaller noise sep's buffer is full."""
    wrong = replace(faint, noise=noise * faint.noise, series={})
    (row,) = COMPLETENESS.run(wrong)
    assert row.verdict == NOT_APPLICABLE
    assert why in row.note
