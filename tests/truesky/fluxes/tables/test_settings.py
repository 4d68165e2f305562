"""Test the choice of tables: the smallest with a measured error within the allowed error."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.fluxes import passbands
from truesky.fluxes.tables import settings
from truesky.fluxes.tables.settings import CANDIDATES, MARGIN, choose
from truesky.request.accuracy import DRAFT, REFERENCE, SURVEY

# Bands of Serrano et al. 2024.
BANDS = (
    "euclid_vis", "euclid_y", "euclid_j", "euclid_h", "gaia_g", "gaia_bp", "gaia_rp", "des_g", "des_r", "des_i",
    "des_z", "lsst_u", "lsst_g", "lsst_r", "lsst_i", "lsst_z", "lsst_y", "cfis_u", "cfis_r", "jedis_g", "ps1_i",
    "hsc_z",
)  # fmt: skip


def test_every_band_and_setting_was_measured():
    measured = settings._read_errors()
    assert set(measured) == set(CANDIDATES)
    for of_bands in measured.values():
        assert set(BANDS) <= set(of_bands) <= set(passbands.names())
        assert all(0.0 < choice.rms <= choice.largest for choice in of_bands.values())


@given(st.sampled_from(BANDS), st.floats(1e-6, 1.0))
def test_the_choice_is_the_smallest_that_is_good_enough(band, allowed):
    [choice] = choose([band], dataclasses.replace(SURVEY, flux=allowed))
    smaller = CANDIDATES
    if choice.setting is not None:
        assert MARGIN * choice.largest <= allowed
        smaller = CANDIDATES[: CANDIDATES.index(choice.setting)]
    if allowed > 1e-4:
        for setting in smaller:
            assert MARGIN * settings._read_errors()[setting][band].largest > allowed


def test_the_reference_is_integrated():
    assert all(choice.setting is None for choice in choose(BANDS, REFERENCE))
    assert not settings.stars_tabulated(REFERENCE)


@pytest.mark.parametrize("accuracy", [DRAFT, SURVEY])
def test_the_usual_accuracies_are_tabulated_in_every_band(accuracy):
    choices = choose(BANDS, accuracy)
    assert all(choice.setting is not None for choice in choices)
    assert settings.stars_tabulated(accuracy)


def test_errors_are_below_the_published_ones():
    # Serrano et al. 2024: 0.005 mag rms.
    rms = np.array([choice.rms for choice in choose(BANDS, SURVEY)])
    assert np.sqrt(np.mean(rms**2)) < 1e-4
    assert rms.max() < 5e-4
    draft = np.array([choice.rms for choice in choose(BANDS, DRAFT)])
    assert np.sqrt(np.mean(draft**2)) < 5e-4


def test_higher_accuracy_never_has_a_smaller_table():
    loose, tight = choose(BANDS, DRAFT), choose(BANDS, SURVEY)
    assert all(a.setting.size <= b.setting.size for a, b in zip(loose, tight, strict=True))


def test_an_unknown_band_gets_a_setting_for_all_bands():
    [choice] = choose(["my_filter"], SURVEY)
    assert choice.setting is not None
    assert choice.largest == max(c.largest for c in settings._read_errors()[choice.setting].values())


def test_facts_are_json():
    assert json.loads(json.dumps([choice.facts() for choice in choose(BANDS, SURVEY)]))
    assert json.loads(json.dumps(settings.star_error_facts(SURVEY)))["covered"] == {"a_v": [0.0, 5.0]}
    assert json.loads(json.dumps(settings.star_error_facts(REFERENCE)))["covered"] is None
