"""Halos: mass function, completeness and bias, and their cells."""

import dataclasses

import numpy as np
import pytest

from lake_schema import ids, sky
from tests.truesky import nightly
from tests.truesky.catalogue.conftest import SEED
from truesky.catalogue.halos import halos
from truesky.cosmology import FIDUCIAL


@pytest.fixture(scope="module")
def model(universe):
    return universe.population.halos


@pytest.mark.parametrize("order", halos.LEVELS)
def test_a_reach_never_leads_beyond_the_cells_about(order, rng):
    """Cells everywhere on the sky, random positions inside them, and steps in any direction."""
    for cell in rng.integers(0, 12 << 2 * order, 30).tolist():
        _, ra, dec = sky.random_in_cell(order, cell, 300, rng)
        angle, length = 2 * np.pi * rng.random(300), np.degrees(halos.reach(order))
        lat, lon = np.radians(dec), np.radians(ra)
        vector = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(300)])
        north = np.cross(vector, east, axis=0)
        moved = vector * np.cos(np.radians(length)) + np.sin(np.radians(length)) * (
            np.cos(angle) * north + np.sin(angle) * east
        )
        to = sky.cell_at(np.degrees(np.arctan2(moved[1], moved[0])), np.degrees(np.arcsin(moved[2])), order)
        assert np.isin(to, [cell, *sky.margin_cells(order, cell, order).tolist()]).all()


def test_every_halo_has_one_level(model):
    """Each mass bin above the limit is drawn by one order; less than one halo of the sky is larger than any level."""
    wanted = model.log_mass[None, 1:] >= (model.min_mass_limit - model.matching.occupation.depth)[:, None]
    left_out = wanted & (model.level == -1)
    expected = np.sum(np.where(left_out, model.number, 0.0) * model.steps.volume[:, None]) * 4 * np.pi
    assert expected < 1.0
    assert set(np.unique(model.level)) == {-1, *halos.LEVELS}


@pytest.mark.parametrize("order", halos.LEVELS)
def test_halos_lie_in_their_cell(model, order):
    found = halos.draw(model, SEED, order, 70)
    assert np.all(found.index >> 2 * (29 - order) == 70)
    assert np.all(np.diff(found.index) >= 0)
    assert np.unique(found.id).size == found.id.size
    assert np.array_equal(found.id >> ids.BLOCK_BITS, found.index >> 2 * (29 - ids.GENERATION_ORDER))
    assert np.all(
        (found.log_mass >= model.mass_limit(found.chi) + model.host_offset)
        | (found.proxy >= model.mass_limit(found.chi))
    )
    # The scatter ends where the depth does.
    assert np.all(np.abs(found.proxy - found.log_mass) <= model.matching.occupation.depth + 1e-9)


@pytest.mark.parametrize("order", halos.LEVELS)
def test_halos_above_a_mass_are_the_same_to_any_limit(model, order):
    """Halos for lensing do not depend on the request's limit for galaxies."""
    least = np.where(model.steps.z < 1.5, 12.0, np.inf)
    every, few = halos.draw(model, SEED, order, 70, least), halos.draw(model, SEED, order, 70)
    shallow = dataclasses.replace(model, limit=model.limit + 1.0, max_distance=2000.0)
    again = halos.draw(shallow, SEED, order, 70, least)
    both = few.select((few.log_mass >= 12.0) & (few.chi < 2000.0))
    kept = every.select(
        (every.log_mass >= np.maximum(12.0, model.mass_limit(every.chi) + model.host_offset)) & (every.chi < 2000.0)
    )
    assert kept.id.size > 0 or order == 2
    for name in ("id", "index", "chi", "log_mass", "proxy", "velocity"):
        assert getattr(every, name).tobytes() == getattr(again, name).tobytes()
        complete = both.log_mass >= model.mass_limit(both.chi) + model.host_offset
        assert getattr(kept, name).tobytes() == getattr(both, name)[complete].tobytes()


def test_identifiers_can_number_the_fullest_block(model):
    """Mean numbers in blocks at the densest place of the box fit into identifiers, for any limit and redshift.

    Significance 1e-9 for one block (6 standard errors): the sample is every block of the sky.
    """
    most = np.array([float(smooth.max()) for smooth in model.box.smoothed])
    peak = np.exp(model.amplitude * most[model.field] - 0.5 * model.amplitude**2 * model.box.variance[model.field])
    mean = model.number * (model.steps.volume * np.radians(1.0) ** 2 * sky.cell_area(8))[:, None] * peak
    room = 2.0 ** (23 - ids.member_bits(model.log_mass[:-1]))
    # A block is wider than a cell of the box only where its pieces are of several: its densest is of one.
    assert np.max((mean + 6.0 * np.sqrt(mean)) / room) < 1.0


def test_mass_function_comes_out(model, drawn):
    """Above the limit, where halos are complete; 20 cells share large structures.

    Significance 6e-5 (4 standard errors), or 10 % for the structures: the sample is all halos of 1.05 deg2.
    """
    z, mass = (drawn.halos[name].to_numpy() for name in ("z_true", "log_mass"))
    for low, high in ((0.5, 1.0), (1.0, 1.6), (1.6, 2.2)):
        steps = (model.steps.z > low) & (model.steps.z < high)
        for least in (11.0, 12.0, 13.0):
            bins = np.round(model.log_mass[:-1], 3) >= least - 1e-3
            mean = np.sum(model.number[np.ix_(steps, bins)].sum(1) * model.steps.volume[steps])
            mean *= drawn.area * np.radians(1.0) ** 2
            found = np.sum((z > low) & (z < high) & (mass > least))
            assert found == pytest.approx(mean, rel=0.10, abs=4 * np.sqrt(mean))


@nightly.parametrize("low_k", [0.03, 0.08], (0,))
@pytest.mark.parametrize(("low", "high", "redshift"), [(11.5, 12.5, 0.0), (12.5, 13.5, 0.5), (12.0, 13.0, 1.5)])
def test_bias_of_the_field_that_halos_follow(model, low, high, redshift, low_k):
    """On large scales the power of exp(x g - ...) is x^2 / D^2 times that of the matter."""
    from tests.truesky.catalogue.matter.test_density_box import spectrum

    box, step = model.box, int(np.searchsorted(model.steps.z, max(redshift, 0.003)))
    growth = float(FIDUCIAL.growth(redshift))
    for column in (np.searchsorted(model.log_mass, low), np.searchsorted(model.log_mass, high)):
        x, field, amplitude = (float(table[step, column]) for table in (model.x, model.field, model.amplitude))
        smooth, variance = box.smoothed[int(field)], box.variance[int(field)]
        number = np.exp(amplitude * smooth - 0.5 * amplitude**2 * variance) - 1.0
        k, power, weight = spectrum(number, box.model.cell)
        inside = (k > low_k) & (k < 2.5 * low_k)
        matter = spectrum(np.expm1(box.smoothed[0] - 0.5 * box.variance[0]), box.model.cell)[1]
        ratio = np.sum((weight * power)[inside]) / np.sum((weight * matter)[inside])
        assert np.sqrt(ratio) / x == pytest.approx(1.0, abs=0.07), (growth, x)
