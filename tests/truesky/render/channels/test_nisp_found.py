"""Sources that sep finds in a file of NISP-P, using only its header."""

import numpy as np
import sep
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial import cKDTree

from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields, infrared
from tests.truesky.render.fields import small
from truesky.render.channels.aim import Aim
from truesky.render.products import fits_files, truth_table

SIDE, PITCH = 448, 32


def written(folder):
    """Render stars of 17.5 to 20.5 mag on a lattice at random subpixel positions; return them and the HDUs with TPV."""
    rng = np.random.default_rng(1)
    rows, columns = np.indices((SIDE // PITCH, SIDE // PITCH)).reshape(2, -1) * PITCH + PITCH / 2
    x, y = (at + rng.uniform(-0.5, 0.5, len(rows)) for at in (columns, rows))
    # No hot pixels, because an observer would know them from a dark.
    cold = resolve(overrides={"nisp.hot_pixels": (0.0, "")})
    found = infrared.rendered(
        rng.uniform(17.5, 20.5, len(x)), x, y, detector=small("nisp", "DET22", SIDE), mission=cold
    )
    rows, writers = fits_files.products(found, (), wcs="tpv")
    (path,) = rows["path"].to_pylist()
    writers[path](folder / "science.fits")
    return found, fits.open(folder / "science.fits")


def test_sources_are_found_where_headers_say(tmp_path):
    """The stars are at the positions of the header. The quality masks nearly all other detections."""
    found, units = written(tmp_path)
    header, signal, flag = units[0].header, units[1], units[2].data.astype(bool)
    image = (signal.data.astype(float) - header["BIAS"]) * header["GAIN"]
    flag[:4], flag[-4:], flag[:, :4], flag[:, -4:] = True, True, True, True
    sky = sep.Background(image, mask=flag)
    expected = np.hypot(header["RDNOISE"], np.sqrt((header["SKYRATE"] + header["DARKRATE"]) * header["EXPTIME"]))
    assert 0.9 < sky.globalrms / expected < 1.15
    sources = sep.extract(image - sky, 5.0, err=sky.globalrms, mask=flag, minarea=3)
    x, y, _ = sep.winpos(image - sky, sources["x"], sources["y"], 1.0, mask=flag)
    truth = truth_table.truth(found)
    exact = np.array([truth["x"].to_numpy(), truth["y"].to_numpy()]).T
    off, which = cKDTree(exact + 4.0).query(np.array([x, y]).T, distance_upper_bound=1.0)
    mine = np.isfinite(off)
    assert len(set(which[mine])) >= len(exact) - 2
    assert (~mine).sum() < 0.05 * len(exact)
    # Sky positions through the header agree with the projection of the exposure.
    system = Aim.from_exposure(fields.exposure(**infrared.exposed(found.detector)), found.detector).wcs
    assert signal.header["CTYPE1"] == "RA---TPV"
    seen, there = WCS(signal.header).all_pix2world(x[mine], y[mine], 0), system.all_pix2world(exact[which[mine]], 0).T
    east = (seen[0] - there[0]) * np.cos(np.radians(there[1])) * 3.6e6
    north = (seen[1] - there[1]) * 3.6e6
    # Coma shifts the centroid in a window that is wider than the PSF. Pixels are as large as the image, so the centroid
    # depends on the position within a pixel by 30 mas.
    assert np.hypot(np.median(east), np.median(north)) < 20.0
    assert max(1.48 * np.median(np.abs(offset - np.median(offset))) for offset in (east, north)) < 40.0
