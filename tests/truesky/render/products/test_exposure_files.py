"""Euclid's raw frames of VIS are assembled by the rules of public programs, and stars lie where the WCS puts them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.fits import images
from tests.truesky.render import nominal
from tests.truesky.render.fields import exposure, small
from truesky.render.camera import astrometry
from truesky.render.channels import level1
from truesky.render.products import exposure_files, fits_files, head_files, read_back

SIDE, MIDDLE = 260, 4
# Stars in the quadrants at the lower left, lower right, upper right and upper left, along the axes of the CCD.
COLUMNS, ROWS = [60.0, 190.0, 200.0, 50.0], [40.0, 60.0, 215.0, 190.0]
QUIET = nominal.off(*nominal.COSMIC_RAYS, *nominal.CHARGE)


def readout_corner(ccd, letter):
    """Return whether a quadrant is read at its upper and at its right end: roe_corner_from in PyAutoArray's euclid.py.

    The program counts rows of an array as FITS does, from below (flip_for_ds9 is False), and "1" of its first number
    is the lower end.
    """
    in_first_half = {"E": (False, False), "F": (False, True), "G": (True, True), "H": (True, False)}[letter]
    return in_first_half if ccd[-1] in "123" else tuple(not end for end in in_first_half)


def quadrant_of_place(column_half, row_half, ccd):
    """Return the letter of a quadrant in the image of a CCD: get_vis_quadrant in detector.py of Euclid's SHE_PPT."""
    layout = [["E", "H"], ["F", "G"]] if int(ccd[-1]) <= 3 else [["G", "F"], ["H", "E"]]
    return layout[column_half][row_half]


def pixels_of(unit):
    """Return the first pixel (column, row) of the light in an array, and its size, by PyAutoArray's Layout2DEuclid."""
    header = unit.header
    at_top, at_right = readout_corner(header["CCDID"], header["QUADID"])
    columns = header["NAXIS1"] - header["PRESCANX"] - header["OVRSCANX"]
    rows = header["NAXIS2"] - header["OVRSCANY"]
    first = header["OVRSCANX"] if at_right else header["PRESCANX"], header["OVRSCANY"] if at_top else 0
    return first, (columns, rows)


def assembled(units, ccd):
    """Return the image of a CCD with the axes of the focal plane."""
    out = np.zeros((SIDE, SIDE), np.uint16)
    for column_half in (0, 1):
        for row_half in (0, 1):
            letter = quadrant_of_place(column_half, row_half, ccd)
            assert readout_corner(ccd, letter) == (bool(row_half), bool(column_half))
            (x, y), (nx, ny) = pixels_of(unit := units[f"{ccd}.{letter}"])
            bottom, left = row_half * (SIDE - ny), column_half * nx
            out[bottom : bottom + ny, left : left + nx] = unit.data[y : y + ny, x : x + nx]
    return out


@pytest.fixture(scope="module", params=["3-3", "3-4"])
def written(request, tmp_path_factory):
    """Return the name of a CCD, its frame, the compressed file of the detector, and Euclid's file."""
    folder, ccd = tmp_path_factory.mktemp("euclid"), request.param
    detector = replace(small("vis", ccd, SIDE), injection_rows=MIDDLE)
    one = nominal.rendered(detector, [19.0] * 4, COLUMNS, ROWS, forced=QUIET)
    rows, writers = fits_files.products(one, (), rice=True)
    for path, writer in writers.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        writer(folder / path)
    files = [(ccd, folder / rows["path"][0].as_py())]
    turned = [ccd] if detector.upside_down else []
    cards = partial(level1.array_cards, exposure=exposure())
    exposure_files._write(files, (), cards, (), turned, folder / "all.fits")
    exposure_files._write_heads(files, [files[0][1].with_suffix(".head")], turned, folder / "all.head")
    return ccd, one, files[0][1], folder / "all.fits"


def test_letters_and_readout_corners_are_those_of_public_programs(written):
    ccd, one, own_file, path = written
    own_pixels = read_back.frame(own_file).data
    np.testing.assert_array_equal(own_pixels, one.science)
    with fits.open(path, checksum=True) as units:
        assert [unit.name for unit in units[1:]] == [f"{ccd}.{letter}" for letter in "EFGH"]
        found = assembled(units, ccd)
    step = 1 if ccd == "3-3" else -1
    np.testing.assert_array_equal(found, own_pixels[::step, ::step])


def test_each_star_lies_where_the_wcs_of_its_array_puts_it(written):
    """All arrays have the position angle of the focal plane, and head files have the WCS of the headers."""
    _, one, _, path = written
    ra, dec = astrometry.sky_of_pixel(one.wcs, COLUMNS, ROWS)
    heads = path.with_suffix(".head").read_text().split("END\n")[:-1]
    letters = set()
    with fits.open(path) as units:
        for unit, head in zip(units[1:], heads, strict=True):
            (x0, y0), (nx, ny) = pixels_of(unit)
            systems = WCS(unit.header), WCS(fits.Header.fromstring(head, sep="\n"))
            for star in range(4):
                (x, y), place = (np.array(system.all_world2pix(ra[star], dec[star], 0)) for system in systems)
                # TPV is inverted by iteration.
                np.testing.assert_allclose(place, (x, y), atol=2e-4)
                if not (x0 + 10 < x < x0 + nx - 10 and y0 + 10 < y < y0 + ny - 10):
                    continue
                letters.add((star, unit.header["QUADID"]))
                column, row = round(float(x)), round(float(y))
                part = unit.data[row - 9 : row + 10, column - 9 : column + 10] - float(np.median(unit.data))
                axis = np.arange(-9, 10)
                window = part * np.exp(-0.5 * (axis**2 + axis[:, None] ** 2) / 2.0**2)
                found = (window * axis).sum() / window.sum(), (window * axis[:, None]).sum() / window.sum()
                assert found == pytest.approx((x - column, y - row), abs=0.1)
            data = unit.header["DATASEC"]
            assert data == f"[{x0 + 1}:{x0 + nx},{y0 + 1}:{y0 + ny}]"
            assert unit.header["ORIENTAT"] == pytest.approx(units[1].header["ORIENTAT"], abs=0.01)
    assert letters == {(0, "E"), (1, "F"), (2, "G"), (3, "H")}


def test_an_array_that_is_turned_twice_is_unchanged(written):
    _, _, own_file, _ = written
    for image in images.read_images(own_file)[1:]:
        twice = level1.turn_array(level1.turn_array(image))
        np.testing.assert_array_equal(twice.data, image.data)
        for (key, value, _), (keyword, expected, _) in zip(twice.cards, image.cards, strict=True):
            assert key == keyword
            assert value == (pytest.approx(expected, abs=1e-9) if key.startswith("CRPIX") else expected)
        ny, nx = image.data.shape
        turned = astrometry.from_cards(level1.turn_cards(image.cards, (nx, ny)))
        reference = astrometry.flip_pixels(astrometry.from_cards(image.cards), (-1, -1), (nx, ny))
        places = [0.0, 200.0], [0.0, 30.0]
        np.testing.assert_allclose(
            astrometry.sky_of_pixel(turned, *places), astrometry.sky_of_pixel(reference, *places), rtol=0, atol=1e-11
        )


def test_head_files_need_a_change_per_image():
    with pytest.raises(ValueError, match="zip"):
        head_files.change_images("EQUINOX =               2000.0\nEND\n", [])
