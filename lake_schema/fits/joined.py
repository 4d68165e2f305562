"""Join FITS files of images (the detectors of an exposure, for example); common cards move to the first header."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lake_schema.errors import BadInput
from lake_schema.fits import images, write
from lake_schema.fits.images import STRUCTURE, Card, Image

# Names of extensions that count as no name; astropy gives the second one to a compressed image.
_DEFAULT_NAMES = ("", "COMPRESSED_IMAGE")

_INHERIT: tuple[Card, ...] = (("INHERIT", True, "primary header also applies"),)


# Function that returns further cards of an extension from its name and from the values of its header.
ArrayCards = Callable[[str, Mapping[str, Any]], Sequence[Card]]


# Function that returns the image that is stored instead of a given one.
ArrayChange = Callable[[Image], Image]


def no_cards(name: str, header: Mapping[str, Any]) -> Sequence[Card]:
    """Return no cards for any extension."""
    return ()


@dataclass(frozen=True, slots=True)
class _Keywords:
    """Keywords of cards that move to the primary header, and among them the keywords that also stay in extensions."""

    common: set[str]
    repeated: set[str]


def join(
    path: Path,
    files: Sequence[tuple[str, Path]],
    shared_keywords: Sequence[str],
    extra_cards: Sequence[Card],
    kept_keywords: Sequence[str] = (),
    array_cards: ArrayCards = no_cards,
    changes: Mapping[str, ArrayChange] | None = None,
) -> None:
    """Write the images of several FITS files as extensions to one file, which replaces `path` in one rename.

    Parameters
    ----------
    path : Path
        The new file. It begins with a primary header without data.
    files : sequence of (str, Path)
        Names and paths of files that `write_images` wrote. In the new file, the name of an extension (EXTNAME) begins
        with the name of its file.
    shared_keywords : sequence of str
        Keywords of the cards that move to the primary header if they are equal in all files.
    extra_cards : sequence of Card
        Further cards of the primary header.
    kept_keywords : sequence of str, optional
        Those of `shared_keywords` that also stay in the headers of the extensions.
    array_cards : callable, optional
        Function of the name of an extension and of the values in its header and in the primary header, which returns
        further cards of the extension. Cards with keywords that its header has are left out.
    changes : mapping of str to callable, optional
        Functions of an image, by the name of a file: the images of these files are replaced by the results, before
        `array_cards` is called. A compressed image is compressed again.

    Raises
    ------
    BadInput
        If there are no files.

    Notes
    -----
    The other cards of a file's first header are copied to the header of each of its images, unless the image has a card
    with this keyword. Only the images of one file are in memory at a time.
    """
    if not files:
        raise BadInput(f"{path}: there are no files to join")
    first_cards = [_first_cards(file) for _, file in files]
    common = [
        card
        for key, card in first_cards[0].items()
        if key in shared_keywords and all(cards.get(key) == card for cards in first_cards)
    ]
    keywords = _Keywords({card[0] for card in common}, set(kept_keywords))
    cards = [*common, *(card for card in extra_cards if card[0] not in keywords.common)]
    write.write_one_by_one(path, _joined_hdus(files, cards, keywords, array_cards, changes or {}))


def array_sizes(file: Path) -> list[tuple[int, int]]:
    """Return the numbers of columns and rows of each image in a file that `write_images` wrote, from its headers."""
    with write.open_written(file) as hdus:
        prefixes = ((hdu.header, "Z" * write.is_compressed(hdu)) for hdu in _arrays(hdus))
        return [(header[f"{prefix}NAXIS1"], header[f"{prefix}NAXIS2"]) for header, prefix in prefixes]


def _joined_hdus(
    files: Sequence[tuple[str, Path]],
    cards: Sequence[Card],
    keywords: _Keywords,
    array_cards: ArrayCards,
    changes: Mapping[str, ArrayChange],
) -> Iterator[Any]:

    yield images.primary_hdu(Image(None, tuple(cards)))
    common_values = {card[0]: card[1] for card in cards if card[0] in keywords.common}
    for name, file in files:
        with write.open_written(file) as hdus:
            first_hdu = hdus[0]
            arrays = _changed_arrays(file, changes[name]) if name in changes else _arrays(hdus)
            for hdu in arrays:
                make_extension = _compressed_extension if write.is_compressed(hdu) else _image_extension
                extension = make_extension(hdu, name, keywords.common, keywords.repeated, first_hdu)
                header_values = ChainMap(extension.header, common_values)
                for card in array_cards(extension.header["EXTNAME"], header_values):
                    if card[0] not in extension.header:
                        extension.header.append(card, end=True)
                yield extension


def _arrays(hdus: Iterable[Any]) -> list[Any]:
    return [hdu for hdu in hdus if write.is_compressed(hdu) or hdu.header["NAXIS"]]


def _changed_arrays(file: Path, change: ArrayChange) -> Iterator[Any]:
    """Yield the arrays of a file after a change, compressed as in the file."""
    with write.open_written(file) as hdus:
        are_compressed = [write.is_compressed(hdu) for hdu in _arrays(hdus)]
    arrays = [image for image in images.read_images(file) if image.data is not None]
    for is_compressed, image in zip(are_compressed, arrays, strict=True):
        yield (images.compressed_hdu if is_compressed else images.image_hdu)(change(image))


def _image_extension(hdu: Any, name: str, common_keywords: set[str], kept_keywords: set[str], first_hdu: Any) -> Any:
    image = images.image_from_hdu(hdu)
    array_cards = tuple(card for card in image.cards if card[0] not in common_keywords - kept_keywords)
    cards = (
        *_INHERIT * ("INHERIT" not in hdu.header),
        *_cards_except(first_hdu, {*common_keywords, *hdu.header}),
        *array_cards,
    )
    return images.image_hdu(Image(image.data, cards, _extension_name(image.name, name)))


def _compressed_extension(
    hdu: Any, name: str, common_keywords: set[str], kept_keywords: set[str], first_hdu: Any
) -> Any:
    """Return the table in which a compressed image is stored, with the name and cards that it has in the joined file.

    The rows of the table are not changed, so the image is not decompressed.
    """
    for key in (common_keywords - kept_keywords) & set(hdu.header):
        del hdu.header[key]
    for card in (*_INHERIT * ("INHERIT" not in hdu.header), *_cards_except(first_hdu, {*common_keywords, *hdu.header})):
        hdu.header.append(card, end=True)
    hdu.header["EXTNAME"] = _extension_name(hdu.header.get("EXTNAME", ""), name)
    return hdu


def _extension_name(array_name: str, file_name: str) -> str:
    """Return the EXTNAME of an image in the joined file: FILE, or FILE.NAME if the image has a name.

    A name that already begins with the name of the file is not changed.
    """
    return (
        file_name
        if array_name in _DEFAULT_NAMES
        else array_name
        if array_name.startswith(file_name)
        else f"{file_name}.{array_name}"
    )


def _first_cards(file: Path) -> dict[str, Card]:
    """Return the cards, by keyword, of the header that describes a whole file, without structural cards.

    This is usually the primary header. If it has structural cards only and the first image is compressed, it is the
    header of the first image.
    """

    with write.open_written(file) as hdus:
        skip_primary = len(hdus) > 1 and write.is_compressed(hdus[1]) and not _cards_except(hdus[0], set())
        return {card[0]: card for card in _cards_except(hdus[int(skip_primary)], set())}


def _cards_except(hdu: Any, excluded_keywords: set[str]) -> list[Card]:
    return [
        (card.keyword, card.value, card.comment)
        for card in hdu.header.cards
        if card.keyword not in STRUCTURE and card.keyword not in excluded_keywords
    ]
