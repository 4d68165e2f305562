"""Astrometry of NISP-P: the header of the file gives the positions of the drawn light, and dithers agree."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from benchmarks import _references as references
from benchmarks import _scenes as scenes
from tests.truesky.render import fields, infrared, nominal
from tests.truesky.render.fields import MISSION, fluxes, galaxies, stars
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors, pointing
from truesky.render.channels.aim import Aim
from truesky.render.products import fits_files, truth_table
from truesky.render.psf import euclid
from truesky.render.sources.source_list import Sources

MAS = 1e-3 / 0.3
# Half of the box in which a position is fitted, and half of the side of the PSF in the model, pixels.
HALF, KEPT = 7, 32
# Effects that are off, so that the image contains only the light that passes the filter wheel.
DARK = ("ramp_cosmic_rays", "dark_map", "pixel_response", "background", "pixel_area", "chromatic_response", "ipc")


def dithers(detector, count):
    """Return exposures of a field in one band at `count` dithers."""
    centre = infrared.exposed(detector)
    out = []
    for i in range(1, count + 1):
        x, y = ([MISSION.value(f"survey.dither_{i}.{axis}", "arcsec")] for axis in "xy")
        ra, dec = pointing.sky_of_plane(x, y, *(centre[name] for name in ("ra", "dec", "position_angle")))
        moved = {"ra": float(ra[0]), "dec": float(dec[0]), "mjd": centre["mjd"] + i * 1072 / 86400, "exposure_id": i}
        out.append({**centre, **moved})
    return out


def rendered(detector, row, where, psf):
    """Render stars of 18 mag at given sky positions."""
    points, none = stars(*where), galaxies(0.0, 0.0).slice(0, 0)
    light = fluxes(points, row["band"], 10 ** (-0.4 * (18.0 - 23.9)))
    tables = none, fluxes(none, row["band"], 0.0), points, light
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(euclid, "nisp_psf", lambda *_: psf)
        return fields.rendered(row, detector, tables, MISSION, infrared.SURVEY, forced=nominal.off(*DARK))


def model(psf, x, y):
    """Return the image of a star of unit flux at pixel x, y of a box of 2 HALF + 1 pixels, by a Fourier series."""
    planes, samples = psf.planes, psf.planes.samples
    middle, half = planes.images.shape[1] // 2, samples * KEPT
    kept = np.s_[:, middle - half : middle + half + 1, middle - half : middle + half + 1]
    own = replace(psf, planes=replace(planes, images=planes.images.mean(axis=0, dtype=float)[None][kept]))
    one = Sources(
        np.zeros(1, int), np.array([x]), np.array([y]), 0.3 * np.eye(2)[None], np.ones(1), np.array([-1]), None
    )
    return references.image_by_series(one, own, 2 * HALF + 1)


def fitted(image, psfs, x, y):
    """Return positions [n], [n] of stars near x, y, from fits of the PSF image of each star."""
    found, step = [], 1e-2
    for psf, column, row in zip(psfs, x, y, strict=True):
        x0, y0 = round(column) - HALF, round(row) - HALF
        box = image[y0 : y0 + 2 * HALF + 1, x0 : x0 + 2 * HALF + 1].astype(float)
        u, v = column - x0, row - y0
        here = model(psf, u, v)
        slopes = [(model(psf, u + a, v + b) - model(psf, u - a, v - b)) / (2 * step) for a, b in ((step, 0), (0, step))]
        basis = np.stack([here, *slopes]).reshape(3, -1).T
        light, across, up = np.linalg.lstsq(basis, box.ravel(), rcond=None)[0]
        found.append((column + across / light, row + up / light))
    return np.array(found).T


def inside(detector, x, y):
    return (x > 20) & (x < detector.nx - 20) & (y > 20) & (y < detector.ny - 20)


def off(found, truth):
    """Return the offsets (mas) to the east and north of ra, dec [2, n] (deg) from the truth, shape [2, n]."""
    east, north = SkyCoord(*truth, unit="deg").spherical_offsets_to(SkyCoord(*found, unit="deg"))
    return np.array([east.to_value("mas"), north.to_value("mas")])


def residuals(detector, row, where, psf, folder):
    """Return numbers of the visible stars, and offsets [2, n] (mas) of their light in each file, with SIP and TPV."""
    one = rendered(detector, row, where, psf)
    rows = truth_table.truth(one)
    order = np.searchsorted(stars(*where)["id"].to_numpy(), rows["id"].to_numpy())
    x, y = (rows[name].to_numpy() for name in "xy")
    seen = inside(detector, x, y)
    order, x, y = order[seen], x[seen], y[seen]
    psfs = [scenes.psf_of_source(psf, one.sources, i) for i in np.flatnonzero(seen)]
    found, out = fitted(one.noise_free, psfs, x, y), []
    for convention in ("sip", "tpv"):
        rows, writers = fits_files.products(one, ("noise_free",), wcs=convention)
        for path in rows["path"].to_pylist():
            writers[path](folder / "image.fits")
            with fits.open(folder / "image.fits") as units:
                header = units[1].header if "science" in path else units[0].header
            assert header["CTYPE1"].endswith(convention.upper())
            # Reference pixels surround the pixels that detect light.
            border = 4 if "science" in path else 0
            out.append(off(WCS(header).all_pix2world(*(found + border), 0), np.array(where)[:, order]))
    return order, out


def field(detector, row, pitch):
    """Return sky positions on a lattice over a detector in an exposure."""
    x, y = nominal.lattice(detector.nx, pitch)
    return astrometry.sky_of_pixel(Aim.from_exposure(fields.exposure(**row), detector).wcs, x, y)


def rms(offsets):
    return float(np.sqrt(np.mean(np.square(offsets))))


def check(name, pitch, count, psf, folder):
    """Check positions in `count` dithers, in each of which the filter has a different tilt."""
    detector = detectors.detector("nisp", name, MISSION)
    rows = dithers(detector, count)
    where, offsets = field(detector, rows[0], pitch), []
    for row in rows:
        order, found = residuals(detector, row, where, psf, folder)
        assert len(order) > 5
        assert max(rms(each) for each in found) <= 1.0
        alone = np.full((2, len(where[0])), np.nan)
        alone[:, order] = found[0]
        offsets.append(alone)
        # Without the tilt, the image would be shifted.
        still = astrometry.wcs(detector, row["ra"], row["dec"], row["position_angle"])
        seen = Aim.from_exposure(fields.exposure(**row), detector).wcs
        moved = off(astrometry.sky_of_pixel(still, [100.0], [900.0]), astrometry.sky_of_pixel(seen, [100.0], [900.0]))
        print(name, row["exposure_id"], len(order), f"rms {rms(found[0]):.1e} mas, tilt {np.hypot(*moved)[0]:.1f} mas")
        assert np.hypot(*moved)[0] > 3.0
    offsets = np.array(offsets)
    both = np.isfinite(offsets).all(axis=(0, 1))
    assert both.sum() >= 5
    assert rms(offsets[:, :, both] - offsets[:, :, both].mean(axis=0)) <= 1.0


@pytest.mark.nightly
def test_positions_of_light_agree_with_the_headers_of_all_dithers(tmp_path):
    detector = detectors.detector("nisp", "DET11", MISSION)
    check("DET11", 500, 2, infrared.psf_of(detector, "euclid_h"), tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["DET11", "DET23", "DET44"])
def test_in_all_dithers_of_a_field(name, tmp_path):
    """The PSF changes over the detector."""
    detector = detectors.detector("nisp", name, MISSION)
    check(name, 220, 4, euclid.nisp_psf(detector, passbands.load("euclid_h"), MISSION, 4), tmp_path)


def test_no_light_is_lost_where_the_optics_distort():
    """Faint stars and galaxies have the same drawn light in the corner of the field, where the pixel area differs."""
    detector = detectors.detector("nisp", "DET11", MISSION)
    row = infrared.exposed(detector, band="euclid_h")
    psf = infrared.psf_of(detector, row["band"])
    system = Aim.from_exposure(fields.exposure(**row), detector).wcs
    jacobian = astrometry.jacobian(system, np.array([60.0]), np.array([60.0]))[0]
    middle = astrometry.jacobian(system, np.array([1980.0]), np.array([1980.0]))[0]
    assert abs(np.linalg.det(jacobian) / np.linalg.det(middle) - 1) > 1e-3
    for body in (None, {"disk_half_light_radius": 0.5}):
        tables = infrared.tables(detector, row, [21.0, 21.0], [60.3, 1980.2], [60.9, 1980.4], body)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(euclid, "nisp_psf", lambda *_: psf)
            one = fields.rendered(row, detector, tables, MISSION, infrared.SURVEY, forced=nominal.off(*DARK))
        rows = truth_table.truth(one)
        assert len(set(rows["expected"].to_pylist())) == 1
        corner, middle_light = rows["drawn"].to_numpy()
        assert corner == pytest.approx(middle_light, rel=1e-5)
        # Wings beyond the frame and beyond the planes of the PSF are missing, more of them in the corner.
        assert one.noise_free.sum(dtype=float) == pytest.approx(rows["expected"].to_numpy().sum(), rel=6e-3)
