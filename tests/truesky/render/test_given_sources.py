"""A scene of given sources from the table to the pixels, compared with GalSim drawing the same table."""

import galsim
import galsim.des
import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.store import publish, read
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.reduction import frames
from truesky.render import plan_exposures, render_exposures
from truesky.render.products import read_back
from truesky.request.from_toml import parse

SEED, SIDE = 11, 96
RA, DEC = 53.117, -27.808
GALAXY = {
    "ra": RA + 0.004, "dec": DEC - 0.003, "mag": 21.0, "bulge_fraction": 0.4, "bulge_half_light_radius": 0.5,
    "disk_half_light_radius": 0.9, "bulge_sersic_index": 1.7, "bulge_axis_ratio": 0.7, "disk_axis_ratio": 0.45,
    "position_angle": 35.0, "gamma1": 0.08, "gamma2": -0.05,
}  # fmt: skip
STAR = {"ra": RA - 0.006, "dec": DEC + 0.002, "mag": 20.0}
REQUEST = f"""
accuracy = "reference"
[sources]
only = "table"
band = "lsst_r"
galaxies = "galaxies.csv"
stars = "stars.csv"
[effects]
off = ["all"]
[mission.overrides]
"ext.lsstcam.psf.profile" = {{ value = 1, unit = "" }}
[[pointing]]
channel = "EXT"
camera = "lsstcam"
band = "lsst_r"
ra = {RA}
dec = {DEC}
centre_on = "R22_S11"
detectors = ["R22_S11"]
mjd = 60905.25
position_angle = 25.0
[products]
truth = ["noise_free"]
"""


def written(folder, **sources):
    for name, row in {"galaxies": GALAXY, "stars": STAR, **sources}.items():
        (folder / f"{name}.csv").write_text("\n".join(",".join(map(str, line)) for line in (row, row.values())) + "\n")
    return parse(requests.written(folder, REQUEST, requests.FIELD.format(0.2), seed=SEED))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("given")
    wanted, lake = written(folder), folder / "lake"
    lake.mkdir()
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        for step in module.steps(lake, wanted):
            publish.make_version(lake, step.plan, step.run_task)
    return lake


@pytest.fixture(scope="module")
def images(rendered):
    """Header and pixels by content."""
    version = read.version(rendered, "products")
    files = {row["content"]: version.sidecar_path(row["path"]) for row in version.rows().to_pylist()}
    opened = {content: fits.getdata(file, header=True) for content, file in files.items()}
    # Pixels of the raw file in electrons.
    opened["science"] = read_back.electrons(files["science"]).data, opened["science"][1]
    return {content: (header, data.astype(float)) for content, (data, header) in opened.items()}


def disc_and_bulge():
    """Draw with GalSim in the frame (west, north): position angles begin at its v axis, gamma2 changes sign."""
    height, ratio, fraction = 0.1, GALAXY["disk_axis_ratio"], GALAXY["bulge_fraction"]
    inclination = np.arccos(np.sqrt((ratio**2 - height**2) / (1.0 - height**2))) * galsim.radians
    disc = galsim.InclinedExponential(
        inclination, half_light_radius=GALAXY["disk_half_light_radius"], scale_h_over_r=height
    )
    q, radius = GALAXY["bulge_axis_ratio"], GALAXY["bulge_half_light_radius"]
    bulge = galsim.Sersic(GALAXY["bulge_sersic_index"], half_light_radius=radius * np.sqrt(q))
    both = fraction * bulge.shear(q=q, beta=0.0 * galsim.degrees) + (1.0 - fraction) * disc
    g1, g2 = GALAXY["gamma1"], -GALAXY["gamma2"]
    turned = both.rotate((90.0 + GALAXY["position_angle"]) * galsim.degrees)
    return turned.lens(g1, g2, 1.0 / (1.0 - g1**2 - g2**2))


@pytest.mark.parametrize(("row", "body"), [(GALAXY, disc_and_bulge()), (STAR, None)], ids=["galaxy", "star"])
def test_sources_agree_with_galsim(images, row, body):
    """Position, magnified flux, profile, shear and orientation agree after seeing and pixel integration."""
    header, data = images["noise_free"]
    wcs = galsim.AstropyWCS(header=header)
    # FITS counts pixels from 1.
    place = wcs.toImage(galsim.CelestialCoord(row["ra"] * galsim.degrees, row["dec"] * galsim.degrees))
    seeing = galsim.Moffat(beta=3.0, fwhm=header["SEEIMAGE"], gsparams=galsim.GSParams(xvalue_accuracy=1e-12))
    fine = galsim.GSParams(folding_threshold=1e-4, maxk_threshold=1e-4, kvalue_accuracy=1e-7, maximum_fft_size=16384)
    electrons = header["EXPTIME"] * 10 ** (0.4 * (header["ZEROPNT"] - row["mag"]))
    whole = electrons * (seeing if body is None else galsim.Convolve([body, seeing], gsparams=fine))
    x, y = round(place.x) - SIDE // 2, round(place.y) - SIDE // 2
    image = galsim.ImageD(galsim.BoundsI(x, x + SIDE - 1, y, y + SIDE - 1), wcs=wcs.local(place))
    whole.drawImage(image, center=place)
    found = data[y - 1 : y + SIDE - 1, x - 1 : x + SIDE - 1]
    assert np.abs(found - image.array).max() < 2e-3 * image.array.max()
    assert found.sum() == pytest.approx(image.array.sum(), rel=2e-3)


def test_the_psf_is_stored_with_the_image(rendered):
    version = read.version(rendered, "products")
    (row,) = (row for row in version.rows().to_pylist() if row["content"] == "science")
    image = version.sidecar_path(row["path"])
    model = galsim.des.DES_PSFEx(str(image.with_name(image.name.replace("_science.fits", ".psf"))))
    found = model.getPSF(galsim.PositionD(2000.0, 2000.0)).drawImage(scale=0.25, method="no_pixel").calculateFWHM()
    with fits.open(image) as units:
        assert found * 0.2000587 == pytest.approx(units[-1].header["PSFFWHM"], rel=0.01)


def test_a_frame_has_psf_and_wcs(rendered, images):
    """The position is that of the detector's first pixel, not of the file's."""
    ((frame,),) = frames.from_lake(rendered).values()
    assert frame.psf is not None
    assert frame.psf.name == frame.path.name.replace("_science.fits", ".psf")
    header, _ = images["noise_free"]
    assert [frame.card(key) for key in ("CRPIX1", "CRPIX2")] == pytest.approx([header["CRPIX1"], header["CRPIX2"]])


def test_the_image_has_no_other_sources(rendered, images):
    assert len(read.version(rendered, "rendered_truth").rows()) == 2
    (_, truth), (header, science) = images["noise_free"], images["science"]
    assert header["NMOVING"] == 0
    gain = max(header[f"GAIN{n}"] for n in range(1, header["NAMPS"] + 1))
    assert np.abs(science - truth).max() <= 0.5001 * gain
    assert (truth > 0.01).mean() < 0.01


def test_a_lake_of_other_sources_is_refused(rendered, tmp_path):
    with pytest.raises(BadInput, match="table galaxies has other sources than the request: run truesky build first"):
        render_exposures.steps(rendered, written(tmp_path, galaxies={**GALAXY, "mag": 22.0}))
    universe = parse(
        requests.written(
            tmp_path,
            REQUEST.replace('[sources]\nonly = "table"', "[fluxes]").replace(
                'band = "lsst_r"\ngalaxies = "galaxies.csv"\nstars = "stars.csv"', 'bands = ["lsst_r"]'
            ),
            requests.FIELD.format(0.2),
            seed=SEED,
        )
    )
    with pytest.raises(BadInput, match="table galaxies has other sources than the request"):
        render_exposures.steps(rendered, universe)
