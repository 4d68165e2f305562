"""Persistence: which earlier exposures count, and how much charge they leave, in any order of rendering."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.errors import BadInput, OutOfRange
from lake_schema.sky.ecliptic import ecliptic
from tests.truesky.render import fields, infrared, spectroscopic
from tests.truesky.render.drawing.test_arcs import lens
from tests.truesky.render.fields import MISSION, small
from truesky.render.camera import astrometry
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.effects.charge.persistence import PersistenceModel
from truesky.render.exposure import persistence
from truesky.render.exposure.records import PreviousExposure, PreviousSky, Rows, Variant
from truesky.render.psf import euclid
from truesky.render.sources import solar_system
from truesky.render.sources.solar_system import Population
from truesky.request.accuracy import SURVEY

DETECTOR = small("nisp", "DET22", 96)
TRAPS = PersistenceModel(120.0, 150.0, 2e4, -0.9, 100.0, 87.24, 1.3e5, 0.2)
SECOND = 1.0 / 86400.0
EXPLORED = '{"nisp.gain": [1.0, "electron / adu"]}'
# Without bodies that move.
STRIP = spectroscopic.strip()
# Missions in which pixels differ only in the number of their traps.
ALIKE = dict.fromkeys((f"nisp.persistence.{name}_spread" for name in ("p2", "time_power")), (0.0, ""))
EVEN, QUIET = MISSION.with_overrides(ALIKE), spectroscopic.MISSION.with_overrides(ALIKE)


def earlier(before, mags, x, y, mission=EVEN, fraction=1.0, **columns):
    """Return an exposure `before` seconds earlier, with its stars."""
    row = infrared.exposed(DETECTOR, mjd=infrared.MJD - before * SECOND, number=9, **columns)
    aim = Aim.from_exposure(fields.exposure(**row), DETECTOR)
    return previous(aim, Rows(*infrared.tables(DETECTOR, row, mags, x, y)), mission, fraction)


def previous(aim, rows, mission=EVEN, fraction=1.0):
    """Return an earlier exposure whose charge map is drawn from `rows` whenever it is needed."""

    def charge():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(euclid, "nisp_psf", lambda d, *_: infrared.psf_of(d, aim.exposure.band))
            return persistence.draw_charge_map(aim, rows, Variant(mission, SURVEY, {}), infrared.SEED, fraction)

    return PreviousExposure(aim.exposure, charge)


def left(*before, mission=EVEN, **columns):
    """[ny, nx] e- in an exposure now."""
    aim = Aim.from_exposure(fields.exposure(**infrared.exposed(DETECTOR, **columns)), DETECTOR)
    return persistence.total_charge(aim, before, Variant(mission, SURVEY, {}), infrared.SEED)


def test_the_formula():
    """Of 80, 20, 6 and 1.5 ke- 100 s later; falling as time to the power -0.9; nothing above the full well."""
    found = TRAPS.released_charge(np.array([8e4, 2e4, 6e3, 1.5e3, 0.0, -5.0]), 100.0, 87.24)
    np.testing.assert_allclose(found, [236, 95, 33, 9, 0, 0], atol=0.8)
    assert TRAPS.released_charge(np.array([8e4]), 1000.0, 87.24) == pytest.approx(236 * 10**-0.9, rel=0.01)
    assert TRAPS.released_charge(np.array([1e9]), 100.0, 87.24) == TRAPS.released_charge(
        np.array([1.3e5]), 100.0, 87.24
    )
    # Twice the time gives less than twice the charge, because the release slows down.
    longer = (274.48**0.1 - 100**0.1) / (187.24**0.1 - 100**0.1)
    assert 1.6 < longer < 1.7
    assert TRAPS.released_charge(np.array([8e4]), 100.0, 2 * 87.24) == pytest.approx(longer * 235.6, rel=0.01)
    # Charge that is held for longer fills more traps.
    assert TRAPS.released_charge(np.array([8e4]), 100.0, 87.24, 10 * 87.24) == pytest.approx(10**0.2 * 235.6, rel=0.01)
    with pytest.raises(OutOfRange, match="delay"):
        TRAPS.released_charge(np.array([1.0]), 0.0, 87.24)


def test_zero_charge_leaves_no_persistence():
    assert left() is None


def test_what_is_left_adds_up_and_fades():
    star = [18.0], [40.0], [50.0]
    first, second = earlier(134.0, *star), earlier(268.0, *star)
    both = left(first, second)
    np.testing.assert_allclose(both, left(first) + left(second), rtol=1e-12)
    np.testing.assert_array_equal(both, left(first, second))
    assert np.unravel_index(both.argmax(), both.shape) == (50, 40)
    assert left(second).max() == pytest.approx(left(first).max() * 2**-0.9, rel=1e-3)


@pytest.mark.parametrize("mag", [8.0, pytest.param(0.0, marks=pytest.mark.nightly)])
def test_no_pixel_held_more_than_its_full_well(mag):
    """A star of AB 0, and an hour later."""
    least = TRAPS.released_charge(np.array([1.3e5]), 3600.0, 87.24)[0]
    assert left(earlier(3600.0, [mag], [40.0], [50.0])).max() == pytest.approx(least, rel=1e-6)


def test_persistence_of_faint_sources_is_negligible():
    """Compare all sources, drawn as in an image, with the bright ones alone: less than 1 electron in any pixel."""
    rng = np.random.default_rng(1)
    count = 150
    x, y = rng.uniform(0, 96, (2, count))
    mags = rng.uniform(15.0, 26.0, count)
    for before in (134.0, 1100.0):
        row = infrared.exposed(DETECTOR, mjd=infrared.MJD - before * SECOND)
        whole = infrared.rendered(mags, x, y, mjd=row["mjd"])
        sky = infrared.SKY * infrared.TIME
        expected = TRAPS.released_charge(whole.noise_free.astype(float) + sky, before, infrared.TIME)
        least = persistence.min_flux(fields.exposure(**row))
        bright = 10 ** (-0.4 * (mags - 23.9)) >= least
        assert 0 < bright.sum() < count
        found = left(earlier(before, mags[bright], x[bright], y[bright]))
        assert expected.max() > 20.0
        assert np.abs(found - expected).max() < 1.0


def dither(count, draw):
    """Return `count` exposures, 134 s apart, of 150 stars that move by two pixels from one to the next."""
    rng = np.random.default_rng(4)
    x, y, mags = rng.uniform(0, 70, 150), rng.uniform(0, 96, 150), rng.uniform(15.0, 26.0, 150)
    return [draw(134.0 * (n + 1), mags, x + 2.0 * n, y) for n in range(count)]


@pytest.mark.nightly
def test_the_map_agrees_with_one_of_much_fainter_sources():
    """The reference has twenty times fainter limits: after 15 exposures, less than 1 electron is missing."""

    def limited(before, mags, x, y):
        least = persistence.min_flux(fields.exposure(**infrared.exposed(DETECTOR)))
        bright = 10 ** (-0.4 * (mags - 23.9)) >= least
        assert 0 < bright.sum() < len(mags)
        return earlier(before, mags[bright], x[bright], y[bright])

    found = left(*dither(15, limited))
    reference = left(*dither(15, lambda *star: earlier(*star, fraction=0.05)))
    missing = reference - found
    print("missing at most", missing.max(), "of", reference.max())
    assert reference.max() > 50.0
    assert 0.05 < np.abs(missing).max() < 1.0


def test_a_map_depends_on_its_exposure_alone():
    """The least flux is an exposure's own; the same map is used whenever a later exposure begins."""
    calls = []
    star = earlier(300.0, [18.0], [40.0], [50.0])
    charge = star.charge()
    assert charge.dtype == np.float32
    counted = replace(star, charge=lambda: calls.append(1) or charge)
    first, second = left(counted), left(counted, mjd=infrared.MJD + 900.0 * SECOND)
    assert len(calls) == 2
    np.testing.assert_array_equal(first, left(star))
    assert second.max() == pytest.approx(first.max() * 4.0**-0.9, rel=0.05)
    # A source of the least flux has 2.3 electrons per second, in an exposure of any length.
    for seconds in (infrared.TIME, 500.0):
        row = fields.exposure(**infrared.exposed(DETECTOR, seconds=seconds))
        assert persistence.min_flux(row) * electron_rate(row) == pytest.approx(2.3)


def test_bodies_and_arcs_leave_their_light():
    """A trail of a body and a ring of light around a lens are in the map, though no catalogue has them as sources."""
    row = infrared.exposed(DETECTOR, mjd=infrared.MJD - 134.0 * SECOND, number=9)
    aim = Aim.from_exposure(fields.exposure(**row), DETECTOR)
    no_stars = Rows(*infrared.tables(DETECTOR, row, [], [], []), bodies=solar_system.empty_population)
    dark = previous(aim, no_stars).charge()
    (ra,), (dec,) = astrometry.sky_of_pixel(aim.wcs, np.array([40.0]), np.array([50.0]))

    def on_day(day):
        hour = 24.0 * (aim.exposure.mjd + 0.5 * infrared.TIME * SECOND - day - 0.5)
        place = (np.atleast_1d(angle) for angle in ecliptic(ra, dec))
        return Population(np.array([1 << 40]), *place, np.array([100.0]), np.zeros(1), np.array([16.0]), hour)

    moving = previous(aim, replace(no_stars, bodies=on_day)).charge() - dark
    lit = np.argwhere(moving > 0.3 * moving.max())
    # 100 arcsec per hour are 8 pixels in 87 s.
    assert moving.max() > 500.0
    assert 6.0 < np.hypot(*np.ptp(lit, axis=0)) < 12.0
    np.testing.assert_allclose(lit.mean(axis=0), [50.0, 40.0], atol=1.0)
    # A galaxy far off the frame, of which a lens makes two blobs on it.
    tables = infrared.tables(DETECTOR, row, [19.0], [4000.0], [50.0], body={"bulge_fraction": 0.0})
    lenses = lens(int(tables[0]["id"][0].as_py()), ra, dec, [(1.2, 0.0, 3.0), (-1.2, 0.0, 1.0)])
    behind = replace(no_stars, galaxies=tables[0], galaxy_fluxes=tables[1])
    np.testing.assert_array_equal(previous(aim, behind).charge(), dark)
    arcs = previous(aim, replace(behind, lenses=lenses)).charge() - dark
    assert arcs.sum() == pytest.approx(4.0 * 10 ** (-0.4 * (19.0 - 23.9)) * aim.electrons_per_microjansky, rel=0.03)
    bright = np.unravel_index(arcs.argmax(), arcs.shape)
    assert np.hypot(bright[0] - 50.0, bright[1] - 40.0) == pytest.approx(1.2 / 0.3, abs=1.0)


def test_a_flat_leaves_its_light_a_dark_nothing():
    flat = left(earlier(134.0, [], [], [], kind="flat", lamp=5))
    assert TRAPS.released_charge(np.array([2e4]), 134.0, 87.24)[0] < np.median(flat)
    assert (left(earlier(134.0, [], [], [], kind="dark", sky=0.0)) == 0.0).all()


def spectrum_before(seconds, mags, x, y):
    """Return an image, spectra `seconds` earlier on the same strip, and the image of their noise-free light."""
    columns = {"mjd": infrared.MJD - seconds * SECOND, "number": 9, "sky": 1.09}
    row = spectroscopic.exposed(STRIP, **columns)
    now = Aim.from_exposure(fields.exposure(**infrared.exposed(STRIP)), STRIP)
    aim = Aim.from_exposure(fields.exposure(**row), STRIP)
    bright = persistence.min_flux(aim.exposure, persistence.brightest_column_fraction(aim, QUIET))
    some = 10 ** (-0.4 * (mags - 23.9)) >= bright
    assert 0 < some.sum() < len(mags)
    rows = Rows(*infrared.tables(STRIP, row, mags[some], x[some], y[some]))
    return (
        now,
        previous(aim, rows, QUIET),
        spectroscopic.rendered(mags, x, y, detector=STRIP, truth=("sky",), **columns),
    )


@pytest.mark.nightly
@pytest.mark.parametrize("before", [700.0, 3000.0])
def test_traces_leave_what_whole_spectra_leave(before):
    """All orders of all sources against those of the bright ones alone: 1.2 e- in any pixel, of 30 and more."""
    rng = np.random.default_rng(2)
    count = 250
    x, y, mags = rng.uniform(-1200.0, 1800.0, count), rng.uniform(0, 96, count), rng.uniform(12.0, 23.0, count)
    now, earlier, whole = spectrum_before(before, mags, x, y)
    light = whole.noise_free.astype(float) + whole.maps["sky"]
    expected = TRAPS.released_charge(light, before, infrared.TIME, spectroscopic.TIME)
    found = persistence.total_charge(now, (earlier,), Variant(QUIET, SURVEY, {}), infrared.SEED)
    even = TRAPS.released_charge(np.array([1.09 * spectroscopic.TIME]), before, infrared.TIME, spectroscopic.TIME)[0]
    print("left at most", expected.max() - even, "missed at most", np.abs(found - expected).max())
    assert expected.max() > even + 5.0
    assert np.abs(found - expected).max() < 1.2
    np.testing.assert_array_equal(
        found, persistence.total_charge(now, (earlier,), Variant(QUIET, SURVEY, {}), infrared.SEED)
    )


def test_the_brightest_column_of_a_point():
    """An image has half of the light in a column; a grism has order 0 over ten columns, or 1 / 500 of order 1."""
    spectra = Aim.from_exposure(fields.exposure(**spectroscopic.exposed(STRIP)), STRIP)
    assert 1.0 / 512 < persistence.brightest_column_fraction(spectra, QUIET) < 0.02
    image = Aim.from_exposure(fields.exposure(**infrared.exposed(DETECTOR)), DETECTOR)
    assert persistence.brightest_column_fraction(image, MISSION) == 0.5


def test_the_sky_of_channels_that_are_not_rendered_leaves_charge():
    """1.6 e- of 600 e- in 550 s 400 s before, all over; a dark's nothing."""
    row = infrared.exposed(DETECTOR, mjd=infrared.MJD - 400 * SECOND, number=9, seconds=550.0, sky=1.09)
    spectrum = fields.exposure(**{**row, "channel": "NISP-S", "band": "nisp_red"})
    assert persistence.is_drawn(spectrum)
    assert persistence.is_drawn(fields.exposure(**row))
    found = left(PreviousSky(spectrum))
    np.testing.assert_allclose(found, 1.1 * (550.0 / 87.24) ** 0.2, atol=0.2)
    np.testing.assert_array_equal(found, found[0, 0])
    for kind, seen in (
        ("dark", False), ("flat", False), ("standard_star", True), ("planetary_nebula", True), ("deep", True)
    ):  # fmt: skip
        other = fields.exposure(**{**row, "channel": "NISP-S", "band": "nisp_red", "image_type": kind})
        np.testing.assert_array_equal(left(PreviousSky(other)), found * seen)


def test_a_star_left_its_light_where_it_was_that_day():
    """300 mas/yr to the north, ten years after 2015.5: ten pixels."""
    row = infrared.exposed(DETECTOR, mjd=infrared.MJD - 134.0 * SECOND, number=9)
    aim = Aim.from_exposure(fields.exposure(**row), DETECTOR)
    still = Rows(*infrared.tables(DETECTOR, row, [14.0], [40.0], [50.0]))
    motion, stars = {"pm_ra": 0.0, "pm_dec": 300.0}, still.stars
    for name, value in motion.items():
        stars = stars.append_column(name, pa.array([value]))
    years = (aim.exposure.mjd - 51544.5) / 365.25 - 15.5
    dec = stars["dec"].to_numpy() + years * motion["pm_dec"] / 3.6e6
    column, row = astrometry.pixel_of_sky(aim.wcs, stars["ra"].to_numpy(), dec)
    assert np.hypot(column[0] - 40.0, row[0] - 50.0) == pytest.approx(10.0, abs=0.5)
    found = left(previous(aim, replace(still, stars=stars)))
    lit = np.unravel_index(found.argmax(), found.shape)
    assert np.hypot(lit[0] - row[0], lit[1] - column[0]) < 1.0


def test_an_image_has_it_and_says_so():
    """As a current: what is left comes up the ramp; the truth map has a pixel's own share of it."""
    before = earlier(134.0, [12.0], [40.0], [50.0])
    found = infrared.rendered(earlier=(before,), truth=("persistence",))
    without = infrared.rendered(truth=("persistence",))
    again = infrared.rendered(earlier=(before,), truth=("persistence",))
    np.testing.assert_array_equal(found.raw, again.raw)
    assert (without.maps["persistence"] == 0.0).all()
    about = np.s_[45:56, 35:46]
    assert found.maps["persistence"][about].sum() > 300.0
    change = infrared.electrons(found)[about] - infrared.electrons(without)[about]
    noise = found.scene.pixel_noise * 11 * np.sqrt(2.0)
    assert change.sum() == pytest.approx(found.maps["persistence"][about].sum(), abs=5 * noise)
    assert {d.name: d.applied for d in found.decisions}["persistence"]


def test_a_detector_has_one_exposure_at_a_time():
    """A ramp of 87 s takes 110.5 s from its reset; other settings and detectors are others' exposures."""
    nominal = fields.exposure(**infrared.exposed(DETECTOR))

    def asked(seconds, detector="DET22", **more):
        rows = [nominal, replace(nominal, exposure_id=2, mjd=infrared.MJD + seconds * SECOND, **more)]
        tasks = [{"exposure_id": n, "detector": name} for n, name in ((1, "DET22"), (2, detector))]
        return persistence.previous_tasks(tasks, {one.exposure_id: one for one in rows}, lambda settings: MISSION)

    for seconds in (0.0, 110.6, 134.0):
        asked(seconds)
    for seconds in (30.0, 100.0, 110.4):
        with pytest.raises(BadInput, match=rf"exposures 1 and 2 of detector DET22: .* begins {seconds} s .* 110\.5 s"):
            asked(seconds)
    asked(30.0, detector="DET23")
    asked(30.0, settings=EXPLORED)


def test_which_exposures_count():
    """First realisations of the same detector, camera and settings within two hours count, also spectra."""
    nominal = fields.exposure(**infrared.exposed(DETECTOR))

    def row(number, hours, **more):
        return replace(nominal, exposure_id=number, mjd=infrared.MJD + hours / 24.0, **more)

    rows = [
        row(1, -3.0), row(2, -1.0), row(3, -1.0, realisation=2), row(4, -0.5, channel="NISP-S", exposure_time_s=549.6),
        row(5, -0.4, settings=EXPLORED), row(6, 0.0), row(7, 0.0, realisation=2), row(8, 0.1), row(9, -0.3),
    ]  # fmt: skip
    tasks = [{"exposure_id": one.exposure_id, "detector": "DET22"} for one in rows[:8]]
    tasks.append({"exposure_id": 9, "detector": "DET23"})
    found = persistence.previous_tasks(tasks, {one.exposure_id: one for one in rows}, lambda settings: MISSION)
    numbers = {key: [task["exposure_id"] for task in some] for key, some in found.items()}
    assert numbers[6, "DET22"] == numbers[7, "DET22"] == [2, 4]
    assert numbers[8, "DET22"] == [2, 4, 6]
    # Spectra also show persistence.
    assert numbers[4, "DET22"] == [2]
    assert numbers[1, "DET22"] == []
    assert numbers[9, "DET23"] == []
    shuffled = persistence.previous_tasks(tasks[::-1], {one.exposure_id: one for one in rows}, lambda settings: MISSION)
    assert shuffled == found


def test_pixels_have_their_own():
    """p2 and the power of time scatter about the usual pixel's as the mission says; the same in every exposure."""
    flat = {"kind": "flat", "lamp": 5}
    usual, own = (
        [left(earlier(before, [], [], [], **flat), mission=mission) for before in (134.0, 6700.0)]
        for mission in (EVEN, MISSION)
    )
    ratio = [mine / all_alike for mine, all_alike in zip(own, usual, strict=True)]
    assert np.median(ratio[0]) == pytest.approx(1.0, abs=0.01)
    # After fifty times the delay, the ratio of a pixel is 50^(0.05 z).
    fell = np.log(ratio[1] / ratio[0]) / np.log(50.0)
    assert np.std(fell) == pytest.approx(0.05, rel=0.05)
    # At the reference time, about, p2 alone: 20 % more of it bring 1 - exp(-I / p2) down by less.
    spread = np.std(ratio[0] / (134.0 / 100.0) ** fell)
    held = 3e4 * np.exp(-3e4 / 2e4) / 2e4 / -np.expm1(-3e4 / 2e4)
    assert spread == pytest.approx(0.1 * held, rel=0.3)
    np.testing.assert_array_equal(own[1], left(earlier(6700.0, [], [], [], **flat), mission=MISSION))


def test_exposures_with_different_ramps_leave_persistence_in_one_another():
    """Explored parameters separate the variants of a sequence; parameters of single exposures do not."""
    nominal = fields.exposure(**infrared.exposed(DETECTOR))
    flat, ramp = '{"own:nisp.flat.signal": [6e4, "electron"]}', '{"own:nisp.macc.photometric.groups": [8, ""]}'
    explored = '{"nisp.flat.signal": [6e4, "electron"]}'
    rows = [
        replace(nominal, exposure_id=n, mjd=infrared.MJD + 300 * n * SECOND, settings=settings)
        for n, settings in enumerate((flat, explored, ramp, None))
    ]
    tasks = [{"exposure_id": one.exposure_id, "detector": "DET22"} for one in rows]
    found = persistence.previous_tasks(tasks, {one.exposure_id: one for one in rows}, lambda settings: MISSION)
    assert [[one["exposure_id"] for one in found[n, "DET22"]] for n in range(4)] == [[], [], [0], [0, 2]]


def test_an_earlier_flat_had_its_own_lamp():
    """The settings of the earlier frame determine its lamp; here it is twice as bright as in the later frame."""
    bright = EVEN.with_overrides({"nisp.flat.signal": (6e4, "electron")})
    flats = [earlier(134.0, [], [], [], mission, kind="flat", lamp=5) for mission in (EVEN, bright)]
    found = [np.median(left(flat)) for flat in flats]
    usual = np.median(TRAPS.released_charge(np.array([2.5e4, 5e4]), 134.0, 87.24).reshape(2, 1), axis=1)
    assert found[1] / found[0] == pytest.approx(usual[1] / usual[0], rel=0.1)


@pytest.mark.parametrize(
    ("channel", "kind", "target"),
    [
        ("NISP-P", "standard_star", "Vega"), ("NISP-P", "standard_star", "white dwarf DA"),
        ("NISP-S", "standard_star", "Vega"), ("NISP-S", "planetary_nebula", "planetary nebula"),
    ],
)  # fmt: skip
def test_calibration_sources_leave_their_light(channel, kind, target):
    """Before an image: at the five places of a star, or along its spectra, though no catalogue has them."""
    strip = spectroscopic.strip(nx=900)
    of_channel = spectroscopic if channel == "NISP-S" else infrared
    row = of_channel.exposed(strip, kind=kind, target=target, mjd=infrared.MJD - 700 * SECOND, number=9)
    aim = Aim.from_exposure(fields.exposure(**row), strip)
    now = Aim.from_exposure(fields.exposure(**infrared.exposed(strip)), strip)
    stars = fields.stars([], [])
    for name in ("sed", "mag_h", "a_v"):
        stars = stars.append_column(name, pa.array([], pa.int64() if name == "sed" else pa.float64()))
    bodies = fields.galaxies([], [])
    nothing = Rows(bodies, fields.fluxes(bodies, row["band"], 0.0), stars, fields.fluxes(stars, row["band"], 0.0))
    found = persistence.total_charge(now, (previous(aim, nothing, QUIET),), Variant(QUIET, SURVEY, {}), infrared.SEED)
    sky = np.median(found)
    assert (found > sky + 1.0).sum() >= 5
    if channel == "NISP-P":
        middle = found[40:56, 440:460]
        assert middle.max() > sky + 5.0
