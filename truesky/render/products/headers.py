"""FITS headers of the science image and of the truth maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import datetime, timedelta

import numpy as np

from lake_schema import __version__
from lake_schema.arrays import Float
from lake_schema.fits.images import Card
from lake_schema.tables.exposures import ExposureRow
from truesky.randomness import rng
from truesky.render.camera import astrometry, detectors, observatories, sections
from truesky.render.channels.readout import Extension
from truesky.render.channels.registry import effects_of
from truesky.render.effects.charge import ramp, ramp_nonlinearity
from truesky.render.effects.readout import bias_structure, charge_transfer, nonlinearity, ramp_noise, read_noise
from truesky.render.exposure import truth_maps
from truesky.render.exposure.rendered import Rendered, numbers_of
from truesky.render.products import calibration_cards
from truesky.request import accuracy

# Of an amplifier's offset, a column's stripe and a reading: what next to no pixel is below.
_SURE = 5.0
# Effects that bring dark current.
_DARK = {"dark_current", "dark_map"}
# What tools look for in the header of each array: few follow INHERIT to the header that holds for all.
_EVERYWHERE = ("EXPTIME", "FILTER", "DATE-OBS", "MJD-OBS", "TIMESYS")
# Likewise of arrays of what amplifiers read.
_OF_READING = ("GAIN", "RDNOISE", "RDNDRAWN", "SATURATE")
IN_EACH = (*_EVERYWHERE, *_OF_READING, "BUNIT")
# Of electrons that have not been read.
_UNREAD: tuple[Card, ...] = (
    ("GAIN", 1.0, "[electron/electron] of the pixels"),
    ("RDNOISE", 0.0, "[electron] rms read noise"),
    ("RDNDRAWN", 0.0, "[electron] the same, as it was drawn"),
    ("BIAS", 0.0, "[electron] bias level"),
)
# Of each number of an accuracy: the end of its keywords, and what it is of.
_ERRORS = {
    "flux": ("FLUX", "fraction of a source's flux"),
    "shape": ("SHAPE", "reduced-shear component"),
    "position": ("POS", "[pix]"),
    "background": ("BACK", "fraction of a sky pixel's noise"),
}
# Of the readout and of amplifiers, what holds for groups; they have no border of reference pixels.
_OF_RAMP = {"READMODE", "NG", "NR", "ND", "FRTIME", "ELAPTIME"}
_OF_GROUPS = {"GAIN", "FRNOISE", "BIAS"}
_GROUP_AXIS: tuple[Card, ...] = (
    ("WCSAXES", 3, "number of world coordinate axes"),
    ("CTYPE3", "GROUP", "number of the group"),
    ("CRVAL3", 1.0, "first group"),
    ("CRPIX3", 1.0, "first plane = 1"),
    ("CD3_3", 1.0, ""),
)
_MJD_ZERO = datetime(1858, 11, 17)


def science_cards(rendered: Rendered) -> tuple[Card, ...]:
    """Header of the science image: what an astronomer needs to calibrate it, and what made it."""
    scene = rendered.scene
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    return (
        *_common(rendered),
        ("DETSIZE", _mosaic(rendered), "of the mosaic of all detectors"),
        *unit_cards(rendered.readout.unit),
        *_of_all(rendered),
        ("SKYRATE", ("background" in applied) * scene.sky_rate, "[electron/s/pix] mean sky in the image"),
        (
            "DARKRATE",
            bool(_DARK & applied) * scene.dark_rate,
            "[electron/s/pix] dark current of usual pixels",
        ),
        *_effect_cards(rendered),
    )


def _of_all(rendered: Rendered) -> tuple[Card, ...]:
    """What amplifiers share; of those that are in one array, their mean, and the lowest of levels."""
    if rendered.readout.unit == "electron":
        return (*_UNREAD, ("SATURATE", rendered.scene.value("full_well", "electron"), "[electron] of a full pixel"))
    together = len(rendered.readout.extensions) == 1
    return tuple(
        (key, float(np.min(value) if key == "SATURATE" else np.mean(value)), comment)
        for key, value, comment in of_amplifiers(rendered)
        if together or np.ndim(value) == 0
    )


def unit_cards(unit: str | None) -> tuple[Card, ...]:
    """Of arrays of one unit; none where they have none, or each its own."""
    return (("BUNIT", unit, "unit of the pixels"),) if unit else ()


def array_cards(rendered: Rendered, extension: Extension, common: Sequence[Card]) -> tuple[Card, ...]:
    """Header of one of several arrays.

    common : cards of the header that holds for all of them
    """
    again = (*_EVERYWHERE, *(_OF_READING if extension.unit == "adu" else ()))
    return (
        ("INHERIT", True, "the first header of the file holds, too"),
        *(card for card in common if card[0] in again),
        *unit_cards(extension.unit),
        *extension.cards,
        *section_cards(rendered, extension),
        *amplifier_cards(rendered, extension.amplifier),
    )


def section_cards(rendered: Rendered, extension: Extension) -> tuple[Card, ...]:
    """Which of an array's pixels are the detector's, and where these are on the detector and in the mosaic."""
    own = extension.sections
    if own is None:
        return ()
    every = detectors.detectors(rendered.exposure.camera, rendered.scene.mission)
    where = sections.in_mosaic(rendered.detector, own.ccd, every)
    return (
        ("DATASEC", own.data.text, "pixels of the detector"),
        ("TRIMSEC", own.data.text, "pixels to be kept"),
        *((("BIASSEC", own.bias.text, "columns that tell the bias"),) if own.bias else ()),
        ("CCDSEC", own.ccd.text, "DATASEC on the detector"),
        *((("DETSEC", where, "DATASEC in the mosaic of the detectors"),) if where else ()),
    )


def amplifier_cards(rendered: Rendered, number: int | None) -> tuple[Card, ...]:
    """Of an amplifier's array: what differs from one amplifier to the other, and is not in the common header.

    number : of the amplifier; None = the array is of several
    """
    if number is None:
        return ()
    found = ((key, np.atleast_1d(value), comment) for key, value, comment in of_amplifiers(rendered))
    return tuple((key, float(values[number]), comment) for key, values, comment in found if len(values) > 1)


def _mosaic(rendered: Rendered) -> str:
    return sections.mosaic_size(detectors.detectors(rendered.exposure.camera, rendered.scene.mission))


def of_amplifiers(rendered: Rendered) -> tuple[tuple[str, float | Float, str], ...]:
    """What differs from one amplifier to the other: keyword, value or values [q], comment."""
    scene = rendered.scene
    saturated = "[adu] lowest level of a saturated pixel"
    if scene.ramp:
        saturated = "[adu] full at last read; earlier: see CHI2"
    return (
        ("GAIN", scene.of_amplifiers("gain", "electron / adu"), "[electron/adu] conversion gain"),
        *_read_noise(rendered),
        ("BIAS", scene.of_amplifiers("bias", "adu"), "[adu] bias level, added to every pixel"),
        ("SATURATE", _saturation(rendered), saturated),
    )


def _read_noise(rendered: Rendered) -> tuple[tuple[str, float | Float, str], ...]:
    """Of the image; and of one read, where the image is the signal of a ramp: the detector's, and what was drawn of it.

    An image whose other noise hides it is drawn without.
    """
    scene = rendered.scene
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    of_read = scene.of_amplifiers("read_noise", "electron")
    drawn = "[electron] the same, as it was drawn"
    if not scene.ramp:
        noise = (read_noise.EFFECT.name in applied) * of_read
        return (("RDNOISE", of_read, "[electron] rms read noise"), ("RDNDRAWN", noise, drawn))
    parts = {effect.name: effect.contribution(scene) for effect in (ramp_noise.EFFECT, ramp_noise.DRIFT)}
    return (
        ("RDNOISE", math.hypot(*parts.values()), "[electron] rms of the signal that reading adds"),
        ("RDNDRAWN", math.hypot(*(part for name, part in parts.items() if name in applied)), drawn),
        ("FRNOISE", of_read, "[electron] rms noise of one read"),
    )


_TRUTH = {
    "noise_free": ("electron", "unit of the pixels: expected, sources alone"),
    "stars": ("electron", "unit of the pixels: expected, stars alone"),
    "sky": ("electron", "unit of the pixels: expected, sky alone"),
    "cosmic_rays": ("electron", "unit of the pixels: cosmic rays alone"),
    "ghosts": ("electron", "unit of the pixels: expected, ghosts alone"),
    "satellites": ("electron", "unit of the pixels: expected, trails alone"),
    "persistence": ("electron", "unit of the pixels: expected, persistence"),
    **{
        content: ("electron", f"unit of the pixels: expected, order {order} alone")
        for order, content in truth_maps.ORDERS.items()
    },
    "ramp": ("adu", "unit of the pixels: groups as read"),
    "saturation": ("", "1 where a pixel or the converter is saturated"),
    "traps": ("", "traps of species 1 + 256 of 2 + 65536 of 3"),
    "dipoles": ("electron", "unit of the pixels: brought by pumping"),
}


def truth_cards(rendered: Rendered, content: str) -> tuple[Card, ...]:
    """Header of a truth map: what one thing adds to the exposure, before the rest of the detector."""
    own = _group_cards(rendered) if content == "ramp" else _common(rendered)
    return (*own, ("BUNIT", *_TRUTH[content]))


def _group_cards(rendered: Rendered) -> tuple[Card, ...]:
    """Of the groups as they are read: common cards with an axis of groups, how they were read, and electrons of ADU."""
    out: list[Card] = []
    for card in _common(rendered):
        out += _GROUP_AXIS if card[0] == "WCSAXES" else [card]
    out += [card for card in rendered.readout.cards if card[0] in _OF_RAMP]
    found = ((key, value, text) for key, value, text in of_amplifiers(rendered) if key in _OF_GROUPS)
    return (*out, *((key, float(value), text) for key, value, text in found if np.ndim(value) == 0))


def _common(rendered: Rendered) -> tuple[Card, ...]:
    exposure, scene = rendered.exposure, rendered.scene
    place = observatories.of(exposure.camera)
    start, air = exposure.mjd + place.ahead / 86400.0, exposure.airmass
    return (
        *((("TELESCOP", place.telescope, "telescope"),) if place.telescope else ()),
        ("INSTRUME", place.instrument, "instrument"),
        ("CHANNEL", exposure.channel, "channel"),
        ("DETECTOR", rendered.detector.name, "detector"),
        ("FILTER", exposure.band, "passband"),
        *((("GRISM", exposure.grism, "grism"),) if exposure.grism else ()),
        *((("GRISMPA", exposure.grism_angle, "[deg] of the dispersion, x to y"),) if exposure.grism else ()),
        ("IMAGETYP", exposure.image_type, "image type"),
        *(_lamp_cards(exposure.lamp, rendered) if exposure.lamp else ()),
        *((("TARGET", exposure.target, "calibration source"),) if exposure.target else ()),
        *calibration_cards.cards(exposure, scene),
        ("OBJECT", _object(exposure), "what is looked at"),
        ("RA", exposure.ra, "[deg] boresight right ascension"),
        ("DEC", exposure.dec, "[deg] boresight declination"),
        *((("AIRMASS", air, "of the boresight"),) if air is not None else ()),
        ("EXPOSURE", exposure.exposure_id, "identifier of the exposure"),
        ("EXPTIME", scene.exposure_time_s, "[s] effective exposure time"),
        ("DATE-OBS", _date(start), "start of the exposure"),
        ("MJD-OBS", start, "[d] start of the exposure"),
        ("TIMESYS", place.time_scale, "time scale of DATE-OBS and MJD-OBS"),
        *astrometry.cards(rendered.wcs),
        ("PIXSCALE", rendered.detector.pixel_scale, "[arcsec/pix] pixel scale at the boresight"),
        ("ZEROPNT", rendered.zero_point, "[mag] AB magnitude of 1 electron/s"),
        ("PSFFWHM", rendered.psf.fwhm if rendered.psf else 0.0, "[arcsec] FWHM of a point source, with the pixel"),
        ("SEEING", exposure.seeing, "[arcsec] FWHM of the atmosphere"),
        ("NSOURCES", len(rendered.sources), "number of sources drawn"),
        ("NMOVING", int((rendered.sources.length > 0).sum()), "number of moving Solar System objects drawn"),
        ("SRCREACH", rendered.complete, "[arcsec] sources complete beyond the detector"),
        ("SEED", str(rendered.seed), "seed of the random numbers"),
        *((("NOISSEED", str(rendered.noise_seed), "seed of the noise"),) if rendered.noise_seed is not None else ()),
        *((("REALIS", exposure.realisation, "realisation of the noise"),) if (exposure.realisation or 1) > 1 else ()),
        ("MISSION", rendered.scene.mission.fingerprint, ""),
        ("TRUESKY", __version__, "version of the simulator"),
        *_accuracy_cards(rendered),
    )


def _lamp_cards(lamp: int, rendered: Rendered) -> tuple[Card, ...]:
    level = rendered.scene.value("flat.signal", "electron")
    return (
        ("LAMP", lamp, "LED of the calibration unit"),
        ("LAMPSIG", level, "[electron] of it where it is seen best"),
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


def _object(exposure: ExposureRow) -> str:
    """A calibration source, or the survey and its field."""
    if exposure.target:
        return exposure.target
    return exposure.survey if exposure.field is None else f"{exposure.survey} {exposure.field}"


def _date(mjd: float) -> str:
    """ISO 8601, milliseconds."""
    return (_MJD_ZERO + timedelta(days=mjd)).isoformat(timespec="milliseconds")


def _saturation(rendered: Rendered) -> float | Float:
    """What a full pixel reads at least: of its charge, what transfer and amplifier leave, below all noise; or [q]."""
    full = rendered.scene.value("full_well", "electron")
    scene = replace(rendered.scene, peak_electrons=full)
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    # The first of a column, or a row, finds all traps empty.
    losses = (
        charge_transfer.PARALLEL, charge_transfer.SERIAL, charge_transfer.PARALLEL_LOSS, charge_transfer.SERIAL_LOSS
    )  # fmt: skip
    left = full - sum(effect.contribution(scene) for effect in losses if effect.name in applied)
    signal: float | Float = left
    if scene.ramp:
        b = scene.value("nonlinearity", "1 / electron")
        of_charge, of_signal = (
            b * (effect.name in applied) for effect in (ramp_nonlinearity.EFFECT, ramp_nonlinearity.SIGNAL)
        )
        signal = ramp.full_signal(scene, of_charge, of_signal)
    if nonlinearity.EFFECT.name in applied:
        curve = nonlinearity.parameters(scene)
        parts = max(np.size(number) for number in curve)
        signal = nonlinearity.apply(np.full(parts, max(left, 0.0)), *curve)
        signal = signal if parts > 1 else float(signal[0])
    noises = (bias_structure.EFFECT, read_noise.EFFECT, ramp_noise.EFFECT, ramp_noise.DRIFT)
    signal = signal - _SURE * sum(effect.contribution(scene) for effect in noises if effect.name in applied)
    level = signal / scene.of_amplifiers("gain", "electron / adu") + scene.of_amplifiers("bias", "adu")
    found = np.floor(np.clip(level, 0.0, scene.of_amplifiers("adc_max", "adu")))
    return np.asarray(found) if np.ndim(found) else float(found)


def _effect_cards(rendered: Rendered) -> tuple[Card, ...]:
    """EFFECTn = name, whether it was applied, and its contribution over what would be noticed (margin); EFKEYn seed."""
    cards: list[Card] = []
    exposed = rendered.exposure
    where = f"exposure {exposed.exposure_id}"
    known = {e.name: e for e in effects_of(exposed.channel, exposed.image_type, where)}
    for number, decision in enumerate(rendered.decisions, start=1):
        state = ("on" if decision.applied else "off") + (" (forced)" if decision.forced else "")
        cards.append((f"EFFECT{number}", f"{decision.name}: {state}, margin {decision.margin:.3g}", "needed above 1"))
        if decision.applied and decision.name in known:
            numbers = numbers_of(
                known[decision.name], exposed, rendered.detector.name, rendered.seed, rendered.noise_seed
            )
            cards.append((f"EFKEY{number}", rng.name_of(*numbers), "key of its random numbers"))
    return tuple(cards)
