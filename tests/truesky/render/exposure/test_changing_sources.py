"""Sources that change: the difference of two exposures is the difference of their light curves, and nothing else."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import ids
from lake_schema.tables.stars import VARIABILITY_COLUMNS
from lake_schema.tables.variability.transients import TRANSIENTS
from tests.truesky.render import fields
from tests.truesky.render.exposure.test_render import CASES, SIDE, field, render
from truesky.fluxes import passbands
from truesky.render.camera import astrometry
from truesky.render.channels.aim import Aim
from truesky.render.sources import point_light, transients
from truesky.render.sources.solar_system import Population
from truesky.render.sources.transients import Transients
from truesky.variability import supernova_light, supernova_templates, variable_stars

BEFORE, AFTER = 60950.0, 60962.0
CELL = 411_000


def aim(channel, mjd, side):
    camera, name = CASES[channel][:2]
    return Aim.from_exposure(fields.exposure(**{**field(channel)[1], "mjd": mjd}), fields.small(camera, name, side))


def supernovae(channel, columns, rows, magnitude, side=SIDE, seed=3):
    """Return supernovae of random ages at pixels (columns, rows), with this AB magnitude in the first exposure."""
    rng, n = np.random.default_rng(seed), len(columns)
    ra, dec = astrometry.sky_of_pixel(aim(channel, BEFORE, side).wcs, columns, rows)
    values = {
        "id": ids.transient_id(CELL, np.arange(1, n + 1, dtype=np.uint64)), "ra": ra, "dec": dec,
        "type": rng.integers(1, 8, n), "z_obs": rng.uniform(0.05, 0.5, n),
        "peak_mjd": BEFORE + rng.uniform(-60.0, 1.0, n),
        "mag_b": np.full(n, magnitude), "stretch": np.ones(n), "ebv": rng.uniform(-0.1, 0.3, n),
        "magnification": np.ones(n), "a_v": np.full(n, 0.1),
    }  # fmt: skip
    # All have the same flux in the first exposure, so that wings of neighbours are small.
    templates = supernova_templates.templates()
    f_nu = supernova_light.fluxes(transients.supernovae(table(values)), band(channel), middles([[BEFORE]]), templates)
    values["mag_b"] = magnitude + 2.5 * np.log10(f_nu[:, 0]) - (23.9 - magnitude)
    return Transients(table(values), templates)


def table(values):
    arrays = {name: pa.array(values[name]).cast(TRANSIENTS.column(name).arrow_type) for name in transients.COLUMNS}
    return pa.table({**arrays, point_light.MIN_F_NU: np.zeros(len(values["id"]))})


def band(channel):
    return passbands.load(CASES[channel][2])


def middles(mjd):
    """Return the middles of the exposures of 100 s that begin at `mjd`."""
    return np.asarray(mjd) + 50.0 / 86400.0


def expected_electrons(channel, sky, side):
    """Return the electrons of each supernova in both exposures, shape (n, 2)."""
    light = transients.supernovae(sky.rows)
    f_nu = supernova_light.fluxes(light, band(channel), middles([[BEFORE, AFTER]]), sky.templates)
    return f_nu * aim(channel, BEFORE, side).electrons_per_microjansky


def light_around(image, columns, rows, half):
    """Return the sum of an image in squares around positions."""
    at = np.stack([columns, rows], axis=1).astype(int)
    return np.array([image[y - half : y + half + 1, x - half : x + half + 1].sum() for x, y in at])


def grid(side, step):
    return (part.ravel() for part in np.meshgrid(np.arange(step // 2, side, step), np.arange(step // 2, side, step)))


@pytest.mark.parametrize("channel", ["VIS", "EXT"])
def test_images_have_the_light_of_the_light_curve(channel):
    """Sample: 4 supernovae at two dates, without noise. All have the same share of their light in the squares."""
    columns, rows = grid(SIDE, 128)
    sky = supernovae(channel, columns, rows, 17.5 if channel == "EXT" else 18.5)
    expected = expected_electrons(channel, sky, SIDE)
    for k, mjd in enumerate((BEFORE, AFTER)):
        without, image = (
            render(channel, transients=some, exposed={"mjd": mjd}, truth=("noise_free",))
            .maps["noise_free"]
            .astype(float)
            for some in (None, sky)
        )
        ratio = light_around(image - without, columns, rows, 31) / expected[:, k]
        np.testing.assert_allclose(ratio / np.median(ratio), 1.0, atol=5e-3)
        assert 0.97 < np.median(ratio) < 1.002


def test_without_light_nothing_changes():
    """Before the first and after the last light, images have the bytes of a sky without supernovae."""
    sky = supernovae("EXT", np.array([50.0, 150.0]), np.array([60.0, 100.0]), 18.0)
    without = render("EXT", exposed={"mjd": 70000.0})
    drawn = render("EXT", transients=sky, exposed={"mjd": 70000.0})
    np.testing.assert_array_equal(drawn.science, without.science)
    assert not np.array_equal(render("EXT", transients=sky).science, render("EXT").science)


def test_variable_stars_have_the_flux_of_the_date():
    """One star pulsates, one is eclipsed, and all others keep their light exactly."""
    points = field("EXT")[3]
    n = len(points)
    inside = astrometry.pixel_of_sky(aim("EXT", BEFORE, SIDE).wcs, points["ra"].to_numpy(), points["dec"].to_numpy())
    candidates = np.flatnonzero(np.all([(at > 30) & (at < SIDE - 30) for at in inside], axis=0))
    pulsating, eclipsed = candidates[np.argsort(inside[0][candidates])][[0, -1]]
    values = {column.name: [None] * n for column in VARIABILITY_COLUMNS}
    for row, known in (
        (pulsating, {"variability": 1, "period": 0.57, "epoch": 60000.1, "amplitude": 1.0}),
        (eclipsed, {"variability": 6, "period": 5.0, "epoch": AFTER + 50.0 / 86400.0, "amplitude": 0.7,
                    "eclipse_radius_ratio": 0.8, "eclipse_impact": 0.1, "eclipse_duration": 0.05,
                    "tidal_amplitude": 0.0}),
    ):  # fmt: skip
        for name, value in known.items():
            values[name][row] = value
    for column in VARIABILITY_COLUMNS:
        points = points.append_column(column.name, pa.array(values[column.name], column.arrow_type))
    before, after = (
        render("EXT", points=points, flux=200.0, exposed={"mjd": mjd}, truth=("noise_free",)) for mjd in (BEFORE, AFTER)
    )
    factors = []
    for mjd in (BEFORE, AFTER):
        factors.append(
            variable_stars.flux_factors(variable_stars.read_columns(points), band("EXT"), float(middles(mjd)))
        )
    assert factors[0][eclipsed] == pytest.approx(1.0)
    assert factors[1][eclipsed] < 0.6
    electrons = 200.0 * aim("EXT", BEFORE, SIDE).electrons_per_microjansky
    change = after.maps["noise_free"].astype(float) - before.maps["noise_free"].astype(float)
    found = light_around(change, *(at[[pulsating, eclipsed]].round() for at in inside), 25)
    expected = electrons * (factors[1] - factors[0])[[pulsating, eclipsed]]
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.01 * electrons)
    assert change.sum() == pytest.approx(expected.sum(), rel=0.02)


@pytest.mark.nightly
def test_two_hundred_supernovae_are_in_the_difference():
    """Sample: 196 supernovae in LSST with noise, most of S/N > 50; their total light has an error of 0.1 %: 5 sigma.

    The squares cover the image, so that the wings of a star are in the squares around its own.
    """
    side, half = 1022, 36
    columns, rows = grid(side, 73)
    sky = supernovae("EXT", columns, rows, 18.0, side)
    detector, points = fields.small("lsstcam", "R22_S11", side), field("EXT")[3].slice(0, 0)
    nothing = {"body": field("EXT")[2].slice(0, 0), "points": points, "detector": detector, "way": "electrons"}
    images = [
        render("EXT", transients=sky, exposed={"mjd": mjd}, **nothing).science.astype(float) for mjd in (BEFORE, AFTER)
    ]
    electrons = expected_electrons("EXT", sky, side)
    expected = np.diff(electrons, axis=1)[:, 0]
    noise = np.sqrt(electrons.sum(axis=1) + 2.0 * (2 * half + 1) ** 2 * 3300.0)
    assert np.sum(np.abs(expected) > 50.0 * noise) > 100
    found = light_around(images[1] - images[0], columns, rows, half)
    assert found.sum() / expected.sum() == pytest.approx(1.0, abs=0.005)
    # Wings of neighbours are a few per cent.
    assert np.median(np.abs(found - expected) / np.abs(expected).max()) < 0.02


def test_nothing_else_differs_above_5_sigma():
    """Sample: two LSST visits of 65,536 pixels with galaxies, stars and four supernovae, without tracks and trails.

    Significance: of 65,536 pixels with Gaussian noise, 0.04 exceed 5 sigma.
    """
    columns, rows = grid(SIDE, 128)
    sky, off = supernovae("EXT", columns, rows, 21.0), {"cosmic_rays": False, "satellite_trails": False}
    nothing = np.zeros(0)
    no_bodies = Population(nothing.astype(np.int64), *[nothing] * 5)
    visits = [
        render(
            "EXT", transients=sky, exposed={"mjd": mjd}, truth=("noise_free",), way="electrons", forced=off,
            bodies=lambda day: no_bodies, noise_seed=number,
        )
        for number, mjd in ((1, BEFORE), (2, AFTER))
    ]  # fmt: skip
    images = [visit.science.astype(float) for visit in visits]
    free = [visit.maps["noise_free"].astype(float) for visit in visits]
    # The map without noise lacks the sky of 3,300 electrons.
    sigma = np.sqrt(free[0] + free[1] + 2.0 * 3310.0)
    change = (images[1] - images[0]) / sigma
    y, x = np.mgrid[:SIDE, :SIDE]
    near = np.min([np.hypot(x - a, y - b) for a, b in zip(columns, rows, strict=True)], axis=0) < 12.0
    assert np.abs(change[near]).max() > 5.0
    assert np.sum(np.abs(change[~near]) > 5.0) <= 2
    assert np.std(change[~near]) < 1.1
