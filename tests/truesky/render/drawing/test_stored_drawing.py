"""A detector with additional sources is the same, whether all sources are drawn or only the additional ones."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from tests.truesky.render.fields import galaxies, psf_of
from truesky.render.drawing import stamps
from truesky.render.drawing.stamps import Tally
from truesky.render.drawing.stored_drawing import DrawingStore
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

SIDE = 256
# Identifiers from this number on belong to additional sources.
ADDITIONAL = 100


def points(first, count, electrons=3e4):
    """Stars at random places on and around the detector, with numbers from `first` on."""
    rng = np.random.default_rng(first)
    shapes = galaxy_shapes.shapes(galaxies(0.0, 0.0).slice(0, 0))
    x, y = rng.uniform(-30.0, SIDE + 30.0, (2, count))
    jacobian, none = np.tile(0.1 * np.eye(2), (count, 1, 1)), np.full(count, -1)
    return Sources(first + np.arange(count), x, y, jacobian, electrons * rng.random(count), none, shapes)


def joined(one, two):
    names = ("ids", "column", "row", "jacobian", "electrons", "shape")
    return replace(one, **{name: np.concatenate([getattr(one, name), getattr(two, name)]) for name in names})


def drawn(sources, store=None, psf=None):
    """Return the image, and the electrons of each source on it."""
    sizes, neglected, electrons = np.full(len(sources), 64), np.full(len(sources), 1e-7), np.zeros(len(sources))
    arguments = None, neglected, Tally(electrons, (100, 108))
    psf = psf or psf_of("vis")
    if store is None:
        return stamps.draw(sources, sizes, psf, SIDE, SIDE, *arguments), electrons
    return store.draw(sources, sizes, psf, (SIDE, SIDE), *arguments), electrons


def store_of(*lists):
    """Return a store that has drawn these lists of sources."""
    store = DrawingStore(lambda ids: ids >= ADDITIONAL)
    for sources in lists:
        drawn(sources, store)
    return store


BASE, NEW, OTHER = points(1, 40), points(ADDITIONAL, 5), points(ADDITIONAL + 7, 1)


def test_a_result_is_computed_once_for_each_key():
    store, calls = store_of(), []
    results = [store.keep(key, lambda: calls.append(1) or len(calls)) for key in ("a", ("a", 0.1), "a", ("a", 0.1))]
    assert results == [1, 2, 1, 2]


def test_a_copy_of_a_psf_with_another_image_finds_no_results_for_the_first():
    psf = replace(psf_of("vis"), derived={})
    assert psf.keep(("x",), lambda: 1) == 1
    assert psf.keep(("x",), lambda: 2) == 1
    assert replace(psf, intra_pixel=0.3).keep(("x",), lambda: 3) == 3
    assert replace(psf, profile=psf.profile.shear(g1=0.1)).keep(("x",), lambda: 4) == 4
    assert psf_of("vis").keep(("x",), lambda: 5) == 5


@pytest.mark.parametrize("before", [(), (BASE,), (joined(BASE, NEW),), (BASE, joined(BASE, OTHER))])
@pytest.mark.parametrize("sources", [BASE, joined(BASE, NEW), joined(BASE, OTHER)])
def test_a_stored_drawing_gives_the_same_image(before, sources):
    for expected, given in zip(drawn(sources), drawn(sources, store_of(*before)), strict=True):
        np.testing.assert_array_equal(given, expected)


def test_sources_are_drawn_once():
    store = store_of(BASE)
    with mock.patch.object(stamps, "draw_in_units", wraps=stamps.draw_in_units) as made:
        drawn(joined(BASE, NEW), store)
    assert [len(call.args[0]) for call in made.call_args_list] == [len(NEW)]


@pytest.mark.parametrize(
    "changed",
    [
        replace(BASE, column=BASE.column + 1e-9),
        replace(BASE, electrons=np.nextafter(BASE.electrons, np.inf)),
        replace(BASE, jacobian=1.01 * BASE.jacobian),
        replace(BASE, trail=np.full((40, 2), 6.0)),
        replace(BASE, photons=np.full((40, 8), 0.125)),
        BASE.take(np.arange(39)),
        joined(BASE, points(50, 1)),
        # This source needs coarser integers than the others.
        joined(BASE, points(ADDITIONAL, 1, 1e17)),
    ],
)
def test_other_sources_are_not_taken_from_the_store(changed):
    for expected, given in zip(drawn(changed), drawn(changed, store_of(BASE)), strict=True):
        np.testing.assert_array_equal(given, expected)


def test_a_store_is_for_one_detector():
    store = store_of()
    for key in (("exposure", 1), ("exposure", 1)):
        store.check(key)
    with pytest.raises(ValueError, match="for one detector of one exposure"):
        store.check(("exposure", 2))


def test_another_response_is_not_taken_from_the_store():
    psf = replace(psf_of("vis"), intra_pixel=0.05)
    expected, given = drawn(BASE, psf=psf)[0], drawn(BASE, store_of(BASE), psf)[0]
    np.testing.assert_array_equal(given, expected)
    assert not np.array_equal(given, drawn(BASE)[0])
