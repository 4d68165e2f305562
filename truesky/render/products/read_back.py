"""A file of a detector -> pixels.

placed     cards of a file's first header, with its true place on the sky
frame      a science file or a truth map -> the detector's pixels in one piece, as stored
electrons  the same in electrons, the bias of a science file subtracted
header     cards of the header that holds for the whole
"""

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

# Where in an array the detector's pixels are, if there is more in it.
_DATA = "DATASEC"


def frame(path: Path) -> images.Image:
    """A file's pixels [ny, nx], of a science file without pre- and overscan, with the header of the whole."""
    read = images.read_images(path)
    if read[0].data is not None and _DATA not in _header(read):
        return images.Image(read[0].data, with_true_wcs(path, read[0].cards))
    return images.Image(_readout_mode(path, read).read_pixels(read), _trim_header(with_true_wcs(path, read[0].cards)))


def header(path: Path) -> tuple[images.Card, ...]:
    """Cards of a file's first header, with the place on the sky of the detector's pixels."""
    return _trim_header(with_true_wcs(path, images.read_images(path)[0].cards))


def electrons(path: Path) -> images.Image:
    """A file's pixels [ny, nx], float64 e-: of a science file above the level of each amplifier.

    Errors : BadInput for a map of what has no electrons, such as of saturated pixels
    """
    read = images.read_images(path)
    unit = _header(read).get("BUNIT")
    if unit == "electron":
        return images.Image(np.asarray(read[0].data, float), with_true_wcs(path, read[0].cards))
    if unit == "":
        raise BadInput(f"{path}: its pixels have no unit: they are not electrons")
    return images.Image(
        _readout_mode(path, read).read_electrons(read), _trim_header(with_true_wcs(path, read[0].cards))
    )


def with_true_wcs(path: Path, cards: Sequence[images.Card]) -> tuple[images.Card, ...]:
    """Cards of a raw file's header; where that is not sure of its place, with the true one, from its head file."""
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
    """Header of the pixels alone: their WCS counts from the first of them."""
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
        raise BadInput(f"{path}: CHANNEL {name!r} is not one of {', '.join(registry.CHANNELS)}")
    return registry.CHANNELS[name].readout


def _header(read: Sequence[images.Image]) -> dict[str, Any]:
    return {keyword: value for keyword, value, _ in read[0].cards}
