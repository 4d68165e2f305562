"""Positions of sources: in the truth table, in the drawn light, and as a detection program finds them."""

from dataclasses import replace
from functools import cache

import galsim
import numpy as np
import pytest
import sep
from scipy.ndimage import gaussian_filter, uniform_filter

from tests.truesky.render import calibrated, nominal
from tests.truesky.render.fields import MISSION, aimed, galaxies, psf_of, small, stars
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors, pointing
from truesky.render.drawing import settings, stamps, transfer
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows
from truesky.render.products import headers, truth_table
from truesky.render.psf import diffraction, euclid, sub_bands
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import SURVEY

BAND = passbands.load("euclid_vis")
SMALL = small("vis", "3-4", 256)
MAS = 1e-3 / 0.1
# Samples per pixel of finer drawings. The second is odd, so that the mean over a pixel is at its centre.
OVER, FINE = 10, 11
# Samples across galsim's pupil.
PUPIL = 256
# Standard deviation of the window of sep, pixels.
WINDOW = 1.2
# Standard deviation of the window in which stars of VIS are centred (`vis.psf.window`), pixels.
CENTRED = 1.0


# ------------------------------------------------------------------------------------------------ the truth table


def sky_of(header, x, y):
    """Return ra, dec (deg) of 0-based pixels by FITS paper II and the SIP convention, in extended precision."""
    value = {keyword: content for keyword, content, _ in header}
    u, v = (np.asarray(p, np.longdouble) + 1 - np.longdouble(value[f"CRPIX{i}"]) for i, p in ((1, x), (2, y)))
    if value["CTYPE1"].endswith("-SIP"):
        found = [
            sum(
                np.longdouble(value[f"{axis}_{i}_{j}"]) * u**i * v**j
                for i in range(int(value[f"{axis}_ORDER"]) + 1)
                for j in range(int(value[f"{axis}_ORDER"]) + 1)
                if f"{axis}_{i}_{j}" in value
            )
            for axis in "AB"
        ]
        u, v = u + found[0], v + found[1]
    turn = np.pi / np.longdouble(180)
    xi, eta = ((np.longdouble(value[f"CD{i}_1"]) * u + np.longdouble(value[f"CD{i}_2"]) * v) * turn for i in (1, 2))
    ra0, dec0 = (np.longdouble(value[f"CRVAL{i}"]) * turn for i in (1, 2))
    across, up = -xi, np.cos(dec0) - eta * np.sin(dec0)
    ra = ra0 + np.arctan2(-across, up)
    dec = np.arctan2(np.sin(dec0) + eta * np.cos(dec0), np.hypot(xi, up))
    return ra / turn, dec / turn


def separation(ra, dec, ra1, dec1):
    """Return the great-circle distance (mas) by the haversine formula."""
    turn = np.pi / np.longdouble(180)
    ra, dec, ra1, dec1 = (np.asarray(angle, np.longdouble) * turn for angle in (ra, dec, ra1, dec1))
    half = np.sin((dec1 - dec) / 2) ** 2 + np.cos(dec) * np.cos(dec1) * np.sin((ra1 - ra) / 2) ** 2
    return 2 * np.arcsin(np.sqrt(half)) / turn * 3.6e6


@pytest.mark.parametrize(
    ("name", "ra", "dec"), [("1-1", 53.1, -27.8), ("3-4", 0.01, 66.5), ("6-6", 200.0, 89.5), ("6-1", 310.0, -89.9)]
)
def test_the_truth_table_tells_where_sources_are(name, ra, dec):
    """The header converts x, y to ra, dec of the catalogue within 0.01 mas, over a whole detector."""
    detector = detectors.detector("vis", name, MISSION)
    pointed = pointing.boresight_for(detector, ra, dec, 33.0)
    system = astrometry.wcs(detector, *pointed)
    rng = np.random.default_rng(3)
    where = astrometry.sky_of_pixel(system, rng.uniform(-0.5, 4095.5, 300), rng.uniform(-0.5, 4131.5, 300))
    points = stars(*where)
    none = galaxies(0.0, 0.0).slice(0, 0)
    drawn, sizes = visible_sources.select_sources(
        Rows(none, None, points, None), (np.zeros(0), np.full(300, 1e3)), aimed(detector, system, BAND),
        psf_of("vis"), 13.0, settings.settings_for(SURVEY),
    )  # fmt: skip
    found = replace(
        alone(), detector=detector, wcs=system, sources=drawn, sizes=sizes, drawn_electrons=np.zeros(len(sizes))
    )
    rows = truth_table.truth(found)
    assert rows["id"].to_pylist() == sorted(points["id"].to_pylist())
    order = np.argsort(points["id"].to_numpy())
    told = sky_of(headers.science_cards(found), rows["x"].to_numpy(), rows["y"].to_numpy())
    assert separation(*told, where[0][order], where[1][order]).max() <= 0.01


@cache
def alone():
    """Return a star on a small frame."""
    return nominal.rendered(SMALL, 20.0, 127.3, 126.8, forced=nominal.off(*nominal.COSMIC_RAYS))


# ------------------------------------------------------------------------------------------------ the drawn light


def oversampled(detector, column, row, side, strength):
    """Draw a star of flat f_nu whose chief ray is at a pixel position, with galsim, 10 times finer than the pixels.

    The result is the light [side, side] on the pixels around round(column), round(row), and the centroid of the star in
    the window of VIS minus the position, pixels.
    """
    # Half width and half height of a detector, arcsec.
    half_x, half_y = 409.6 / 2, 413.2 / 2
    place = [
        (position - (n - 1) / 2) * detector.pixel_scale * (-1 if detector.upside_down else 1)
        for position, n in ((column, detector.nx), (row, detector.ny))
    ]
    everything = detectors.detectors("vis", MISSION)
    field = [
        (centre + offset) / (max(getattr(d, axis) for d in everything) + half)
        for axis, centre, offset, half in zip("xy", (detector.x, detector.y), place, (half_x, half_y), strict=True)
    ]
    nm, n = euclid.wavefront(*field, "vis", MISSION), PUPIL
    axis = (np.arange(n) - n / 2 + 0.5) * 1200.0 / n
    clear = galsim.Image(diffraction.pupil(*np.meshgrid(axis, axis), 1200.0 / n, MISSION).round(), scale=1.2 / n)
    fine, scale = np.zeros((side * OVER, side * OVER)), detector.pixel_scale / OVER
    dx, dy = (np.rint(position) - position for position in (column, row))
    parts = sub_bands.sub_bands(BAND)
    for part in parts:
        wave = np.sqrt(np.average(part.wavelength**2, weights=part.response / part.wavelength)) / 10.0
        optics = galsim.OpticalPSF(
            lam=wave, diam=1.2, aberrations=list(nm / wave), pupil_plane_im=clear, oversampling=1.5, pad_factor=1.0,
            gsparams=galsim.GSParams(maximum_fft_size=8192),
        )  # fmt: skip
        if detector.upside_down:
            optics = optics.rotate(180 * galsim.degrees)
        image = galsim.ImageD(side * OVER, side * OVER, scale=scale)
        drawn = optics.drawImage(image, offset=(-dx * OVER, -dy * OVER), method="no_pixel").array / len(parts)
        # Charge diffusion, wider for blue light, and pointing jitter.
        diffusion = 0.032 * (wave / 800.0) ** -0.35
        blur = [np.hypot(diffusion, MISSION.value(f"svm.aocs.jitter_{axis}", "arcsec")) / scale for axis in "yx"]
        fine += gaussian_filter(drawn, blur, mode="constant")
    u = (np.arange(OVER) + 0.5) / (OVER / 2) - 1
    response = 1 - strength * (u[:, None] ** 2 + u**2)
    light = np.einsum("aibj,ij->ab", fine.reshape(side, OVER, side, OVER), response / response.mean())
    # The mean over a pixel of an even number of samples is half a sample too far up.
    chief = (side * OVER - 1) / 2 - np.array([dx, dy]) * OVER + 0.5
    seen = uniform_filter(fine, OVER, mode="constant")
    return light, (np.array(sep.winpos(seen, *chief, OVER * CENTRED)[:2]) - chief) / OVER


def centroid(stamp, x, y):
    """Return the centroid (pixels) under a Gaussian of 0.3" at a position."""
    rows, columns = np.mgrid[: stamp.shape[0], : stamp.shape[1]]
    weighted = stamp * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 3.0**2))
    return np.array([(weighted * columns).sum(), (weighted * rows).sum()]) / weighted.sum()


def drawn_stars(detector, columns, rows):
    """Return noise-free stars, drawn as in an exposure."""
    columns, rows = np.asarray(columns, float), np.asarray(rows, float)
    psf = replace(euclid.vis_psf(detector, BAND, MISSION), intra_pixel=0.05)
    n = len(columns)
    sources = Sources(
        np.arange(n), columns, rows, np.tile(0.1 * np.eye(2), (n, 1, 1)), np.full(n, 1e6), np.full(n, -1),
        alone().sources.shapes, np.full((n, sub_bands.N_SUB_BANDS), 1.0 / sub_bands.N_SUB_BANDS),
    )  # fmt: skip
    return stamps.draw(sources, np.full(n, 128), psf, detector.nx, detector.ny)


def differences(detector, columns, rows, side=41):
    """Return centroids of drawn stars minus centroids of stars by galsim, mas."""
    image, half, out = drawn_stars(detector, columns, rows), side // 2, []
    for x, y in zip(columns, rows, strict=True):
        x0, y0 = round(x) - half, round(y) - half
        ours = centroid(image[y0 : y0 + side, x0 : x0 + side], x - x0, y - y0)
        light, shift = oversampled(detector, x, y, side, 0.05)
        # Our star has its centroid at the position; galsim's has its chief ray there.
        theirs = centroid(light, x - x0, y - y0) - shift
        out.append((ours - theirs) / MAS)
    return np.array(out)


def test_light_lies_where_galsim_s_finer_optics_put_it():
    found = differences(SMALL, [100.31], [150.82])
    assert np.abs(found).max() <= 1.0


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["1-1", "3-4", "6-6"])
def test_light_lies_where_galsim_puts_it_all_over_a_detector(name):
    detector = detectors.detector("vis", name, MISSION)
    found = differences(detector, [60.2, 4030.7, 2047.5, 100.9, 4000.1], [60.6, 70.1, 2066.3, 4060.5, 4071.0])
    print(name, "largest", np.abs(found).max(), "rms", np.sqrt(np.mean(found**2)), "mas")
    assert np.abs(found).max() <= 1.0


# ------------------------------------------------------------------------------------------------ what sep finds


def tabulated_offset(one):
    """Return the offset (pixels) of the windowed centroid of the PSF from its chief ray.

    The PSF is drawn 11 times finer than the pixels.
    """
    weights = transfer.basis_weights(one.psf, one.sources.photons, one.sources.column, one.sources.row)
    scale = one.psf.pixel_scale / FINE
    fine = transfer.profile_of(one.psf, weights.mean(axis=0)).drawImage(
        nx=20 * FINE + 1, ny=20 * FINE + 1, scale=scale, method="no_pixel", dtype=float
    )
    seen = uniform_filter(fine.array, FINE, mode="constant")
    return (np.array(sep.winpos(seen, 10.0 * FINE, 10.0 * FINE, FINE * WINDOW)[:2]) - 10.0 * FINE).ravel() / FINE


def residuals(detector, pitch, mag, number=1):
    """Return positions by sep minus truth and PSF offset [2, n] (mas), and S/N [n]."""
    x, y = nominal.lattice(detector.nx, pitch, number)
    inside = y < detector.ny - pitch / 2
    forced = nominal.off(*nominal.COSMIC_RAYS, *nominal.CHARGE, "nonlinearity")
    one = nominal.rendered(detector, np.full(inside.sum(), mag), x[inside], y[inside], forced=forced, number=number)
    applied = {decision.name for decision in one.decisions if decision.applied}
    image = calibrated.electrons(one.raw, one.scene, nominal.SEED, applied)
    bad = ~np.isfinite(image)
    image = np.ascontiguousarray(np.where(bad, 0.0, image) - one.scene.sky_electrons)
    rows = truth_table.truth(one)
    at = np.array([rows["x"].to_numpy(), rows["y"].to_numpy()])
    flux, error, _ = sep.sum_circle(image, *at, 6.5, err=one.scene.pixel_noise, gain=1.0)
    found = np.array(sep.winpos(image, *at, WINDOW, subpix=0)[:2])
    near = (slice(round(b) - 6, round(b) + 7) for b in at[1]), (slice(round(a) - 6, round(a) + 7) for a in at[0])
    good = np.array([not bad[rows, columns].any() for rows, columns in zip(*near, strict=True)])
    return (found - at - tabulated_offset(one)[:, None])[:, good] / MAS, (flux / error)[good]


def test_sep_finds_stars_to_three_mas():
    found, clear = residuals(SMALL, 32, 19.4)
    assert clear.min() > 300
    assert np.sqrt(np.mean(found**2)) <= 3.0


@pytest.mark.nightly
def test_sep_finds_stars_all_over_a_detector():
    """All stars get the same offset, so residuals include changes of the PSF's centroid across the detector."""
    found, clear = residuals(detectors.detector("vis", "1-1", MISSION), 128, 19.4)
    print(f"{found.shape[1]} stars: rms {np.sqrt(np.mean(found**2)):.3f} mas, S/N above {clear.min():.0f}")
    assert found.shape[1] > 800
    assert clear.min() > 300
    assert np.sqrt(np.mean(found**2)) <= 3.0
