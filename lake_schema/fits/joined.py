"""Several files of images -> one, whose header says what they have in common.

join   files of `write_images` -> one file; their arrays as they are
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.fits import images, write
from lake_schema.fits.images import STRUCTURE, Card, Image

# What astropy calls a packed image that has no name.
_NAMELESS = ("", "COMPRESSED_IMAGE")

_INHERIT: tuple[Card, ...] = (("INHERIT", True, "the first header of the file holds, too"),)


def join(
    path: Path,
    files: Sequence[tuple[str, Path]],
    shared: Sequence[str],
    more: Sequence[Card],
    in_each: Sequence[str] = (),
) -> None:
    """Write a file of all the files' arrays, one file after the other; replaces `path` in one rename.

    path   : of the file, which begins with a header alone
    files  : each with a name, with which those of its arrays begin;  shared : keywords that are of all files
    more   : cards of the first header, after the shared ones
    in_each : keywords that arrays which have them keep, though they are shared
    Cards of a file that are not shared, or differ, go to each of its arrays, unless that has its own. Of the arrays
    one file's at a time are in memory.
    """
    if not files:
        raise BadInput(f"{path}: there is nothing to join")
    every = [_first_cards(file) for _, file in files]
    common = [card for key, card in every[0].items() if key in shared and all(one.get(key) == card for one in every)]
    write.write_one_by_one(path, _units(files, [*common, *more], {card[0] for card in common}, set(in_each)))


def _units(files: Sequence[tuple[str, Path]], cards: Sequence[Card], common: set[str], kept: set[str]) -> Iterator[Any]:
    yield images.primary(Image(None, tuple(cards)))
    for name, file in files:
        with write.refusing(file), fits.open(file, memmap=False, disable_image_compression=True) as units:
            first = units[0]
            for unit in units:
                if write.is_packed(unit):
                    yield _packed(unit, name, common, kept, first)
                elif unit.header["NAXIS"]:
                    yield _plain(unit, name, common, kept, first)


def _plain(unit: Any, name: str, common: set[str], kept: set[str], first: Any) -> Any:
    image = images.image_of(unit)
    own = tuple(card for card in image.cards if card[0] not in common - kept)
    cards = (*_INHERIT * ("INHERIT" not in unit.header), *_cards_of(first, {*common, *unit.header}), *own)
    return images.extension(Image(image.data, cards, _name(image.name, name)))


def _packed(unit: Any, name: str, common: set[str], kept: set[str], first: Any) -> Any:
    """The table that it is stored as: its rows are not touched."""
    for key in (common - kept) & set(unit.header):
        del unit.header[key]
    for card in (*_INHERIT * ("INHERIT" not in unit.header), *_cards_of(first, {*common, *unit.header})):
        unit.header.append(card, end=True)
    unit.header["EXTNAME"] = _name(unit.header.get("EXTNAME", ""), name)
    return unit


def _name(own: str, file: str) -> str:
    """Of an array: its file's, and its own where it has one."""
    return file if own in _NAMELESS else own if own.startswith(file) else f"{file}.{own}"


def _first_cards(file: Path) -> dict[str, Card]:
    """Of the header that holds for all of a file: the first that says anything."""
    with write.refusing(file), fits.open(file, memmap=False, disable_image_compression=True) as units:
        hollow = len(units) > 1 and write.is_packed(units[1]) and not _cards_of(units[0], set())
        return {card[0]: card for card in _cards_of(units[int(hollow)], set())}


def _cards_of(unit: Any, without: set[str]) -> list[Card]:
    return [
        (card.keyword, card.value, card.comment)
        for card in unit.header.cards
        if card.keyword not in STRUCTURE and card.keyword not in without
    ]
