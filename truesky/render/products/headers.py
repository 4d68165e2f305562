"""Make the FITS headers of science images and of truth maps (images of the true signal of one effect or source)."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import asdict, replace
from datetime import datetime, timedelta

import numpy as np

from lake_schema import __version__
from lake_schema.arrays import Float
from lake_schema.fits.images import Card
from lake_schema.mission.parameter import SPACE_CAMERAS
from lake_schema.tables.exposures import ExposureRow
from truesky.randomness import rng
from truesky.render.camera import astrometry, detectors, observatories, sections
from truesky.render.channels.readout import Extension
from truesky.render.channels.registry import find_effects
from truesky.render.dispersing import draw
from truesky.render.effects.charge import ramp, ramp_nonlinearity
from truesky.render.effects.light import mean_sky
from truesky.render.effects.readout import bias_structure, charge_transfer, nonlinearity, ramp_noise, read_noise
from truesky.render.effects.scene import Scene
from truesky.render.exposure import truth_maps
from truesky.render.exposure.rendered_detector import RenderedDetector, random_identity
from truesky.render.products import calibration_cards
from truesky.render.psf.centroids import window_rms
from truesky.render.sky import ice
from truesky.request import accuracy

# The saturation level in the header is the mean value of a full pixel minus this number of standard deviations of the
# noise. Almost no saturated pixel is then read below the level.
_NOISE_SIGMAS = 5.0
# Names of the effects that add dark current.
_DARK_EFFECTS = {"dark_current", "dark_map"}
# Keywords of the primary header that are repeated in the header of each array: few tools obey INHERIT and read them
# from the primary header.
_REPEATED_KEYWORDS = ("EXPTIME", "FILTER", "DATE-OBS", "MJD-OBS", "TIMESYS")
# Keywords of the primary header that are repeated in the header of each array of the file whose pixels are in ADU.
_READOUT_KEYWORDS = ("GAIN", "RDNOISE", "RDNDRAWN", "SATURATE")
# Keywords that the header of each array of a file has, because they are repeated or may differ between arrays.
PER_ARRAY_KEYWORDS = (*_REPEATED_KEYWORDS, *_READOUT_KEYWORDS, "BUNIT")
# Cards of images that contain electrons in pixels before readout, hence no gain, read noise or bias.
_UNREAD_CARDS: tuple[Card, ...] = (
    ("GAIN", 1.0, "[electron/electron] gain; pixels in electrons"),
    ("RDNOISE", 0.0, "[electron] rms read noise"),
    ("RDNDRAWN", 0.0, "[electron] rms read noise added to the image"),
    ("BIAS", 0.0, "[electron] bias level"),
)
# Errors that `Accuracy` limits, by field name. Each has the end of its two keywords, such as FLUX in ACCFLUX (allowed
# error) and ERRFLUX (expected error), and a template of their comments.
_ERRORS = {
    "flux": ("FLUX", "{} relative error of flux"),
    "shape": ("SHAPE", "{} error of a reduced-shear component"),
    "position": ("POS", "[pix] {} error of position"),
    "background": ("BACK", "{} error of sky / noise of a pixel"),
}
# Header keywords of the readout mode and times of an up-the-ramp image. They are also written to the header of the
# truth map "ramp", whose planes are the groups of averaged reads.
_RAMP_KEYWORDS = {"READMODE", "NG", "NR", "ND", "FRTIME", "ELAPTIME"}
# Header keywords of gain, noise per read and bias. They are also written to the header of the truth map "ramp", whose
# planes are the groups of averaged reads of an up-the-ramp exposure.
_GROUP_KEYWORDS = {"GAIN", "FRNOISE", "BIAS"}
# Cards of the third axis of the truth map "ramp" (one plane per group of averaged reads); the axis counts the groups.
_GROUP_AXIS: tuple[Card, ...] = (
    ("WCSAXES", 3, "number of world coordinate axes"),
    ("CTYPE3", "GROUP", "group number"),
    ("CRVAL3", 1.0, "number of the first group"),
    ("CRPIX3", 1.0, "plane of the first group, counted from 1"),
    ("CD3_3", 1.0, ""),
)
# Calendar date of MJD 0, to write dates in headers.
_MJD_ZERO = datetime(1858, 11, 17)


def science_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards of the primary header of a science image.

    They describe the exposure, the calibration (gain, noise, zero point, WCS), the sky, and the simulated effects.
    """
    scene = rendered.scene
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    return (
        *_common_cards(rendered),
        ("DETSIZE", _mosaic_size(rendered), "section of the mosaic of all detectors"),
        *unit_cards(rendered.readout.unit),
        *_shared_amplifier_cards(rendered),
        ("SKYRATE", _mean_sky_rate(scene, applied), "[electron/s/pix] mean sky background"),
        (
            "DARKRATE",
            bool(_DARK_EFFECTS & applied) * scene.dark_rate,
            "[electron/s/pix] dark current, typical pixel",
        ),
        *_effect_cards(rendered),
    )


def _mean_sky_rate(scene: Scene, applied: Container[str]) -> float:
    """Return the mean of the diffuse light that is drawn in the pixels of the detector, in electrons per second.

    `applied` has the names of the applied effects. Without a duration there is no light; the result is then 0.
    """
    seconds = scene.exposure_time_s
    return mean_sky.mean_electrons(scene, applied) / seconds if seconds > 0.0 else 0.0


def _shared_amplifier_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards of gain, read noise, bias and saturation level that apply to all amplifiers of a detector.

    If amplifiers differ and share one array, the cards have the means, and the lowest saturation level. If each has its
    own array, values that differ are left out here.
    """
    if rendered.readout.unit == "electron":
        return (
            *_UNREAD_CARDS,
            ("SATURATE", rendered.scene.value("full_well", "electron"), "[electron] full-well capacity"),
        )
    in_one_array = len(rendered.readout.extensions) == 1
    return tuple(
        (key, float(np.min(value) if key == "SATURATE" else np.mean(value)), comment)
        for key, value, comment in amplifier_values(rendered)
        if in_one_array or np.ndim(value) == 0
    )


def unit_cards(unit: str | None) -> tuple[Card, ...]:
    """Return the card BUNIT with the pixel unit, or () if `unit` is None (different units) or "" (no unit)."""
    return (("BUNIT", unit, "pixel unit"),) if unit else ()


def array_cards(rendered: RenderedDetector, extension: Extension, common: Sequence[Card]) -> tuple[Card, ...]:
    """Return the header of a FITS extension, for an image file with several arrays.

    Parameters
    ----------
    rendered : RenderedDetector
        The rendered detector.
    extension : Extension
        The array of the extension, with its own cards.
    common : sequence of Card
        Cards of the primary header, of which some are repeated.

    Returns
    -------
    tuple of Card
        Cards of the extension: repeated ones, unit, sections, and values of its amplifier.
    """
    repeated = (*_REPEATED_KEYWORDS, *(_READOUT_KEYWORDS if extension.unit == "adu" else ()))
    return (
        ("INHERIT", True, "primary header also applies"),
        *(card for card in common if card[0] in repeated),
        *unit_cards(extension.unit),
        *extension.cards,
        *section_cards(rendered, extension),
        *amplifier_cards(rendered, extension.amplifier),
    )


def section_cards(rendered: RenderedDetector, extension: Extension) -> tuple[Card, ...]:
    """Return the cards that tell which part of an array has pixels of the detector, and where these belong.

    DATASEC and TRIMSEC are the part of the array, and BIASSEC its overscan. CCDSEC is the place on the detector, and
    DETSEC the place in the mosaic of all detectors, or on the detector for cameras whose files count so. Numbers of
    both decrease along axes in which the array is read in the opposite direction. The result is () if the sections of
    the array are unknown.
    """
    array_sections = extension.sections
    if array_sections is None:
        return ()
    ccd_section = array_sections.ccd.text_along(array_sections.steps)
    mosaic_section: str | None = ccd_section
    bias = array_sections.bias
    if observatories.for_camera(rendered.exposure.camera).has_noao_sections:
        all_detectors = detectors.detectors(rendered.exposure.camera, rendered.scene.mission)
        mosaic_section = sections.to_mosaic_section(
            rendered.detector, array_sections.ccd, all_detectors, array_sections.steps
        )
    elif bias:
        bias = replace(bias, y=array_sections.data.y, ny=array_sections.data.ny)
    return (
        ("DATASEC", array_sections.data.text, "section with the detector pixels"),
        ("TRIMSEC", array_sections.data.text, "section to keep when trimming"),
        *((("BIASSEC", bias.text, "section for measuring the bias level"),) if bias else ()),
        ("CCDSEC", ccd_section, "DATASEC in detector coordinates"),
        *((("DETSEC", mosaic_section, "DATASEC in mosaic coordinates"),) if mosaic_section else ()),
    )


def amplifier_cards(rendered: RenderedDetector, number: int | None) -> tuple[Card, ...]:
    """Return the cards of an amplifier (gain, noise, bias, saturation) whose values differ between amplifiers.

    `number` is the index of the amplifier, from 0. It is None for an array of several amplifiers; the result is then
    ().
    """
    if number is None:
        return ()
    amplifier_numbers = ((key, np.atleast_1d(value), comment) for key, value, comment in amplifier_values(rendered))
    return tuple((key, float(values[number]), comment) for key, values, comment in amplifier_numbers if len(values) > 1)


def _mosaic_size(rendered: RenderedDetector) -> str:
    if not observatories.for_camera(rendered.exposure.camera).has_noao_sections:
        return sections.Section(0, 0, rendered.detector.nx, rendered.detector.ny).text
    return sections.mosaic_size(detectors.detectors(rendered.exposure.camera, rendered.scene.mission))


def amplifier_values(rendered: RenderedDetector) -> tuple[tuple[str, float | Float, str], ...]:
    """Return (keyword, value, comment) for gain, read noise, bias and saturation level.

    A value is one number if it is the same for all amplifiers, otherwise an array of shape (n_amplifiers,).
    """
    scene = rendered.scene
    saturated = "[adu] lowest level of a saturated pixel"
    if scene.ramp:
        saturated = "[adu] saturation at last read; see also CHI2"
    return (
        ("GAIN", scene.amplifier_values("gain", "electron / adu"), "[electron/adu] conversion gain"),
        *_read_noise(rendered),
        ("BIAS", scene.amplifier_values("bias", "adu"), "[adu] bias level of all pixels"),
        ("SATURATE", _saturation(rendered), saturated),
    )


def _read_noise(rendered: RenderedDetector) -> tuple[tuple[str, float | Float, str], ...]:
    """Return (keyword, value, comment) for the read noise of the detector, and for the part that is in the image.

    The read noise in the image is 0 if other noise is so large that read noise is not drawn in the pixels. Prescan and
    overscan always have it, unless the request switches it off. An up-the-ramp image also has the noise of a single
    read. Values are in electrons rms: one number, or one per amplifier.
    """
    scene = rendered.scene
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    noise_per_read = scene.amplifier_values("read_noise", "electron")
    drawn = "[electron] rms read noise added to the image"
    if not scene.ramp:
        noise = (read_noise.EFFECT.name in applied) * noise_per_read
        return (("RDNOISE", noise_per_read, "[electron] rms read noise"), ("RDNDRAWN", noise, drawn))
    contributions = {effect.name: effect.contribution(scene) for effect in (ramp_noise.EFFECT, ramp_noise.DRIFT)}
    return (
        ("RDNOISE", math.hypot(*contributions.values()), "[electron] rms read noise of the ramp signal"),
        ("RDNDRAWN", math.hypot(*(part for name, part in contributions.items() if name in applied)), drawn),
        ("FRNOISE", noise_per_read, "[electron] rms read noise of a single read"),
    )


# Value and comment of the card BUNIT (pixel unit) for each truth map, by name of the map.
_TRUTH_UNITS = {
    "noise_free": ("electron", "pixel unit; expected signal of sources"),
    "stars": ("electron", "pixel unit; expected signal of stars"),
    "sky": ("electron", "pixel unit; expected signal of the sky"),
    "cosmic_rays": ("electron", "pixel unit; signal of cosmic rays"),
    "ghosts": ("electron", "pixel unit; expected signal of ghosts"),
    "satellites": ("electron", "pixel unit; expected signal of satellites"),
    "persistence": ("electron", "pixel unit; expected persistence signal"),
    **{
        content: ("electron", f"pixel unit; expected signal of order {order}")
        for order, content in truth_maps.ORDER_MAPS.items()
    },
    "ramp": ("adu", "pixel unit; values of the groups"),
    "saturation": ("", "1: pixel or converter saturated, 0: other"),
    "traps": ("", "n1 + 256 n2 + 65536 n3; n: traps per species"),
    "dipoles": ("electron", "pixel unit; charge moved by trap pumping"),
}


def truth_cards(rendered: RenderedDetector, content: str) -> tuple[Card, ...]:
    """Return the header of a truth map (image of the true signal of one effect or of sources).

    `content` is the name of the map, one of `_TRUTH_UNITS`; other names raise KeyError.
    """
    map_cards = _group_cards(rendered) if content == "ramp" else _common_cards(rendered)
    return (*map_cards, ("BUNIT", *_TRUTH_UNITS[content]))


def _group_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the header of the truth map "ramp", which has the groups of reads of an up-the-ramp exposure as planes.

    It consists of the cards that all truth maps have, cards of a third axis that counts the groups, and cards with the
    readout mode, gain, noise and bias.
    """
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
        ("DETECTOR", rendered.detector.name, "detector name"),
        ("FILTER", place.filters.get(exposure.band, exposure.band), "filter"),
        ("BAND", exposure.band, "passband in tables of truesky"),
        *((("GRISM", exposure.grism, "grism"),) if exposure.grism else ()),
        *((("GRISMPA", exposure.grism_angle, "[deg] dispersion direction, from x to y"),) if exposure.grism else ()),
        ("IMAGETYP", exposure.image_type, "image type"),
        *(_lamp_cards(exposure.lamp, rendered) if exposure.lamp else ()),
        *((("TARGET", exposure.target, "calibration source"),) if exposure.target else ()),
        *calibration_cards.cards(exposure, scene),
        ("OBJECT", _object_name(exposure), "target or field"),
        ("RA", exposure.ra, "[deg] boresight right ascension"),
        ("DEC", exposure.dec, "[deg] boresight declination"),
        *((("AIRMASS", air, "airmass at the boresight"),) if air is not None else ()),
        ("EXPOSURE", exposure.exposure_id, "exposure identifier"),
        ("EXPTIME", scene.exposure_time_s, "[s] effective exposure time"),
        ("DATE-OBS", iso_date(start), "start of the exposure"),
        ("MJD-OBS", start, "[d] start of the exposure"),
        ("TIMESYS", place.time_scale, "time scale of DATE-OBS and MJD-OBS"),
        *astrometry.cards(rendered.wcs),
        ("PIXSCALE", rendered.detector.pixel_scale, "[arcsec/pix] pixel scale at the boresight"),
        *((("CLOUDS", exposure.clouds, "[mag] extinction by clouds, in ZEROPNT"),) if exposure.clouds else ()),
        *_ageing_cards(rendered),
        ("ZEROPNT", rendered.zero_point, "[mag] AB magnitude of 1 electron/s"),
        ("PSFFWHM", rendered.psf.fwhm if rendered.psf else 0.0, "[arcsec] PSF FWHM including the pixel"),
        *((("PSFWIN", window_rms(rendered.psf), "[arcsec] rms of window of centroids"),) if rendered.psf else ()),
        ("SEEING", exposure.seeing, "[arcsec] FWHM of the air at zenith and 500 nm"),
        *((("SEEIMAGE", scene.seeing, "[arcsec] FWHM in this band, with telescope"),) if scene.seeing else ()),
        ("NSOURCES", len(rendered.sources), "number of sources drawn"),
        ("NMOVING", int((rendered.sources.trail_length > 0).sum()), "number of moving Solar System objects drawn"),
        ("SRCREACH", rendered.complete_margin_arcsec, "[arcsec] margin with complete sources"),
        ("SEED", str(rendered.seed), "random-number seed"),
        *((("NOISSEED", str(rendered.noise_seed), "seed of the noise"),) if rendered.noise_seed is not None else ()),
        *((("REALIS", exposure.realisation, "realisation of the noise"),) if (exposure.realisation or 1) > 1 else ()),
        ("MISSION", rendered.scene.mission.fingerprint, ""),
        ("TRUESKY", __version__, "version of the simulator"),
        *_accuracy_cards(rendered),
    )


def _ageing_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards of ice on the optics of Euclid and of radiation damage of VIS at the date of the exposure."""
    exposure, scene = rendered.exposure, rendered.scene
    cards: list[Card] = []
    if exposure.camera in SPACE_CAMERAS and scene.mission.value("plm.ice") > 0.0:
        lost = 1.0 - ice.transmission(exposure.band, exposure.mjd, scene.mission)
        cards.append(("ICELOSS", lost, "fraction of light lost by ice at this date"))
    if f"{scene.section}.cti.age" in scene.mission:
        cards.append(("CTIAGE", charge_transfer.age(scene), "traps relative to the end of the mission"))
    return tuple(cards)


def _lamp_cards(lamp: int, rendered: RenderedDetector) -> tuple[Card, ...]:
    level = rendered.scene.value("flat.signal", "electron")
    return (
        ("LAMP", lamp, "LED of the calibration unit"),
        ("LAMPSIG", level, "[electron] maximum signal of the lamp"),
    )


def _accuracy_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards with the errors of the simulation: errors that the request allows (ACC*), expected ones (ERR*).

    Expected errors come from drawing sources or their spectra (if the image has a PSF) and from the charge transfer
    effects, if applied. They are independent and are added in quadrature.
    """
    causes = []
    if rendered.psf is not None:
        of_images = asdict(accuracy.expected_errors(rendered.accuracy))
        causes = [of_images if rendered.spectra is None else of_images | draw.expected_errors(rendered.accuracy)]
    applied = [decision.name for decision in rendered.decisions if decision.applied]
    causes += [charge_transfer.source_errors(rendered.scene, name) for name in applied]
    errors = {name: math.hypot(*(cause.get(name, 0.0) for cause in causes)) for name in _ERRORS}
    allowed = asdict(rendered.accuracy)
    return (
        *((f"ACC{short}", allowed[name], text.format("allowed")) for name, (short, text) in _ERRORS.items()),
        *((f"ERR{short}", errors[name], text.format("largest")) for name, (short, text) in _ERRORS.items()),
    )


def _object_name(exposure: ExposureRow) -> str:
    """Return the name of the calibrator, or else that of the survey with the number of the field (if it has one)."""
    if exposure.target:
        return exposure.target
    return exposure.survey if exposure.field is None else f"{exposure.survey} {exposure.field}"


def iso_date(mjd: float) -> str:
    """Return an MJD as a date in ISO 8601 with milliseconds, without a time zone."""
    return (_MJD_ZERO + timedelta(days=mjd)).isoformat(timespec="milliseconds")


def _saturation(rendered: RenderedDetector) -> float | Float:
    """Return the lowest value in ADU at which a pixel may be saturated: one number, or one per amplifier.

    It is the value of a full pixel after the losses by charge transfer and nonlinearity, minus five times the noise of
    readout (read noise and bias structure, added linearly), rounded down and within the range of the converter.
    """
    full_wells = rendered.scene.amplifier_values("full_well", "electron")
    scene = replace(rendered.scene, peak_electrons=rendered.scene.full_well)
    applied = {decision.name for decision in rendered.decisions if decision.applied}
    # Sum the largest charge losses that a pixel may have by charge transfer. The first pixel of a column or row has
    # them, because it finds all traps empty.
    losses = (
        charge_transfer.PARALLEL, charge_transfer.SERIAL, charge_transfer.PARALLEL_LOSS, charge_transfer.SERIAL_LOSS
    )  # fmt: skip
    remaining = full_wells - sum(effect.contribution(scene) for effect in losses if effect.name in applied)
    signal = remaining
    if scene.ramp:
        b = scene.value("nonlinearity", "1 / electron")
        of_charge, of_signal = (
            b * (effect.name in applied) for effect in (ramp_nonlinearity.EFFECT, ramp_nonlinearity.SIGNAL)
        )
        signal = ramp.signal_at_full_well(scene, of_charge, of_signal)
    if nonlinearity.EFFECT.name in applied:
        curve = nonlinearity.parameters(scene)
        n_amplifiers = max(np.size(number) for number in (*curve, remaining))
        signal = nonlinearity.apply(np.array(np.broadcast_to(np.maximum(remaining, 0.0), n_amplifiers)), *curve)
        signal = signal if n_amplifiers > 1 else float(signal[0])
    noises = (
        bias_structure.EFFECT, bias_structure.DRIFT, bias_structure.ROW_NOISE, read_noise.EFFECT, ramp_noise.EFFECT,
        ramp_noise.DRIFT,
    )  # fmt: skip
    signal = signal - _NOISE_SIGMAS * sum(effect.contribution(scene) for effect in noises if effect.name in applied)
    level = signal / scene.amplifier_values("gain", "electron / adu") + scene.amplifier_values("bias", "adu")
    rounded = np.floor(np.clip(level, 0.0, scene.amplifier_values("adc_max", "adu")))
    return np.asarray(rounded) if np.ndim(rounded) else float(rounded)


def _effect_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards EFFECTn and EFKEYn, which describe the effects of the image in the order of their application.

    EFFECTn has the name of effect number n, whether it was applied, and its margin: its largest contribution to a pixel
    divided by the smallest noticeable one. EFKEYn has the key of its random numbers, if the effect was applied.
    """
    cards: list[Card] = []
    exposed = rendered.exposure
    where = f"exposure {exposed.exposure_id}"
    effects_by_name = {e.name: e for e in find_effects(exposed.channel, exposed.image_type, where)}
    for number, decision in enumerate(rendered.decisions, start=1):
        state = ("on" if decision.applied else "off") + (" (forced)" if decision.forced else "")
        cards.append((f"EFFECT{number}", f"{decision.name}: {state}, margin {decision.margin:.3g}", "on if margin>1"))
        if decision.applied and decision.name in effects_by_name:
            numbers = random_identity(
                effects_by_name[decision.name], exposed, rendered.detector.name, rendered.seed, rendered.noise_seed
            )
            cards.append((f"EFKEY{number}", rng.key_hex(*numbers), "random-number key of the effect"))
    return tuple(cards)
