"""Write the science image and the truth maps of a detector to FITS files, and make their rows of the table `products`.

If a detector has one array, its file has a single image. If it has several (such as one per amplifier), they are
extensions of a file whose primary header has no data and applies to every extension.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pyarrow as pa

from lake_schema.fits.images import Card, Image, write_images
from lake_schema.tables.products import PRODUCTS
from truesky.render.camera import astrometry, observatories, tpv
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.products import camera_cards, head_files, headers, raw_pointing

# Function that writes a file to the given path.
Writer = Callable[[Path], None]


def products(
    rendered: RenderedDetector, truth: Sequence[str] = ("noise_free",), rice: bool = False, wcs: str | None = None
) -> tuple[pa.Table, dict[str, Writer]]:
    """Return the rows of the table `products` for a detector, and functions that write its files.

    Parameters
    ----------
    rendered : RenderedDetector
        The rendered detector.
    truth : sequence of str
        Names of the requested truth maps; maps that the detector does not have are left out.
    rice : bool
        True to compress integer images with the Rice algorithm.
    wcs : str, optional
        Convention for the optical distortion in headers, one of `tpv.CONVENTIONS`; None means that of the instrument's
        pipeline.

    Returns
    -------
    rows : pyarrow.Table
        One row per image: the science image and each truth map.
    writers : dict of str to callable
        Function that writes each file to a given path, by path relative to the folder of the table `products`. Each
        two-dimensional image with a WCS also has a head file, a text with its true WCS.
    """
    images = {"science": _science_images(rendered)}
    for content in truth:
        if content in rendered.maps:
            images[content] = [Image(rendered.maps[content], headers.truth_cards(rendered, content))]
    heads = {key: head_files.text(units) for key, units in images.items()}
    images["science"] = [replace(unit, cards=_with_raw_pointing(rendered, unit.cards)) for unit in images["science"]]
    if (wcs or observatories.for_camera(rendered.exposure.camera).convention) == "tpv":
        images = {
            key: [replace(unit, cards=tpv.from_sip(unit.cards)) for unit in units] for key, units in images.items()
        }
    exposure, detector = rendered.exposure, rendered.detector
    stem = f"images/{exposure.exposure_id:06d}/{exposure.channel}_{exposure.band}_{detector.name}"
    paths = {content: f"{stem}_{content}.fits" for content in images}
    ra, dec = astrometry.centre(detector, rendered.wcs)
    n = len(images)
    rows = PRODUCTS.build(
        {
            "path": list(paths.values()),
            "content": list(images),
            "exposure_id": [exposure.exposure_id] * n,
            "detector": [detector.name] * n,
            "channel": [exposure.channel] * n,
            "band": [exposure.band] * n,
            "ra": [ra] * n,
            "dec": [dec] * n,
            "s_region": [astrometry.s_region(detector, rendered.wcs)] * n,
            "mission": [rendered.scene.mission.fingerprint] * n,
            "sources": [len(rendered.sources)] * n,
        }
    )
    writers: dict[str, Writer] = {paths[content]: partial(_write, units, rice) for content, units in images.items()}
    for content, head_text in heads.items():
        if head_text:
            writers[head_files.head_path(paths[content])] = partial(head_files.write, [head_text])
    return rows, writers


def _with_raw_pointing(rendered: RenderedDetector, cards: tuple[Card, ...]) -> tuple[Card, ...]:
    return raw_pointing.cards(cards, rendered.exposure, rendered.detector, rendered.scene.mission, rendered.seed)


def _write(units: Sequence[Image], rice: bool, path: Path) -> None:
    write_images(path, units, rice)


def _science_images(rendered: RenderedDetector) -> list[Image]:
    """Return the images of the science file: a single one, or a primary header and one extension per array."""
    readout = rendered.readout
    cards = (*headers.science_cards(rendered), *camera_cards.cards(rendered), *readout.cards)
    if [extension.name for extension in readout.extensions] == [""]:
        (array,) = readout.extensions
        # If the primary header and the array have the same keyword, keep the card of the array: the pixel coordinates
        # in the WCS of the array count from its first column and row, including prescan and overscan.
        array_cards = (*array.cards, *headers.section_cards(rendered, array))
        array_keywords = {keyword for keyword, *_ in array_cards}
        own_cards = (*(card for card in cards if card[0] not in array_keywords), *array_cards)
        return [Image(array.data, own_cards, camera_cards.first_name(rendered))]
    arrays = [
        Image(extension.data, headers.array_cards(rendered, extension, cards), extension.name)
        for extension in readout.extensions
    ]
    return [Image(None, cards, camera_cards.first_name(rendered)), *arrays]
