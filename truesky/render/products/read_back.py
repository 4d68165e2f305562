"""Read the pixels and the FITS header of a detector from its image file and its head file.

The head file lies next to the image and has the true WCS as text; the header of a raw image has a pointing error.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.store import read as versions
from truesky.render.camera import astrometry, tpv
from truesky.render.camera.sections import Section
from truesky.render.channels import registry
from truesky.render.channels.readout import ReadoutMode
from truesky.render.products import head_files, raw_pointing

# Keyword of the card that tells which part of an array contains the pixels of the detector. The card is present if the
# array also has prescan or overscan around them.
_DATA = "DATASEC"
# Keyword of the card with the number of amplifiers in an array. If prescan and overscan lie between their pixels, the
# array has this card but no card DATASEC, and its WCS is that of the pixels without prescan and overscan.
_AMPLIFIERS = "NAMPS"


def image_file(version: versions.Version, path: str) -> Path:
    """Return the path of an image of a lake, next to its head file, after comparing the sha256 of both.

    Parameters
    ----------
    version : Version
        Version of the table `products`.
    path : str
        Path of the image in the folder of the version.

    Returns
    -------
    Path
        The image file, an argument of the other functions. On object storage, it is a copy.

    Raises
    ------
    BadInput
        If the version has no such file.
    Damaged
        If one of both files is missing or damaged.
    """
    head = head_files.head_path(path)
    return version.sidecar_paths([path, head] if head != path and version.has_file(head) else [path])[0]


def frame(path: Path) -> images.Image:
    """Return the pixels of a detector as stored, without prescan and overscan.

    Parameters
    ----------
    path : Path
        The image file.

    Returns
    -------
    Image
        The pixels, shape (ny, nx), and the header with the true WCS of these pixels.

    Raises
    ------
    BadInput
        If the file has several arrays, prescan or overscan, and its card CHANNEL is not the name of a channel.
    """
    read = images.read_images(path)
    if read[0].data is not None and not {_DATA, _AMPLIFIERS} & _header(read).keys():
        return images.Image(read[0].data, with_true_wcs(path, read[0].cards))
    return images.Image(_readout_mode(path, read).read_pixels(read), _trim_header(with_true_wcs(path, read[0].cards)))


def header(path: Path) -> tuple[images.Card, ...]:
    """Return the primary header of an image for its pixels without prescan and overscan.

    Parameters
    ----------
    path : Path
        The image file.

    Returns
    -------
    tuple of Card
        The cards, with the true WCS of these pixels.
    """
    return _trim_header(with_true_wcs(path, images.read_images(path)[0].cards))


def electrons(path: Path) -> images.Image:
    """Return the pixels of a detector in electrons, without prescan and overscan.

    The bias of a science image is subtracted.

    Parameters
    ----------
    path : Path
        The image file.

    Returns
    -------
    Image
        The pixels, float64 with shape (ny, nx), and the header with their true WCS.

    Raises
    ------
    BadInput
        If the file is a truth map without a unit, such as that of saturated pixels, or if the card CHANNEL of a science
        image is unknown.
    """
    read = images.read_images(path)
    unit = _header(read).get("BUNIT")
    if unit == "electron":
        return images.Image(np.asarray(read[0].data, float), with_true_wcs(path, read[0].cards))
    if unit == "":
        raise BadInput(f"{path}: the pixels must have a unit to convert them to electrons, but BUNIT is empty")
    return images.Image(
        _readout_mode(path, read).read_electrons(read), _trim_header(with_true_wcs(path, read[0].cards))
    )


def with_true_wcs(path: Path, cards: Sequence[images.Card]) -> tuple[images.Card, ...]:
    """Return the cards of an image header with the true WCS instead of the one with the pointing error of a raw image.

    The true WCS is that of the first image in the head file next to `path`. Its distortion is given as TPV, not SIP.
    CRPIX is kept, RA and DEC become CRVAL of the true WCS, and the cards of the pointing error (CSYER1, CSYER2) are
    removed.

    Parameters
    ----------
    path : Path
        The image file of a detector.
    cards : sequence of Card
        Cards of its first image.

    Returns
    -------
    tuple of Card
        The cards. They are unchanged if the header has no pointing error or there is no head file.
    """
    if all(key not in raw_pointing.ERRORS for key, *_ in cards):
        return tuple(cards)
    # The first image of the head file may be an amplifier with columns or rows in the order of its readout.
    first_cards = astrometry.follow_axes(head_files.first_cards(path), cards)
    true = {card[0]: card for card in first_cards if not card[0].startswith("CRPIX")}
    if not true:
        return tuple(cards)
    boresight = {"RA": true["CRVAL1"][1], "DEC": true["CRVAL2"][1]}
    other_cards = [
        (key, boresight.get(key, value), text)
        for key, value, text in cards
        if key.startswith("CRPIX") or not (head_files.is_wcs(key) or tpv.is_sip(key) or key in raw_pointing.ERRORS)
    ]
    return (*other_cards, *true.values())


def _trim_header(cards: Sequence[images.Card]) -> tuple[images.Card, ...]:
    """Return the header for an array from which prescan and overscan have been cut off.

    CRPIX then counts from the first remaining pixel. The card DATASEC, which has the rectangle of the remaining pixels,
    is removed; without it the cards are unchanged.
    """
    section = next((str(value) for key, value, _ in cards if key == _DATA), None)
    if section is None:
        return tuple(cards)
    data = Section.from_text(section)
    offsets = {"CRPIX1": data.x, "CRPIX2": data.y}
    return tuple(
        (key, float(value) - offsets[key], text) if key in offsets else (key, value, text)
        for key, value, text in cards
        if key != _DATA
    )


def _readout_mode(path: Path, read: Sequence[images.Image]) -> ReadoutMode:
    name = str(_header(read).get("CHANNEL"))
    if name not in registry.CHANNELS:
        raise BadInput(f"{path}: CHANNEL must be one of {', '.join(registry.CHANNELS)}, got {name!r}")
    return registry.CHANNELS[name].readout


def _header(read: Sequence[images.Image]) -> dict[str, Any]:
    return {keyword: value for keyword, value, _ in read[0].cards}
