"""Make the FITS cards that only raw images of certain ground cameras (DECam, LSSTCam) have, for their pipelines.

References
----------
NOAO Data Handbook 2.2 (DECam); LSE-400 (LSSTCam: header service)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from lake_schema.fits.images import Card
from truesky.render.camera import detectors, sections
from truesky.render.camera.amplifiers import Amplifier
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.products import headers

# Values of the keyword OBSTYPE with which DECam names the image types of truesky.
_OBSTYPES = {"science": "object", "deep": "object", "flat": "dome flat", "dark": "dark", "bias": "zero"}


def cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards that raw images of the detector's camera have in addition to the cards of every camera.

    The result is () for all cameras but DECam and LSSTCam.
    """
    make_cards = _CARDS_BY_CAMERA.get(rendered.exposure.camera)
    return make_cards(rendered) if make_cards else ()


def _decam(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards of a DECam CCD, and of its amplifiers A and B, whose letters are the ends of keywords."""
    exposure = rendered.exposure
    return (
        ("OBSTYPE", _OBSTYPES[exposure.image_type], "type of observation"),
        ("PROCTYPE", "RAW", "data processing level"),
        ("PRODTYPE", "image", "data product"),
        ("EXPNUM", exposure.exposure_id, "exposure number"),
        ("CCDNUM", _detector_number(rendered) + 1, "CCD number"),
        ("DETPOS", rendered.detector.name, "position of the CCD in the focal plane"),
        ("CCDSUM", "1 1", "binning along columns and rows"),
        *_amplifier_cards(rendered),
    )


def _lsstcam(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return the cards of an LSSTCam sensor; ROTPA is the position angle to which the rotator turns the camera."""
    exposure, (raft, sensor) = rendered.exposure, rendered.detector.name.split("_")
    seconds = exposure.exposure_time_s
    return (
        ("OBSID", f"MC_S_{exposure.exposure_id:08d}", "observation identifier"),
        ("SEQNUM", exposure.exposure_id, "exposure identifier"),
        ("IMGTYPE", _IMAGE_TYPES[exposure.image_type], "type of observation"),
        ("CONTRLLR", "S", "controller (S: simulation)"),
        ("RAFTBAY", raft, "raft name"),
        ("CCDSLOT", sensor, "sensor position in the raft"),
        ("CHIPID", rendered.detector.name, "names of raft and sensor"),
        ("DETNUM", _detector_number(rendered), "sensor number, from 0"),
        (
            "LSST_NUM",
            f"{rendered.detector.kind.upper()}-{_detector_number(rendered):03d}",
            "manufacturer and number of the sensor",
        ),
        ("ROTPA", exposure.position_angle % 360.0, "[deg] position angle of y, north through east"),
        ("ROTCOORD", "sky", "reference of ROTPA"),
        ("RASTART", exposure.ra, "[deg] boresight RA at exposure start"),
        ("DECSTART", exposure.dec, "[deg] boresight Dec at exposure start"),
        *((("AMSTART", exposure.airmass, "airmass at exposure start"),) if exposure.airmass is not None else ()),
        ("SHUTTIME", seconds, "[s] shutter open time"),
        ("DARKTIME", seconds, "[s] time from clearing to readout"),
        *_file_name(rendered),
    )


def _file_name(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return card FILENAME with the name that the simulator imSim 0.6 would give to the file of an LSSTCam sensor.

    The result is () for a file with all amplifiers in one array in ADU, a format that imSim does not have.
    """
    exposure, arrays = rendered.exposure, rendered.readout.extensions
    kind = "eimage" if arrays[0].unit == "electron" else "amp" if len(arrays) > 1 else ""
    if not kind:
        return ()
    band = exposure.band.rpartition("_")[2]
    name = (
        f"{kind}_{exposure.exposure_id:08d}-0-{band}-{rendered.detector.name}-det{_detector_number(rendered):03d}.fits"
    )
    return (("FILENAME", name, "imSim file name"),)


# Values of the keyword IMGTYPE with which LSSTCam names the image types of truesky.
_IMAGE_TYPES = {"science": "SKYEXP", "deep": "SKYEXP", "flat": "FLAT", "dark": "DARK", "bias": "BIAS"}
# Functions that make the FITS cards that only certain cameras have, by name of the camera.
_CARDS_BY_CAMERA: Mapping[str, Callable[[RenderedDetector], tuple[Card, ...]]] = {"decam": _decam, "lsstcam": _lsstcam}


def _detector_number(rendered: RenderedDetector) -> int:
    """Return the index, from 0, of a detector in the list of the detectors of its camera."""
    all_detectors = detectors.detectors(rendered.exposure.camera, rendered.scene.mission)
    return [detector.name for detector in all_detectors].index(rendered.detector.name)


def _amplifier_cards(rendered: RenderedDetector) -> tuple[Card, ...]:
    """Return cards with sections, gain and noise of each amplifier of a DECam CCD.

    They are the cards that DECam has in addition to the amplifier cards of all ground cameras. The result is () unless
    all amplifiers are in one array in ADU.
    """
    layout, arrays = rendered.scene.layout, rendered.readout.extensions
    if layout is None or len(arrays) > 1 or arrays[0].unit != "adu":
        return ()
    all_detectors = detectors.detectors(rendered.exposure.camera, rendered.scene.mission)
    numbers = {key: value for key, value, _ in headers.amplifier_values(rendered)}
    letter_cards: list[Card] = []
    for number, amplifier in enumerate(layout.amplifiers):
        letter, pixels = amplifier.name, layout.amplifier_data_section(number)
        place = sections.to_mosaic_section(rendered.detector, amplifier.pixels, all_detectors)
        letter_cards += [
            (f"AMPSEC{letter}", _readout_section(amplifier), "CCDSEC in readout order"),
            (f"TRIMSEC{letter}", pixels.text, f"pixels of amplifier {letter}"),
            (f"PRESEC{letter}", layout.amplifier_prescan_section(number).text, f"prescan of amplifier {letter}"),
            (
                f"POSTSEC{letter}",
                layout.amplifier_overscan_section(number).text,
                f"overscan rows of amplifier {letter}",
            ),
            *(((f"DETSEC{letter}", place, f"amplifier {letter} in the mosaic"),) if place else ()),
            *(
                (f"{key}{letter}", float(np.broadcast_to(numbers[name], len(layout.amplifiers))[number]), text)
                for key, name, text in _NUMBERS
            ),
        ]
    return tuple(letter_cards)


# Gain, read noise and saturation level in DECam headers: beginning of the keyword (the letter of the amplifier
# follows), keyword of the same quantity for other cameras, and comment of the card.
_NUMBERS = (
    ("GAIN", "GAIN", "[electron/adu] conversion gain"),
    ("RDNOISE", "RDNOISE", "[electron] rms read noise"),
    ("SATURAT", "SATURATE", "[adu] lowest level of a saturated pixel"),
)


def _readout_section(amplifier: Amplifier) -> str:
    """Return the rectangle of an amplifier's pixels on the detector as a FITS section, in the order of the readout.

    For example, "[2048:1025,1:4096]" is read from column 2048 down to column 1025.
    """
    (x, y), pixels = (axis + 1 for axis in (amplifier.pixels.x, amplifier.pixels.y)), amplifier.pixels
    columns, rows = (x, x + pixels.nx - 1), (y, y + pixels.ny - 1)
    columns = columns[::-1] if amplifier.read_right else columns
    rows = rows[::-1] if amplifier.read_top else rows
    return f"[{columns[0]}:{columns[1]},{rows[0]}:{rows[1]}]"
