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
from truesky.render.channels.registry import find_effects
from truesky.render.effects.charge import ramp, ramp_nonlinearity
from truesky.render.effects.readout import bias_structure, charge_transfer, nonlinearity, ramp_noise, read_noise
from truesky.render.exposure import truth_maps
from truesky.render.exposure.rendered_detector import RenderedDetector, random_identity
from truesky.render.products import calibration_cards
from truesky.request import accuracy

# Of an amplifier's offset, a column's stripe and a reading: what next to no pixel is below.
_NOISE_SIGMAS = 5.0
# Effects that bring dark current.
_DARK_EFFECTS = {"dark_current", "dark_map"}
# What tools look for in the header of each array: few follow INHERIT to the header that holds for all.
_REPEATED_KEYWORDS = ("EXPTIME", "FILTER", "DATE-OBS", "MJD-OBS", "TIMESYS")
# Likewise of arrays of what amplifiers read.
_READOUT_KEYWORDS = ("GAIN", "RDNOISE", "RDNDRAWN", "SATURATE")
PER_ARRAY_KEYWORDS = (*_REPEATED_KEYWORDS, *_READOUT_KEYWORDS, "BUNIT")
# Of electrons that have not been read.
_UNREAD_CARDS: tuple[Card, ...] = (
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
_RAMP_KEYWORDS = {"READMODE", "NG", "NR", "ND", "FRTIME", "ELAPTIME"}
_GROUP_KEYWORDS = {"GAIN", "FRNOISE", "BIAS"}
_GROUP_AXIS: tuple[Card, ...] = (
    ("WCSAXES", 3, "number of world coordinate axes"),
    ("CTYPE3", "GROUP", "number of the group"),
    ("CRVAL3", 1.0, "first group"),
    ("CRPIX3", 1.0, "first plane = 1"),
    ("CD3_3", 1.0, ""),
)
_MJD_ZERO = datetime(1858, 11, 17)


def science_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Header of the science image: what an astronomer needs to calibrate it, and what made it."""
    scene = rendered.scene
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    return (
        *_common_cards(rendered),
        ("DETSIZE", _mosaic_size(rendered), "of the mosaic of all detectors"),
        *unit_cards(rendered.readout.unit),
        *_shared_amplifier_cards(rendered),
        ("SKYRATE", ("background" in applied) * scene.sky_rate, "[electron/s/pix] mean sky in the image"),
        (
            "DARKRATE",
            bool(_DARK_EFFECTS & applied) * scene.dark_rate,
            "[electron/s/pix] dark current of usual pixels",
        ),
        *_effect_cards(rendered),
    )


def _shared_amplifier_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """What amplifiers share; of those that are in one array, their mean, and the lowest of levels."""
    if rendered.readout.unit == "electron":
        return (
            *_UNREAD_CARDS,
            ("SATURATE", rendered.scene.value("full_well", "electron"), "[electron] of a full pixel"),
        )
    in_one_array = len(rendered.readout.extensions) == 1
    return tuple(
        (key, float(np.min(value) if key == "SATURATE" else np.mean(value)), comment)
        for key, value, comment in amplifier_values(rendered)
        if in_one_array or np.ndim(value) == 0
    )


def unit_cards(unit: str | None) -> tuple[Card, ...]:
    """Of arrays of one unit; none where they have none, or each its own."""
    return (("BUNIT", unit, "unit of the pixels"),) if unit else ()


def array_cards(rendered: RenderedDetector, extension: Extension, common: Sequence[Card]) -> tuple[Card, ...]:
    """Header of one of several arrays.

    common : cards of the header that holds for all of them
    """
    repeated = (*_REPEATED_KEYWORDS, *(_READOUT_KEYWORDS if extension.unit == "adu" else ()))
    return (
        ("INHERIT", True, "the first header of the file holds, too"),
        *(card for card in common if card[0] in repeated),
        *unit_cards(extension.unit),
        *extension.cards,
        *section_cards(rendered, extension),
        *amplifier_cards(rendered, extension.amplifier),
    )


def section_cards(rendered: RenderedDetector, extension: Extension) -> tuple[Card, ...]:
    """Which of an array's pixels are the detector's, and where these are on the detector and in the mosaic."""
    array_sections = extension.sections
    if array_sections is None:
        return ()
    all_detectors = detectors.detectors(rendered.exposure.camera, rendered.scene.mission)
    mosaic_section = sections.to_mosaic_section(rendered.detector, array_sections.ccd, all_detectors)
    return (
        ("DATASEC", array_sections.data.text, "pixels of the detector"),
        ("TRIMSEC", array_sections.data.text, "pixels to be kept"),
        *((("BIASSEC", array_sections.bias.text, "columns that tell the bias"),) if array_sections.bias else ()),
        ("CCDSEC", array_sections.ccd.text, "DATASEC on the detector"),
        *((("DETSEC", mosaic_section, "DATASEC in the mosaic of the detectors"),) if mosaic_section else ()),
    )


def amplifier_cards(rendered: RenderedDetector, number: int | None) -> tuple[Card, ...]:
    """Of an amplifier's array: what differs from one amplifier to the other, and is not in the common header.

    number : of the amplifier; None = the array is of several
    """
    if number is None:
        return ()
    amplifier_numbers = ((key, np.atleast_1d(value), comment) for key, value, comment in amplifier_values(rendered))
    return tuple((key, float(values[number]), comment) for key, values, comment in amplifier_numbers if len(values) > 1)


def _mosaic_size(rendered: RenderedDetector) -> str:
    return sections.mosaic_size(detectors.detectors(rendered.exposure.camera, rendered.scene.mission))


def amplifier_values(rendered: RenderedDetector) -> tuple[tuple[str, float | Float, str], ...]:
    """What differs from one amplifier to the other: keyword, value or values [q], comment."""
    scene = rendered.scene
    saturated = "[adu] lowest level of a saturated pixel"
    if scene.ramp:
        saturated = "[adu] full at last read; earlier: see CHI2"
    return (
        ("GAIN", scene.amplifier_values("gain", "electron / adu"), "[electron/adu] conversion gain"),
        *_read_noise(rendered),
        ("BIAS", scene.amplifier_values("bias", "adu"), "[adu] bias level, added to every pixel"),
        ("SATURATE", _saturation(rendered), saturated),
    )


def _read_noise(rendered: RenderedDetector) -> tuple[tuple[str, float | Float, str], ...]:
    """Of the image; and of one read, where the image is the signal of a ramp: the detector's, and what was drawn of it.

    An image whose other noise hides it is drawn without.
    """
    scene = rendered.scene
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    noise_per_read = scene.amplifier_values("read_noise", "electron")
    drawn = "[electron] the same, as it was drawn"
    if not scene.ramp:
        noise = (read_noise.EFFECT.name in applied) * noise_per_read
        return (("RDNOISE", noise_per_read, "[electron] rms read noise"), ("RDNDRAWN", noise, drawn))
    contributions = {effect.name: effect.contribution(scene) for effect in (ramp_noise.EFFECT, ramp_noise.DRIFT)}
    return (
        ("RDNOISE", math.hypot(*contributions.values()), "[electron] rms of the signal that reading adds"),
        ("RDNDRAWN", math.hypot(*(part for name, part in contributions.items() if name in applied)), drawn),
        ("FRNOISE", noise_per_read, "[electron] rms noise of one read"),
    )


_TRUTH_UNITS = {
    "noise_free": ("electron", "unit of the pixels: expected, sources alone"),
    "stars": ("electron", "unit of the pixels: expected, stars alone"),
    "sky": ("electron", "unit of the pixels: expected, sky alone"),
    "cosmic_rays": ("electron", "unit of the pixels: cosmic rays alone"),
    "ghosts": ("electron", "unit of the pixels: expected, ghosts alone"),
    "satellites": ("electron", "unit of the pixels: expected, trails alone"),
    "persistence": ("electron", "unit of the pixels: expected, persistence"),
    **{
        content: ("electron", f"unit of the pixels: expected, order {order} alone")
        for order, content in truth_maps.ORDER_MAPS.items()
    },
    "ramp": ("adu", "unit of the pixels: groups as read"),
    "saturation": ("", "1 where a pixel or the converter is saturated"),
    "traps": ("", "traps of species 1 + 256 of 2 + 65536 of 3"),
    "dipoles": ("electron", "unit of the pixels: brought by pumping"),
}


def truth_cards(rendered: RenderedDetector, content: str) -> tuple[Card, ...]:
    """Header of a truth map: what one thing adds to the exposure, before the rest of the detector."""
    map_cards = _group_cards(rendered) if content == "ramp" else _common_cards(rendered)
    return (*map_cards, ("BUNIT", *_TRUTH_UNITS[content]))


def _group_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Of the groups as they are read: common cards with an axis of groups, how they were read, and electrons of ADU."""
    out: list[Card] = []
    for card in _common_cards(rendered):
        out += _GROUP_AXIS if card[0] == "WCSAXES" else [card]
    out += [card for card in rendered.readout.cards if card[0] in _RAMP_KEYWORDS]
    amplifier_numbers = (
        (key, value, text) for key, value, text in amplifier_values(rendered) if key in _GROUP_KEYWORDS
    )
    return (*out, *((key, float(value), text) for key, value, text in amplifier_numbers if np.ndim(value) == 0))


def _common_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    exposure, scene = rendered.exposure, rendered.scene
    place = observatories.for_camera(exposure.camera)
    start, air = exposure.mjd + place.seconds_ahead_of_utc / 86400.0, exposure.airmass
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
        ("OBJECT", _object_name(exposure), "what is looked at"),
        ("RA", exposure.ra, "[deg] boresight right ascension"),
        ("DEC", exposure.dec, "[deg] boresight declination"),
        *((("AIRMASS", air, "of the boresight"),) if air is not None else ()),
        ("EXPOSURE", exposure.exposure_id, "identifier of the exposure"),
        ("EXPTIME", scene.exposure_time_s, "[s] effective exposure time"),
        ("DATE-OBS", _iso_date(start), "start of the exposure"),
        ("MJD-OBS", start, "[d] start of the exposure"),
        ("TIMESYS", place.time_scale, "time scale of DATE-OBS and MJD-OBS"),
        *astrometry.cards(rendered.wcs),
        ("PIXSCALE", rendered.detector.pixel_scale, "[arcsec/pix] pixel scale at the boresight"),
        ("ZEROPNT", rendered.zero_point, "[mag] AB magnitude of 1 electron/s"),
        ("PSFFWHM", rendered.psf.fwhm if rendered.psf else 0.0, "[arcsec] FWHM of a point source, with the pixel"),
        ("SEEING", exposure.seeing, "[arcsec] FWHM of the atmosphere"),
        ("NSOURCES", len(rendered.sources), "number of sources drawn"),
        ("NMOVING", int((rendered.sources.trail_length > 0).sum()), "number of moving Solar System objects drawn"),
        ("SRCREACH", rendered.complete_margin_arcsec, "[arcsec] sources complete beyond the detector"),
        ("SEED", str(rendered.seed), "seed of the random numbers"),
        *((("NOISSEED", str(rendered.noise_seed), "seed of the noise"),) if rendered.noise_seed is not None else ()),
        *((("REALIS", exposure.realisation, "realisation of the noise"),) if (exposure.realisation or 1) > 1 else ()),
        ("MISSION", rendered.scene.mission.fingerprint, ""),
        ("TRUESKY", __version__, "version of the simulator"),
        *_accuracy_cards(rendered),
    )


def _lamp_cards(lamp: int, rendered: RenderedDetector) -> tuple[Card, ...]:
    level = rendered.scene.value("flat.signal", "electron")
    return (
        ("LAMP", lamp, "LED of the calibration unit"),
        ("LAMPSIG", level, "[electron] of it where it is seen best"),
    )


def _accuracy_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """ACC*: errors that were allowed; ERR*: as measured, of drawing and of charge transfer where that is applied.

    Independent causes: the root of the sum of their squares.
    """
    causes = [] if rendered.psf is None else [asdict(accuracy.expected_errors(rendered.accuracy))]
    applied = [decision.name for decision in rendered.decisions if decision.applied]
    causes += [charge_transfer.source_errors(rendered.scene, name) for name in applied]
    errors = {name: math.hypot(*(cause.get(name, 0.0) for cause in causes)) for name in _ERRORS}
    allowed = asdict(rendered.accuracy)
    return (
        *((f"ACC{short}", allowed[name], f"allowed error: {text}") for name, (short, text) in _ERRORS.items()),
        *((f"ERR{short}", errors[name], f"largest error: {text}") for name, (short, text) in _ERRORS.items()),
    )


def _object_name(exposure: ExposureRow) -> str:
    """A calibration source, or the survey and its field."""
    if exposure.target:
        return exposure.target
    return exposure.survey if exposure.field is None else f"{exposure.survey} {exposure.field}"


def _iso_date(mjd: float) -> str:
    """ISO 8601, milliseconds."""
    return (_MJD_ZERO + timedelta(days=mjd)).isoformat(timespec="milliseconds")


def _saturation(rendered: RenderedDetector) -> float | Float:
    """What a full pixel reads at least: of its charge, what transfer and amplifier leave, below all noise; or [q]."""
    full = rendered.scene.value("full_well", "electron")
    scene = replace(rendered.scene, peak_electrons=full)
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    # The first of a column, or a row, finds all traps empty.
    losses = (
        charge_transfer.PARALLEL, charge_transfer.SERIAL, charge_transfer.PARALLEL_LOSS, charge_transfer.SERIAL_LOSS
    )  # fmt: skip
    remaining = full - sum(effect.contribution(scene) for effect in losses if effect.name in applied)
    signal: float | Float = remaining
    if scene.ramp:
        b = scene.value("nonlinearity", "1 / electron")
        of_charge, of_signal = (
            b * (effect.name in applied) for effect in (ramp_nonlinearity.EFFECT, ramp_nonlinearity.SIGNAL)
        )
        signal = ramp.signal_at_full_well(scene, of_charge, of_signal)
    if nonlinearity.EFFECT.name in applied:
        curve = nonlinearity.parameters(scene)
        n_amplifiers = max(np.size(number) for number in curve)
        signal = nonlinearity.apply(np.full(n_amplifiers, max(remaining, 0.0)), *curve)
        signal = signal if n_amplifiers > 1 else float(signal[0])
    noises = (bias_structure.EFFECT, read_noise.EFFECT, ramp_noise.EFFECT, ramp_noise.DRIFT)
    signal = signal - _NOISE_SIGMAS * sum(effect.contribution(scene) for effect in noises if effect.name in applied)
    level = signal / scene.amplifier_values("gain", "electron / adu") + scene.amplifier_values("bias", "adu")
    rounded = np.floor(np.clip(level, 0.0, scene.amplifier_values("adc_max", "adu")))
    return np.asarray(rounded) if np.ndim(rounded) else float(rounded)


def _effect_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """EFFECTn = name, whether it was applied, and its contribution over what would be noticed (margin); EFKEYn seed."""
    cards: list[Card] = []
    exposed = rendered.exposure
    where = f"exposure {exposed.exposure_id}"
    effects_by_name = {e.name: e for e in find_effects(exposed.channel, exposed.image_type, where)}
    for number, decision in enumerate(rendered.decisions, start=1):
        state = ("on" if decision.applied else "off") + (" (forced)" if decision.forced else "")
        cards.append((f"EFFECT{number}", f"{decision.name}: {state}, margin {decision.margin:.3g}", "needed above 1"))
        if decision.applied and decision.name in effects_by_name:
            numbers = random_identity(
                effects_by_name[decision.name], exposed, rendered.detector.name, rendered.seed, rendered.noise_seed
            )
            cards.append((f"EFKEY{number}", rng.key_hex(*numbers), "key of its random numbers"))
    return tuple(cards)
