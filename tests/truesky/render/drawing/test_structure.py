"""Spiral arms and knots in exposures agree with galsim, and have the same sky positions in all bands."""

from dataclasses import replace

import galsim
import numpy as np
import pyarrow as pa
import pytest
from astropy.io import fits

from lake_schema.store.provenance import file_sha256
from tests.truesky import nightly
from tests.truesky.render import fields, infrared
from tests.truesky.render.exposure.test_render import SIDE, field, render
from tests.truesky.render.fields import MISSION, fluxes, galaxies, moments, one_source, psf_of, small, stars
from truesky.fluxes import bulges
from truesky.render.camera.astrometry import sky_of_pixel, wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import arcs, cost, reference, stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.products import truth_table
from truesky.render.psf import euclid
from truesky.render.sources import disc_structure, galaxy_stamps
from truesky.render.sources.disc_structure import DiscStructure
from truesky.request.accuracy import REFERENCE, SURVEY
from truesky.request.structure import Arms, Stamps

NOISE = 12.0
DISCS = DiscStructure(Arms(least_radius=0.5), 1)
# A single knot has most of the visible structure.
KNOT = DiscStructure(Arms(contrast=0.0, knots=0.5, number=1, least_radius=0.5), 1)
SPIRAL = {"disk_half_light_radius": 1.4, "bulge_fraction": 0.2, "bulge_half_light_radius": 0.4}


@pytest.mark.parametrize(("camera", "name"), [("vis", "2-3"), ("lsstcam", "R22_S11")])
@nightly.parametrize("electrons", [2e4, 3e7], (1,))
def test_a_sheared_spiral_is_what_galsim_draws(camera, name, electrons):
    """The disc is face-on, because galsim has no thick images. It is sheared, magnified, and on a rotated detector."""
    detector, psf = small(camera, name, 256), psf_of(camera)
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0))
    shape = {**SPIRAL, "position_angle": 25.0, "kappa": 0.1, "gamma1": 0.15, "gamma2": -0.1}
    source = one_source(detector, system, electrons, 128.3, 126.8, **shape)
    source = disc_structure.add_structure(source, source.shapes, DISCS)
    settings = settings_for(REFERENCE)
    sizes = stamp_sizes.stamp_sizes(source.electrons, source.shape, source.shapes, psf, NOISE, settings)
    sizes = stamp_sizes.smallest_allowed_sizes(sizes, disc_structure.sides(source.shapes, DISCS) / psf.pixel_scale)
    neglected = stamp_sizes.neglected_flux(source.electrons, NOISE, settings)
    ours = stamps.draw(source, sizes, psf, 256, 256, neglected=neglected)
    theirs = np.roll(reference.draw_reference(source, 0, psf, 256), (127 - 128, 0), (0, 1))
    plain = replace(source, picture=None, pictures=())
    smooth = stamps.draw(plain, sizes, psf, 256, 256, neglected=neglected)
    assert np.abs(ours - theirs)[8:-8, 8:-8].max() < 4e-4 * theirs.max()
    assert np.abs(ours - smooth).max() > 0.03 * theirs.max()
    assert ours.sum() == pytest.approx(smooth.sum(), rel=1e-5)


@pytest.mark.parametrize("inclination", [30.0, 80.0])
def test_structure_is_as_thick_as_its_disc(inclination):
    """The thickness of a disc reduces its transform by the same factor as in inclined discs of galsim."""
    detector = small("vis", "2-3")
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0))
    source = one_source(detector, system, inclination=inclination, position_angle=90.0, disk_half_light_radius=1.2)
    (picture,) = disc_structure.add_structure(source, source.shapes, DISCS).pictures
    k = np.random.default_rng(1).uniform(-8, 8, (2, 50))
    thick, thin = arcs.transform(picture, np.eye(2), *k), arcs.transform(replace(picture, thick=None), np.eye(2), *k)
    # The position angle of 90 deg puts the major axis along east-west.
    flat, deep = (
        galsim.InclinedExponential(inclination * galsim.degrees, half_light_radius=1.2, scale_h_over_r=height)
        for height in (1e-5, 0.1)
    )
    ratio = [deep.kValue(*at).real / flat.kValue(*at).real for at in k.T]
    np.testing.assert_allclose(thick, thin * ratio, atol=1e-6)
    assert np.min(ratio) < (0.98 if inclination < 60.0 else 0.9)
    assert np.abs(thin).max() > 1e-3


def with_structure(channel, discs, body=None, **options):
    """Render a galaxy on a small detector, in the middle unless the pointing is changed; return it and its position."""
    points = field(channel)[3]
    detector = small("vis", "3-4", SIDE) if channel == "VIS" else small("lsstcam", "R22_S11", SIDE)
    system = wcs(detector, *(field(channel)[1][name] for name in ("ra", "dec", "position_angle")))
    ra, dec = (float(at[0]) for at in sky_of_pixel(system, [127.6], [128.2]))
    row = galaxies(ra, dec, **{**SPIRAL, **(body or {})})
    return render(channel, row, points.slice(0, 0), flux=300.0, discs=discs, **options), (ra, dec)


def offset(found, smooth, place):
    """Return the offset (east, north) of the knot in arcsec, from the light that it adds."""
    more = found.noise_free.astype(float) - smooth.noise_free
    centre, _ = moments(np.where(more > 0.3 * more.max(), more, 0.0))
    at, up = sky_of_pixel(found.wcs, centre[:1], centre[1:])
    return np.array([(at[0] - place[0]) * np.cos(np.radians(place[1])), up[0] - place[1]]) * 3600


def in_h(discs, place):
    """Render the same galaxy in H, on a detector of NISP with another pointing."""
    detector, (ra, dec) = small("nisp", "DET22", 128), place
    row = infrared.exposed(detector)
    turned = dict(zip(("ra", "dec", "position_angle"), boresight_for(detector, ra, dec, 71.0), strict=True))
    row |= turned
    body, none = galaxies(ra, dec, **SPIRAL), stars(ra, dec).slice(0, 0)
    tables = body, fluxes(body, "euclid_h", 300.0), none, fluxes(none, "euclid_h", 0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(euclid, "nisp_psf", lambda d, band, *_: infrared.psf_of(d, "euclid_h"))
        return fields.rendered(row, detector, tables, MISSION, SURVEY, infrared.SEED, discs=discs)


def test_a_knot_is_at_the_same_place_in_every_band_and_dither():
    found, place = with_structure("VIS", KNOT)
    at = offset(found, with_structure("VIS", None)[0], place)
    assert 0.3 < np.hypot(*at) < 4.0
    elsewhere = boresight_for(small("vis", "3-4", SIDE), place[0] + 1e-3, place[1] - 8e-4, 40.0)
    moved = dict(zip(("ra", "dec", "position_angle"), elsewhere, strict=True))
    dithered = [with_structure("VIS", discs, exposed=moved)[0] for discs in (KNOT, None)]
    shift = dithered[0].sources.column - found.sources.column, dithered[0].sources.row - found.sources.row
    assert np.hypot(*shift) > 20.0
    np.testing.assert_allclose(offset(*dithered, place), at, atol=0.02)
    ground = [with_structure("EXT", discs)[0] for discs in (KNOT, None)]
    np.testing.assert_allclose(offset(*ground, with_structure("EXT", None)[1]), at, atol=0.06)
    infra = [in_h(discs, place) for discs in (KNOT, None)]
    # Headers of NISP give the windowed centroid of a star.
    np.testing.assert_allclose(offset(*infra, place), at, atol=0.06)


@nightly.parametrize("kind", ["arms", "stamps"], (0,))
def test_brighter_bulge_in_a_band_does_not_change_the_picture(kind, monkeypatch, tmp_path):
    """The picture depends on the catalogue, but the fraction of light in the disc depends on the band."""
    asked = {"discs": DISCS}
    if kind == "stamps":
        fits.writeto(tmp_path / "two.fits", np.array([blob(q) for q in (1.0, 0.9, 0.5)], np.float32))
        sha256 = file_sha256(tmp_path / "two.fits")
        asked = {"discs": None, "stamps": galaxy_stamps.from_file(Stamps(tmp_path / "two.fits", True), 1, sha256)}
    plain = with_structure("VIS", **asked)[0].sources

    def in_band(rows, *_):
        return rows.set_column(rows.schema.get_field_index("bulge_fraction"), "bulge_fraction", pa.array([0.6]))

    monkeypatch.setattr(bulges, "with_fractions_in_band", in_band)
    red = with_structure("VIS", **asked)[0].sources
    assert red.shapes.bulge_fraction.tolist() == [0.6]
    (one,), (other,) = plain.pictures, red.pictures
    np.testing.assert_array_equal(one.image, other.image)
    np.testing.assert_array_equal(one.matrix, other.matrix)


def blob(ratio):
    y, x = np.mgrid[:48, :48] - 23.5
    return np.exp(-np.hypot(x, y / ratio) / 4.0)


def test_shear_moves_a_knot_as_it_moves_the_sky():
    """The knot moves by theta = A^-1 beta, in (east, north)."""
    lens = {"kappa": 0.1, "gamma1": 0.12, "gamma2": 0.08}
    found, place = with_structure("VIS", KNOT)
    at = offset(found, with_structure("VIS", None)[0], place)
    lensed = [with_structure("VIS", discs, lens)[0] for discs in (KNOT, None)]
    matrix = np.array([[1 - 0.1 - 0.12, -0.08], [-0.08, 1 - 0.1 + 0.12]])
    np.testing.assert_allclose(offset(*lensed, place), np.linalg.inv(matrix) @ at, atol=0.04)


def test_flux_and_half_light_radius_of_the_image_stay():
    found, smooth = (with_structure("VIS", discs, {"inclination": 35.0})[0] for discs in (DISCS, None))
    images = [one.noise_free.astype(float) for one in (found, smooth)]
    assert images[0].sum() == pytest.approx(images[1].sum(), rel=1e-3)
    y, x = np.mgrid[:SIDE, :SIDE]
    order = np.argsort(np.hypot(x - 127.6, y - 128.2), axis=None)
    grown = [np.cumsum(image.ravel()[order]) for image in images]
    reach = [np.sqrt(np.searchsorted(light, 0.5 * light[-1])) for light in grown]
    assert reach[0] == pytest.approx(reach[1], rel=0.01)
    assert np.abs(images[0] - images[1]).max() > 0.03 * images[1].max()
    assert images[0].min() > -1e-3


def test_one_row_of_truth_and_nothing_else_changes():
    """The truth has one row for the galaxy, and small discs are unchanged, bit by bit; costs include the structure."""
    found, smooth = (with_structure("VIS", discs)[0] for discs in (DISCS, None))
    rows, plain = (truth_table.truth(one).drop(["stamp", "drawn"]) for one in (found, smooth))
    assert rows.equals(plain)
    assert found.drawn_electrons[0] == pytest.approx(smooth.drawn_electrons[0], rel=1e-3)
    psf, small_discs = psf_of("vis"), replace(DISCS, arms=Arms(least_radius=3.0))
    np.testing.assert_array_equal(with_structure("VIS", small_discs)[0].science, smooth.science)
    both = [cost.seconds(one.sources, one.sizes, psf, SIDE, SIDE) for one in (found, smooth)]
    assert both[0] > both[1]
