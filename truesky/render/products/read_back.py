"""Read the pixels and the header of a detector from its files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.fits import images
from truesky.render.camera import tpv
from truesky.render.camera.sections import Section
from truesky.render.channels import registry
from truesky.render.channels.readout import ReadoutMode
from truesky.render.products import head_files, raw_pointing

# Keyword of the section with the pixels of the detector, if the array also contains prescan or overscan.
_DATA = "DATASEC"


def frame(path: Path) -> images.Image:
    """Return the pixels, shape (ny, nx), as stored, without prescan and overscan, and the header of the detector."""
    read = images.read_images(path)
    if read[0].data is not None and _DATA not in _header(read):
        return images.Image(read[0].data, with_true_wcs(path, read[0].cards))
    return images.Image(_readout_mode(path, read).read_pixels(read), _trim_header(with_true_wcs(path, read[0].cards)))


def header(path: Path) -> tuple[images.Card, ...]:
    """Return the cards of the primary header, with the WCS of the pixels of the detector."""
    return _trim_header(with_true_wcs(path, images.read_images(path)[0].cards))


def electrons(path: Path) -> images.Image:
    """Return the pixels, shape (ny, nx), in electrons as float64; the bias of a science file is subtracted.

    Raises BadInput for a map without unit, such as that of saturated pixels.
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
    """Return the cards of a header; the true WCS of the head file replaces the WCS of a raw header."""
    if all(key not in raw_pointing.ERRORS for key, *_ in cards):
        return tuple(cards)
    true = {card[0]: card for card in head_files.first_cards(path) if not card[0].startswith("CRPIX")}
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
    """Return the header of the pixels without prescan and overscan; CRPIX counts from the first of these pixels."""
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
