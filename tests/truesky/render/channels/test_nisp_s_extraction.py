"""H alpha emitters extracted from published files of a deep sequence: fluxes and redshifts are unbiased."""

from dataclasses import replace

import numpy as np
import pytest

from tests.truesky.render import infrared, spectroscopic
from tests.truesky.render.channels import extraction, spectral_lines
from tests.truesky.render.channels.spectral_lines import HALPHA, Lines
from tests.truesky.render.spectroscopic import MISSION, strip
from truesky.fluxes import passbands
from truesky.render import grisms
from truesky.render.camera import astrometry
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import grism_files
from truesky.render.products import fits_files
from truesky.render.psf import euclid, to_psfex

SEED, SKY, DAY = 731_226, 1.09, 1.0
# Directions of the spectra in the survey.
ANGLES = (("RGS000", 0.0), ("RGS180", 184.0), ("RGS000", -4.0), ("RGS180", 180.0))
# Errors of the catalogue, as of a direct image: of positions (arcsec), and relative errors of radii.
POSITION_ERROR, RADIUS_ERROR = 0.01, 0.05
# Pixels on each side of a detector on which no undispersed source lies, so that lines are on the detector.
MARGIN = 300
# A redshift with a larger error, in units of 1 + z, is that of another line.
WRONG = 0.003


def emitters(detector, count, rng, flux):
    """Return lines of galaxies with fluxes from `flux[0]` to `flux[1]`, and undispersed positions [2, count]."""
    wavelength, radius = rng.uniform(13_000.0, 18_000.0, count), 10 ** rng.uniform(-0.9, -0.3, count)
    lines = Lines(wavelength, 10 ** rng.uniform(*np.log10(flux), count), radius, rng.uniform(0.05, 0.5, count))
    return lines, np.array([
        rng.uniform(MARGIN, detector.nx - MARGIN, count), rng.uniform(20.0, detector.ny - 20.0, count)
    ])  # fmt: skip


def write_frame(folder, name, rendered):
    """Write a rendered detector as its product file, under a name in the folder."""
    rows, writers = fits_files.products(rendered, ())
    writers[rows["path"][0].as_py()](folder / f"{name}.fits")


def write_sequence(folder, detector, scene, exposures, rng, forced):
    """Write the published files of a sequence through the grisms, and a catalogue with errors of measurement.

    `scene` contains lines and undispersed positions, `exposures` pairs of grism and angle.
    """
    lines, places = scene
    for number, (grism, angle) in enumerate(exposures, start=1):
        columns = {"grism": grism, "angle": angle, "sky": SKY, "number": number, "mjd": infrared.MJD + DAY * number}
        one = spectral_lines.exposure(lines, places, detector, forced=forced, **columns)
        write_frame(folder, f"sky_{number:02d}", one)
        aim = Aim.from_exposure(one.exposure, detector, seed=infrared.SEED)
        orders = grisms.orders(aim, MISSION, infrared.SEED)
        grism_files.write(folder, f"grism_{number:02d}", orders, (detector.ny, detector.nx))
    for band in ("euclid_j", "euclid_h"):
        psf = euclid.nisp_psf(detector, passbands.load(band), MISSION, 1)
        to_psfex.write(psf, detector, folder / f"NISP-P_{band}_{detector.name}.psf")
    side, diagonal = (MISSION.value(f"nisp.ipc.{name}") for name in ("side", "diagonal"))
    (folder / "ipc.csv").write_text(f"side,diagonal\n{side},{diagonal}\n")
    ra, dec = astrometry.sky_of_pixel(aim.wcs, *places)
    error = rng.normal(0.0, POSITION_ERROR / 3600.0, (2, len(ra)))
    radius = lines.radius * (1.0 + rng.normal(0.0, RADIUS_ERROR, len(ra)))
    table = np.column_stack([ra + error[0] / np.cos(np.radians(dec)), dec + error[1], radius])
    np.savetxt(folder / "catalogue.csv", table, delimiter=",", header="ra,dec,radius", comments="", fmt="%.9f")


def write_calibrations(folder, detector, flats):
    """Write flats through the grism with the lamp that is brightest in the band, and a dark."""
    for number in range(flats):
        mjd = infrared.MJD - 30.0 + number
        one = spectroscopic.rendered(detector=detector, kind="flat", lamp=4, mjd=mjd, number=100 + number, sky=0.0)
        write_frame(folder, f"flat_{number}", one)
    dark = spectroscopic.rendered(detector=detector, kind="dark", mjd=infrared.MJD - 40.0, number=99, sky=0.0)
    write_frame(folder, "dark", dark)


def compare(lines, found):
    """Return relative errors of fluxes, errors of z / (1 + z), and expected S/N; the only use of the truth."""
    z, flux, _, error = found
    wanted = lines.wavelength / HALPHA - 1.0
    return flux / lines.flux - 1.0, (z - wanted) / (1.0 + wanted), lines.flux / error


def test_bright_lines_are_extracted_from_published_files(tmp_path):
    """Three lines of S/N 110 to 150 in two exposures: their means are within 3 % in flux and 1e-4 in redshift.

    The errors of the radii in the catalogue, 5 %, cause errors of 2 to 3 % in single fluxes.
    """
    rng, detector = np.random.default_rng(SEED), strip()
    lines, places = emitters(detector, 3, rng, (4e-15, 6e-15))
    places[1] = 20.0, 48.0, 76.0
    # The lines of both directions of the dispersion are on the strip.
    lines = replace(lines, wavelength=np.array([13_600.0, 15_200.0, 16_900.0]))
    write_sequence(tmp_path, detector, (lines, places), ANGLES[:2], rng, spectroscopic.QUIET)
    flux, redshift, expected = compare(lines, extraction.extract(tmp_path))
    print("flux", flux, "redshift", redshift, "S/N", expected)
    assert abs(flux.mean()) < 0.03
    assert abs(redshift.mean()) < 1e-4
    assert np.abs(flux).max() < 0.06
    assert np.abs(redshift).max() < 2e-4


@pytest.mark.nightly
def test_lines_of_a_deep_sequence_are_extracted_without_a_bias(tmp_path):
    """110 galaxies in eight exposures with every effect; lines with a true flux above 5 errors count.

    The weighted mean of fluxes has a standard error of 0.9 %, the mean of redshifts one of 1.4e-5. Lines of other
    galaxies may be brighter, so that some redshifts are wrong.
    """
    rng, detector = np.random.default_rng(SEED), strip(nx=2040, ny=700)
    lines, places = emitters(detector, 110, rng, (1e-16, 6e-16))
    write_sequence(tmp_path, detector, (lines, places), ANGLES * 2, rng, {})
    write_calibrations(tmp_path, detector, 2)
    flux, redshift, expected = compare(lines, extraction.extract(tmp_path))
    due, right = expected > 5.0, np.abs(redshift) < WRONG
    counted = due & right
    weight = expected[counted] ** 2
    bias, error = np.average(flux[counted], weights=weight), weight.sum() ** -0.5
    print(f"{due.sum()} lines, {counted.sum()} right; flux {bias:+.4f} +- {error:.4f}", end=", ")
    print(f"mean {flux[counted].mean():+.4f}, median {np.median(flux[counted]):+.4f}", end="; ")
    print(f"redshift {redshift[counted].mean():+.1e} +- {redshift[counted].std() / counted.sum() ** 0.5:.0e}")
    assert due.sum() > 90
    assert counted.sum() > 0.9 * due.sum()
    assert abs(bias) < 0.03
    assert abs(np.median(flux[counted])) < 0.03
    assert abs(redshift[counted].mean()) < 1e-4
