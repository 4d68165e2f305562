"""Charge along tracks: thin lines by default, fluctuations of a Moyal distribution, and diffusion."""

from dataclasses import replace
from hashlib import sha256

import numpy as np
import pytest
from scipy import stats

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import resolve
from truesky.render.camera import detectors
from truesky.render.effects.charge import cosmic_rays, track_charge
from truesky.render.effects.charge.track_charge import THIN, Spread
from truesky.render.effects.readout import charge_transfer, readout_cosmic_rays
from truesky.render.effects.scene import Scene

MISSION = resolve()
TRACKS = np.array(MISSION.numbers("env.cosmic_rays.vis_tracks"))
OPTIONS = {"vis.cosmic_rays.diffusion": (0.3, "pix"), "vis.cosmic_rays.straggling": (0.2, "")}


def rng(seed=1):
    return np.random.default_rng(seed)


def scene(overrides):
    mission = resolve(overrides=overrides)
    return Scene(mission, "vis", 560.53, 0.25, 1e4, detectors.detector("vis", "3-4", mission))


def tracks(*rows):
    """Return tracks from rows of x, y, angle, length and charge."""
    x, y, angle, length, charge = np.array(rows, float).T
    return x, y, np.cos(angle), np.sin(angle), length, charge


def distributed(events, spread, seed=1):
    return track_charge.distribute(events, cosmic_rays.pixels_of_events(events), spread, rng(seed))


def test_tracks_are_thin_lines_by_default():
    """Byte for byte as before tracks could be wide: checksums of commit fe465f5."""
    assert track_charge.of_scene(scene({})).is_thin
    assert track_charge.of_scene(Scene(MISSION, "ext.lsstcam", 30.0, 30.0, 1e4)) == THIN
    image = cosmic_rays.draw_tracks((300, 200), 400.0, TRACKS, rng(5))
    assert sha256(image.tobytes()).hexdigest() == "73e183cc0ccfe65277335438ea6e4ea3fd36e5f62387a6dd64a42c6e52600d81"
    read = readout_cosmic_rays.apply_readout(np.zeros((4, 126, 90)), 60.0, TRACKS, (120, 10, 64), None, THIN, rng())
    assert sha256(read.tobytes()).hexdigest() == "e7ad43a93b587952bcb08d2b69a1d934a4b46462dff0939d76f7808a7860719b"


def test_options_of_the_mission_database():
    """40 um of silicon are 3.3 pixels of 12 um; the charge of a pixel cannot exceed that of its track."""
    wide = scene(OPTIONS)
    assert track_charge.of_scene(wide) == Spread(0.3, 0.2, pytest.approx(40 / 12))
    assert cosmic_rays.EFFECT.parameters(wide)[-1] == readout_cosmic_rays.READOUT.parameters(wide)[-1]
    assert cosmic_rays.brightest_pixel(scene({})) < cosmic_rays.brightest_pixel(wide) <= TRACKS[:, 2].max()


@pytest.mark.parametrize("spread", [Spread(0.3), Spread(0.0, 0.2, 3.3), Spread(0.3, 0.2, 3.3), Spread(1.0, 1.0, 0.0)])
def test_every_track_keeps_its_charge(spread):
    """Whole electrons, also of tracks that are shorter than a pixel or have few electrons."""
    events = cosmic_rays.draw_events(2000, 300, 200, TRACKS, rng(3))
    short = tracks((10.5, 20.5, 0.3, 1e-9, 1.0), (30.01, 20.99, 1.0, 0.01, 7.0), (40.0, 41.0, 4.0, 0.5, 1e4))
    events = tuple(np.concatenate(both) for both in zip(events, short, strict=True))
    event, _, _, charge = distributed(events, spread)
    np.testing.assert_array_equal(charge, np.rint(charge))
    assert charge.min() > 0
    np.testing.assert_array_equal(np.bincount(event, charge, len(events[0])), events[5])


@pytest.mark.parametrize(
    ("sigma", "angle", "length"), [(0.3, 0.4, 9.3), (0.3, 2.0, 1e-6), (0.1, 5.0, 3.3), (0.8, 1.6, 6.0)]
)
def test_charge_diffuses_as_single_electrons_would(sigma, angle, length):
    """Against four million electrons that start evenly along the path and move by Gaussian random numbers.

    The sample is 1600 pixels within five standard errors: significance 1e-3.
    """
    x, y, count, draws = 15.2, 18.7, 4_000_000, rng(2)
    event, column, row, charge = distributed(tracks((x, y, angle, length, count)), Spread(sigma))
    assert (event == 0).all()
    image, wanted = np.zeros((2, 40, 40))
    np.add.at(image, (row, column), charge)
    along = length * draws.random(count)
    moved = sigma * draws.standard_normal((2, count))
    places = [np.floor(at + along * step + by).astype(int) for at, step, by in (
        (y, np.sin(angle), moved[0]), (x, np.cos(angle), moved[1])
    )]  # fmt: skip
    np.add.at(wanted, tuple(places), 1.0)
    # The random numbers of the reference, and 0.1 % of the brightest pixel.
    assert (np.abs(image - wanted) <= 5.0 * np.sqrt(wanted + 1.0) + 1e-3 * wanted.max()).all()


def test_energy_losses_have_a_moyal_distribution():
    """A horizontal track along the middle of a row, of which each pixel holds the same path, against scipy.

    The sample is 20,000 pixels; significance 0.01.
    """
    pixels, each, scale = 20_000, 1e6, 0.1
    one = tracks((0.0, 0.5, 0.0, pixels, pixels * each))
    _, column, _, charge = distributed(one, Spread(0.0, scale, 0.0))
    assert len(charge) == pixels == len(np.unique(column))
    assert charge.sum() == pixels * each
    losses = stats.moyal(loc=1.0 - scale * (np.euler_gamma + np.log(2.0)), scale=scale)
    assert losses.mean() == pytest.approx(1.0)
    assert stats.kstest(charge / each, losses.cdf).pvalue > 0.01
    assert charge.std() / each == pytest.approx(losses.std(), rel=0.05)
    # Most pixels hold less than the mean.
    assert 0.5 < (charge < each).mean() < 0.65


def test_the_variance_is_proportional_to_the_path():
    """Silicon three times as thick as the track is long makes the path in each pixel longer by sqrt(10)."""
    pixels, each, scale = 20_000, 1e6, 0.1
    found = []
    for thickness in (0.0, 3.0 * pixels):
        one = tracks((0.0, 0.5, 0.0, pixels, pixels * each))
        found.append(distributed(one, Spread(0.0, scale, thickness))[3].var() / each**2)
    assert found[0] == pytest.approx(scale**2 * np.pi**2 / 2, rel=0.1)
    assert found[0] / found[1] == pytest.approx(np.sqrt(10.0), rel=0.1)


def test_wide_tracks_cover_more_pixels():
    """A line that is 0.3 pixels wide touches one more pixel on each side."""
    thin, wide = (cosmic_rays.draw_tracks((300, 200), 100.0, TRACKS, rng(5), s) for s in (THIN, Spread(0.3)))
    assert thin.sum() == wide.sum()
    assert 1.5 < (wide > 50).sum() / (thin > 50).sum() < 3.0


@pytest.mark.parametrize("spread", [Spread(-0.1), Spread(1.1), Spread(np.nan), Spread(0.0, 2.0), Spread(0.0, np.nan)])
def test_impossible_spreads_are_refused(spread):
    with pytest.raises(OutOfRange, match=r"cosmic rays|straggling"):
        cosmic_rays.draw_tracks((30, 30), 4.0, TRACKS, rng(), spread)


@pytest.mark.parametrize(("key", "value"), [("diffusion", 1.5), ("diffusion", np.nan), ("straggling", -0.1)])
def test_a_request_with_an_impossible_spread_is_refused(key, value):
    name = f"vis.cosmic_rays.{key}"
    with pytest.raises(BadInput, match=rf"vis\.cosmic_rays\.{key}"):
        resolve(overrides={name: (value, MISSION.parameter(name).unit)})


def test_traps_see_the_whole_charge_that_a_wide_track_leaves_in_a_pixel():
    """A dot in the middle of a pixel, and the same charge from eight parts of a short path, lose the same electrons."""
    traps = charge_transfer.silicon_traps(replace(scene({}), mjd=62318.0), "parallel")
    one = np.array([200, 300]), np.array([1500, 1500]), np.array([1500, 1500]), np.array([1000.0, 2000.0])
    parts = tuple(np.repeat(at, 8) for at in one[:3]), np.repeat(one[3] / 8, 8)
    event = np.repeat([0, 1], 8)
    merged = readout_cosmic_rays._merge_hits(event, (*parts[0], parts[1]))
    for found, wanted in zip(merged, one, strict=True):
        np.testing.assert_array_equal(found, wanted)
    images = [np.zeros((2066, 400)) for _ in range(3)]
    for image, hits in zip(images, (one, merged, (*parts[0], parts[1])), strict=True):
        readout_cosmic_rays._deposit(image, *hits, traps)
    np.testing.assert_array_equal(images[0], images[1])
    # Parts that are not added up fill the same traps, and lose much less.
    lost, lost_by_parts = (one[3].sum() - image[one[1], one[0]].sum() for image in (images[0], images[2]))
    assert lost > 30.0
    assert lost_by_parts < 0.6 * lost
    # The same pixel of two tracks is listed twice, and nothing may be left.
    twice = readout_cosmic_rays._merge_hits(np.array([0, 1]), tuple(np.repeat(at[:1], 2) for at in one))
    assert len(twice[0]) == 2
    none = readout_cosmic_rays._merge_hits(event[:0], tuple(at[:0] for at in one))
    assert [len(at) for at in none] == [0, 0, 0, 0]


def test_a_readout_lists_each_pixel_of_a_wide_track_once(monkeypatch):
    """Without this, 60 tracks that are 0.3 pixels wide would list most of their pixels two or three times."""
    listed = []
    monkeypatch.setattr(readout_cosmic_rays, "_deposit", lambda _, column, packet, *__: listed.append((column, packet)))
    readout_cosmic_rays.apply_readout(np.zeros((4, 1200, 900)), 60.0, TRACKS, (1200, 10, 640), None, Spread(0.3), rng())
    for column, packet in listed:
        assert len(np.unique(np.stack([column, packet]), axis=1).T) > 0.97 * len(column) > 300
