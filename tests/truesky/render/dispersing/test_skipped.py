"""Sources of which nothing is drawn are skipped before their spectra are computed, and no byte changes."""

from dataclasses import replace

import numpy as np

from benchmarks import _scenes as scenes
from tests.truesky import nightly
from tests.truesky.render.dispersing.made import FIRST, LAST, order, psf, trace
from truesky.render.dispersing import draw

COUNT, SHAPE, NOISE = LAST - FIRST + 1, (96, 128), 20.0
# Traces along both axes, a curved one, and responses with zeros and with negative values.
PHASE = np.linspace(0.0, 9.0, COUNT)
ORDERS = (
    order(trace((-40.0, 90.0), 0.07)),
    replace(order(trace((150.0, 60.0), 0.05, order=2)), response=0.03 * np.sin(PHASE)),
    replace(order(trace((-300.0, 4.0, 2.0, -1.0), -0.03, 0, 1.0)), response=0.2 * np.maximum(np.cos(PHASE), 0.0)),
)
# The normalisation has a gap, in which the orders have light.
WEIGHTS = np.where(np.abs(PHASE - 4.0) < 0.5, 0.0, 1.0 + 0.5 * np.cos(PHASE))


def scene(seed, count=40):
    """Return galaxies, stars and moving bodies whose orders end near one of the edges of the frame, or far from it."""
    rng = np.random.default_rng(seed)
    sources = scenes.sources(scenes.NISP, seed, galaxies=2 * count // 3, stars=count - 2 * count // 3)
    which = rng.integers(len(ORDERS), size=count)
    x, y = np.array([ORDERS[m].trace.offsets(0.0, 0.0, ORDERS[m].wavelength[[0, -1]]) for m in which]).swapaxes(0, 1)
    # One end of an order lies on an edge, or up to a few stamps beyond it.
    end, edge = rng.integers(2, size=count), rng.integers(4, size=count)
    away = rng.choice([0.0, 10.0, 40.0, 150.0, 1500.0], count) * rng.normal(size=count)
    column = np.choose(edge, [away, SHAPE[1] + away, *[rng.uniform(0.0, SHAPE[1], count)] * 2])
    row = np.choose(edge, [*[rng.uniform(0.0, SHAPE[0], count)] * 2, away, SHAPE[0] + away])
    sources.column[:], sources.row[:] = column - x[np.arange(count), end], row - y[np.arange(count), end]
    electrons = 10.0 ** rng.uniform(0.0, 5.5, count)
    trail = np.where(
        (sources.shape < 0)[:, None] & (rng.random(count) < 0.3)[:, None], rng.normal(size=(count, 2)), 0.0
    )
    return replace(sources, electrons=electrons, photons=None, trail=150.0 * trail)


def spectra_of(seed):
    """Return normalised spectra by index of the source, from a line to a continuum, and the list of computed ones."""
    computed = []

    def spectra(indices):
        computed.extend(indices.tolist())
        out = np.empty((len(indices), COUNT), np.float32)
        for row, i in zip(out, indices.tolist(), strict=True):
            rng = np.random.default_rng((seed, i))
            line = np.exp(-0.5 * ((np.arange(COUNT) - rng.uniform(0, COUNT)) / rng.choice([0.5, 20.0])) ** 2)
            row[:] = rng.choice([0.0, 1.0]) / COUNT + rng.choice([1e-3, 1.0]) * line
            # Most light of a line may lie in the gap.
            row /= max(row @ WEIGHTS, 1e-3 * row.sum())
        return out

    return spectra, computed


@nightly.parametrize("seed", range(3), (0,))
def test_bytes_are_the_same_as_with_all_spectra(seed):
    sources, results = scene(seed), []
    for weights in (None, WEIGHTS):
        spectra, computed = spectra_of(seed)
        tally, layers = draw.Tally.empty(len(sources), len(ORDERS)), {}
        dispersed = draw.DispersedSources(spectra, ORDERS, draw.Settings(), weights)
        frame = draw.draw(sources, dispersed, psf(), SHAPE, NOISE, tally, layers)
        results.append((frame, tally, layers, computed))
    (frame, tally, layers, computed), (skipped_frame, skipped_tally, skipped_layers, needed) = results
    np.testing.assert_array_equal(skipped_frame, frame)
    for number in layers:
        np.testing.assert_array_equal(skipped_layers[number], layers[number])
    for name in ("electrons", "peak", "sizes"):
        np.testing.assert_array_equal(getattr(skipped_tally, name), getattr(tally, name))
    drawn = tally.sizes > 0
    np.testing.assert_array_equal(skipped_tally.expected[drawn], tally.expected[drawn])
    assert set(computed) == set(range(len(sources)))
    assert set(np.flatnonzero(drawn).tolist()) <= set(needed)
    # Some sources are drawn, and some are skipped.
    assert 5 < drawn.sum() <= len(set(needed)) < len(sources)


def test_without_sources_nothing_is_drawn():
    none = scenes.sources(scenes.NISP, 1, galaxies=1, stars=1).take(np.zeros(0, np.int64))
    dispersed = draw.DispersedSources(lambda _: np.zeros((0, COUNT), np.float32), ORDERS, draw.Settings(), WEIGHTS)
    assert not draw.draw(none, dispersed, psf(), SHAPE, NOISE).any()
