"""A rendered detector -> FITS files and rows of the table `products`; and back.

A detector that is read in quadrants is a file of four extensions, each in the detector's own axes with its pre- and
overscan, behind a header that holds for all of them.

products   rows, and a writer for each file
truth      rows of the table `rendered_truth`
frame      a science file -> the detector's pixels in one piece, ADU
electrons  the same less the level of each amplifier's overscan
science_cards, truth_cards
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs import accuracy, rng
from jobs.render import focal_plane
from jobs.render.effects import bias_structure, charge_transfer, nonlinearity, quadrants, read_noise
from jobs.render.exposure import Rendered, effects_of, numbers_of
from jobs.render.stamps import Sources
from lake_schema import __version__, fits
from lake_schema.fits import Card
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_TRUTH

# Codes of `method` in the table `rendered_truth`.
POINT, PROFILE, PICTURE, TRAIL = 0, 1, 2, 3
# Of an amplifier's offset, a column's stripe and a reading: what next to no pixel is below.
_SURE = 5.0
# Of each number of an accuracy: the end of its keywords, and what it is of.
_ERRORS = {
    "flux": ("FLUX", "fraction of a source's flux"),
    "shape": ("SHAPE", "reduced-shear component"),
    "position": ("POS", "[pix]"),
    "background": ("BACK", "fraction of a sky pixel's noise"),
}
_MJD_ZERO = datetime(1858, 11, 17)

Writer = Callable[[Path], None]


def products(
    rendered: Rendered, truth: Sequence[str] = ("noise_free",), rice: bool = False
) -> tuple[pa.Table, dict[str, Writer]]:
    """Rows of `products` and, by path, what writes each file.

    truth : truth maps that are wanted beside the science image;  rice : images of whole numbers are packed
    """
    images = {"science": _science(rendered)}
    for content in truth:
        if content in rendered.maps:
            images[content] = [fits.Image(rendered.maps[content], truth_cards(rendered, content))]
    exposure, detector = rendered.exposure, rendered.detector
    stem = f"images/{int(exposure['exposure_id']):06d}/{exposure['channel']}_{exposure['band']}_{detector.name}"
    paths = {content: f"{stem}_{content}.fits" for content in images}
    ra, dec = focal_plane.centre(detector, rendered.wcs)
    n = len(images)
    rows = PRODUCTS.build(
        {
            "path": list(paths.values()),
            "content": list(images),
            "exposure_id": [int(exposure["exposure_id"])] * n,
            "detector": [detector.name] * n,
            "channel": [str(exposure["channel"])] * n,
            "band": [str(exposure["band"])] * n,
            "ra": [ra] * n,
            "dec": [dec] * n,
            "s_region": [focal_plane.s_region(detector, rendered.wcs)] * n,
            "mission": [rendered.scene.mission.fingerprint] * n,
            "sources": [len(rendered.sources)] * n,
        }
    )
    writers: dict[str, Writer] = {paths[content]: partial(_write, units, rice) for content, units in images.items()}
    return rows, writers


def truth(rendered: Rendered) -> pa.Table:
    """One row a source that was drawn, ascending id."""
    sources, n = rendered.sources, len(rendered.sources)
    trail = np.zeros((n, 2)) if sources.trail is None else sources.trail
    return RENDERED_TRUTH.build(
        {
            "exposure_id": np.full(n, int(rendered.exposure["exposure_id"]), np.int64),
            "detector": [rendered.detector.name] * n,
            "id": sources.ids,
            "x": sources.column,
            "y": sources.row,
            "expected": sources.electrons,
            "drawn": rendered.drawn,
            "stamp": rendered.sizes,
            "method": _methods(sources),
            "trail_x": trail[:, 0],
            "trail_y": trail[:, 1],
        }
    )


def _methods(sources: Sources) -> npt.NDArray[np.int64]:
    pictured = np.zeros(len(sources), bool) if sources.picture is None else sources.picture >= 0
    method = np.where(pictured, PICTURE, np.where(sources.shape < 0, POINT, PROFILE))
    return np.where(sources.length > 0, TRAIL, method)


def _write(units: Sequence[fits.Image], rice: bool, path: Path) -> None:
    fits.write_images(path, units, rice)


def _science(rendered: Rendered) -> list[fits.Image]:
    """The image; or a header, and an extension for each quadrant, named as detector.quadrant."""
    if rendered.raw.ndim == 2:
        return [fits.Image(rendered.raw, science_cards(rendered))]
    prescan, overscan, rows, middle = quadrants.sizes(rendered.scene)
    detector, scans = rendered.detector, (
        ("PRESCAN", prescan, "[pix] columns before the pixels"),
        ("OVERSCAN", overscan, "[pix] columns after the pixels"),
        ("OVERROWS", rows, "[pix] rows after the pixels"),
        ("INJROWS", middle, "[pix] rows between the halves, without pixels"),
    )  # fmt: skip
    units = [fits.Image(None, (*science_cards(rendered), *scans))]
    for number, data in enumerate(rendered.raw):
        # Of the detector's first pixel in the extension, from 0.
        across, up = quadrants.origin(number, data.shape, prescan, overscan, rows, middle)
        system = focal_plane.shifted(rendered.wcs, across, up)
        cards = (("QUADRANT", quadrants.NAMES[number], "quadrant"), *scans, *focal_plane.cards(system))
        name = f"{detector.name}.{quadrants.NAMES[number]}"
        units.append(fits.Image(quadrants.placed(data, number), cards, name))
    return units


def frame(path: Path) -> fits.Image:
    """A science file's pixels [ny, nx], uint16 ADU, without pre- and overscan, with the header of the whole."""
    read = fits.read_images(path)
    if read[0].data is not None:
        return read[0]
    raw, sizes = _raw(read)
    return fits.Image(quadrants.assembled(raw, *sizes), read[0].cards)


def electrons(path: Path) -> fits.Image:
    """A science file's pixels [ny, nx], float64 e- above the level of each amplifier."""
    read = fits.read_images(path)
    header = {keyword: value for keyword, value, _ in read[0].cards}
    gain, bias = float(header["GAIN"]), float(header["BIAS"])
    if read[0].data is not None:
        return fits.Image((read[0].data - bias) * gain, read[0].cards)
    raw, sizes = _raw(read)
    _, overscan, rows, _ = sizes
    # The last half of the columns after the pixels: charge that traps gave back is in the first.
    level = raw[:, : raw.shape[1] - rows, raw.shape[2] - max(overscan // 2, 1) :].mean(axis=(1, 2), keepdims=True)
    above = quadrants.assembled((raw - level) * gain, *sizes)
    return fits.Image(above, read[0].cards)


def _raw(read: Sequence[fits.Image]) -> tuple[npt.NDArray[np.uint16], tuple[int, int, int, int]]:
    """Quadrants in readout order; prescan, overscan, overscan rows, rows between the halves."""
    header = {keyword: value for keyword, value, _ in read[0].cards}
    raw = np.stack([quadrants.placed(np.asarray(unit.data), number) for number, unit in enumerate(read[1:])])
    prescan, overscan, rows = (int(header[key]) for key in ("PRESCAN", "OVERSCAN", "OVERROWS"))
    # Files of older versions know nothing of rows between the halves.
    return raw, (prescan, overscan, rows, int(header.get("INJROWS", 0)))


def science_cards(rendered: Rendered) -> tuple[Card, ...]:
    """Header of the science image: what an astronomer needs to calibrate it, and what made it."""
    scene = rendered.scene
    gain = scene.value("gain", "electron / adu")
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    return (
        *_common(rendered),
        ("BUNIT", "adu", "unit of the pixels"),
        ("GAIN", gain, "[electron/adu]"),
        (
            "RDNOISE",
            ("read_noise" in applied) * scene.value("read_noise", "electron"),
            "[electron] rms in the image",
        ),
        ("BIAS", scene.value("bias", "adu"), "[adu] added to every pixel"),
        ("SATURATE", _saturation(rendered, gain), "[adu] a full pixel has no less"),
        ("SKYRATE", ("background" in applied) * scene.sky_rate, "[electron/s/pix] mean sky in the image"),
        ("DARKRATE", ("dark_current" in applied) * scene.dark_rate, "[electron/s/pix] mean dark current in the image"),
        *_effect_cards(rendered),
    )


_TRUTH = {
    "noise_free": ("electron", "unit of the pixels: expected, sources alone"),
    "stars": ("electron", "unit of the pixels: expected, stars alone"),
    "sky": ("electron", "unit of the pixels: expected, sky alone"),
    "cosmic_rays": ("electron", "unit of the pixels: of cosmic rays"),
    "ghosts": ("electron", "unit of the pixels: expected, ghosts alone"),
    "saturation": ("", "1 where a pixel or the converter is full"),
}


def truth_cards(rendered: Rendered, content: str) -> tuple[Card, ...]:
    """Header of a truth map: what one thing adds to the exposure, before the rest of the detector."""
    return (*_common(rendered), ("BUNIT", *_TRUTH[content]))


def _common(rendered: Rendered) -> tuple[Card, ...]:
    exposure, scene = rendered.exposure, rendered.scene
    return (
        ("INSTRUME", str(exposure["camera"]), "camera"),
        ("CHANNEL", str(exposure["channel"]), "channel"),
        ("DETECTOR", rendered.detector.name, "detector"),
        ("FILTER", str(exposure["band"]), "passband"),
        ("IMAGETYP", str(exposure["image_type"]), "image type"),
        *((("LAMP", int(exposure["lamp"]), "LED of the calibration unit"),) if exposure.get("lamp") else ()),
        ("EXPOSURE", int(exposure["exposure_id"]), "identifier of the exposure"),
        ("EXPTIME", scene.exposure_time_s, "[s] effective exposure time"),
        ("DATE-OBS", _date(float(exposure["mjd"])), "start of the exposure"),
        ("MJD-OBS", float(exposure["mjd"]), "[d] start of the exposure"),
        ("TIMESYS", "UTC", "time scale of DATE-OBS and MJD-OBS"),
        *focal_plane.cards(rendered.wcs),
        ("PIXSCALE", rendered.detector.pixel_scale, "[arcsec/pix] at the boresight"),
        ("ZEROPNT", rendered.zero_point, "[mag] AB of 1 electron/s"),
        ("PSFFWHM", rendered.psf.fwhm if rendered.psf else 0.0, "[arcsec] of a point source, pixel included"),
        ("SEEING", float(exposure["seeing"]), "[arcsec] FWHM of the atmosphere"),
        ("NSOURCES", len(rendered.sources), "number of sources drawn"),
        ("NMOVING", int((rendered.sources.length > 0).sum()), "of them moving: bodies of the Solar System"),
        ("SRCREACH", rendered.complete, "[arcsec] beyond the detector: sources complete"),
        ("SEED", str(rendered.seed), "of the random numbers"),
        ("MISSION", rendered.scene.mission.fingerprint, ""),
        ("TRUESKY", __version__, "version of the simulator"),
        *_accuracy_cards(rendered),
    )


def _accuracy_cards(rendered: Rendered) -> tuple[Card, ...]:
    """ACC*: errors that were allowed; ERR*: as measured, of drawing and of charge transfer where that is applied.

    Independent causes: the root of the sum of their squares.
    """
    causes = [] if rendered.psf is None else [asdict(accuracy.reached(rendered.accuracy))]
    applied = [decision.name for decision in rendered.decisions if decision.applied]
    causes += [charge_transfer.errors(rendered.scene, name) for name in applied]
    made = {name: math.hypot(*(cause.get(name, 0.0) for cause in causes)) for name in _ERRORS}
    allowed = asdict(rendered.accuracy)
    return (
        *((f"ACC{short}", allowed[name], f"allowed error: {text}") for name, (short, text) in _ERRORS.items()),
        *((f"ERR{short}", made[name], f"largest error: {text}") for name, (short, text) in _ERRORS.items()),
    )


def _date(mjd: float) -> str:
    """ISO 8601, milliseconds."""
    return (_MJD_ZERO + timedelta(days=mjd)).isoformat(timespec="milliseconds")


def _saturation(rendered: Rendered, gain: float) -> float:
    """What a full pixel reads at least: of its charge, what transfer and amplifier leave, below all noise."""
    full = rendered.scene.value("full_well", "electron")
    scene = replace(rendered.scene, peak_electrons=full)
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    # The first of a column, or a row, finds all traps empty.
    losses = (charge_transfer.PARALLEL, charge_transfer.SERIAL)
    signal = full - sum(effect.contribution(scene) for effect in losses if effect.name in applied)
    if nonlinearity.EFFECT.name in applied:
        signal = float(nonlinearity.apply(np.array([max(signal, 0.0)]), *nonlinearity.parameters(scene))[0])
    noises = (bias_structure.EFFECT, read_noise.EFFECT)
    signal -= _SURE * sum(effect.contribution(scene) for effect in noises if effect.name in applied)
    level = signal / gain + scene.value("bias", "adu")
    return float(np.floor(np.clip(level, 0.0, scene.value("adc_max", "adu"))))


def _effect_cards(rendered: Rendered) -> tuple[Card, ...]:
    """EFFECTn = name, whether it was applied, and its contribution over what would be noticed (margin); EFKEYn seed."""
    cards: list[Card] = []
    exposed = rendered.exposure
    where = f"exposure {exposed['exposure_id']}"
    known = {e.name: e for e in effects_of(str(exposed["channel"]), str(exposed["image_type"]), where)}
    for number, decision in enumerate(rendered.decisions, start=1):
        state = ("on" if decision.applied else "off") + (" (forced)" if decision.forced else "")
        cards.append((f"EFFECT{number}", f"{decision.name}: {state}, margin {decision.margin:.3g}", "needed above 1"))
        if decision.applied and decision.name in known:
            numbers = numbers_of(known[decision.name], exposed, rendered.detector.name, rendered.seed)
            cards.append((f"EFKEY{number}", rng.name_of(*numbers), "key of its numbers (Philox)"))
    return tuple(cards)
