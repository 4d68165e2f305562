"""Raw frames of a section of a ground camera's detector with isolated stars, and an observer's masters."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.mission.configuration import resolve
from tests.truesky.render import calibrated, fields, nominal
from truesky.fluxes import passbands
from truesky.reduction import files
from truesky.reduction import frames as lake_frames
from truesky.reduction.frames import Frame
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.effects.readout import bias_structure
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.products import fits_files, head_files, read_back, truth_table
from truesky.render.psf import to_psfex
from truesky.request.accuracy import SURVEY

SEED, SECONDS, ZERO_POINT = 1, 100.0, 27.0
BANDS = {
    "decam": "des_r", "lsstcam": "lsst_r", "megacam": "cfis_r", "jpcam": "jedis_g", "gpc1": "ps1_i", "hsc": "hsc_z",
}  # fmt: skip
TRUTH = ("saturation", "cosmic_rays", "sky")


@dataclass(frozen=True)
class Ground:
    """A rendered section of a detector, its raw frame, and a folder with its masters."""

    one: RenderedDetector
    frame: Frame
    masters: Path
    wcs: WCS


def made(folder, camera, side, electrons, pitch, sky=8.0, rays=1.0, forced=None, overrides=None, number=1):
    """Render stars on a lattice, with fluxes distributed uniformly in the logarithm.

    Parameters
    ----------
    folder : Path
        Folder for the files.
    camera : str
        Name of the camera.
    side : int
        Side of the section in pixels.
    electrons : (float, float)
        Smallest and largest number of electrons of a star.
    pitch : float
        Distance between stars in pixels.
    sky : float
        Sky in electrons per second and pixel.
    rays : float
        Rate of cosmic rays relative to the camera's rate.
    forced : dict of str to bool, optional
        Effects that are forced on or off.
    overrides : dict, optional
        Overrides of mission parameters.
    number : int
        Number of the exposure. Each has another pointing, stars at other pixels, and another noise.
    """
    usual = fields.MISSION.value(f"ext.{camera}.cosmic_rays.rate", "1 / s")
    mission = resolve(overrides={f"ext.{camera}.cosmic_rays.rate": (rays * usual, "1 / s"), **(overrides or {})})
    detector = replace(detectors.detectors(camera, mission)[4], nx=side, ny=side, injection_rows=0)
    ra, dec, angle = boresight_for(detector, 53.1 + 0.1 * (number - 1), -27.8, 12.0)
    system = astrometry.wcs(detector, ra, dec, angle)
    where = astrometry.sky_of_pixel(system, *(at + 17.0 * (number - 1) for at in nominal.lattice(side, pitch)))
    least, most = np.log10(electrons)
    light = 10.0 ** np.random.default_rng(2).uniform(least, most, len(where[0]))
    f_nu = 10 ** (-0.4 * (ZERO_POINT - 2.5 * np.log10(light / SECONDS) - 23.9))
    band, none, points = BANDS[camera], fields.galaxies([], []), fields.stars(*where)
    exposed = {
        "channel": "EXT", "camera": camera, "band": band, "ra": ra, "dec": dec, "position_angle": angle, "seeing": 0.8,
        "exposure_id": number, "sky": sky, "zero_point": ZERO_POINT, "exposure_time_s": SECONDS,
    }  # fmt: skip
    tables = none, fields.fluxes(none, band, 0.0), points, fields.fluxes(points, band, f_nu)
    own = passbands.load(band)
    one = fields.rendered(exposed, detector, tables, mission, SURVEY, SEED, forced, truth=TRUTH, passband=own)
    return _written(folder, one)


def _written(folder, one):
    rows, writers = fits_files.products(one, ())
    path, psf = folder / "raw.fits", folder / "raw.psf"
    name = rows["path"][0].as_py()
    writers[name](path)
    writers[head_files.head_path(name)](path.with_suffix(".head"))
    to_psfex.write(one.psf, one.detector, psf)
    cards = read_back.header(path)
    scene = replace(one.scene, band=passbands.load(one.exposure.band))
    frame = Frame(path, one.exposure, scene, lake_frames._applied_effects(cards), cards, psf)
    masters = folder / "masters"
    masters.mkdir()
    # Masters of an observer are plain images, and the flat has light that came through the telescope.
    flat = calibrated.flat(scene, SEED, frame.applied)
    for kind, values in (("flat", flat), ("bias", bias(frame))):
        fits.writeto(files.master_path(masters, frame, kind), values.astype(np.float32))
    return Ground(one, frame, masters, one.wcs)


def bias(frame):
    """Return the electrons above the overscan."""
    scene, layout = frame.scene, frame.scene.layout
    if "bias_structure" not in frame.applied:
        return np.zeros((scene.ny, scene.nx))
    camera, name = calibrated.camera_of(scene), bias_structure.EFFECT.name
    rng = calibrated.stream(SEED, camera, scene.detector.name, name)
    width = layout.scan_columns + layout.width
    columns = bias_structure.structure(len(layout.amplifiers), width, *bias_structure.EFFECT.parameters(scene), rng)
    behind = columns[:, layout.prescan + layout.width :] if layout.overscan else columns[:, : layout.prescan]
    columns = columns - behind.mean(axis=1, keepdims=True)
    return layout.assemble(np.repeat(columns[:, None], layout.planes_shape[1], axis=1))


def truth(ground):
    """Return columns of the table `rendered_truth`, with the positions of the stars' centroids."""
    rows = truth_table.truth(ground.one)
    found = {name: np.asarray(rows[name]) for name in ("x", "y", "psf_x", "psf_y", "mag")}
    return found["x"] + found["psf_x"], found["y"] + found["psf_y"], found["mag"]
