"""Draw images of many places on the sky, in several processes."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.errors import BadInput, refuse_mistakes
from lake_schema.texts import spelling, synonyms
from truesky.api import image_options, sky_images
from truesky.api.image_options import ImageOptions, ImageRequest
from truesky.api.sky_images import PainterTables, SkyImage, SkyPainter
from truesky.catalogue import injected_rows
from truesky.request import sky_notation

# Columns of a table of places that may be missing, and all that are used.
_OPTIONAL = ("size", "exposure", "seed", "date")
_COLUMNS = ("ra", "dec", *_OPTIONAL)
# Largest number of images that a process draws before it sends them, and their largest number of pixels together.
_MAX_BATCH, _BATCH_PIXELS = 8, 4e6
# Time without work after which a process ends, s.
_IDLE_S = 60
# Floating-point numbers from this one on do not contain every whole number.
_MAX_EXACT = 2.0**53
# Environment of the processes. loky restarts a process whose memory grows by more than a limit; ours keep rows and PSFs
# of a limited size.
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LOKY_MAX_MEMORY_LEAK_SIZE": "1e12"}
_Drawn = tuple[list[SkyImage], BadInput | None]


def read_places(table: Any, size: float, band: str, options: ImageOptions) -> list[ImageRequest]:
    """Return the checked requests for the images of all rows of a table of places.

    Parameters
    ----------
    table : table, str, Path or mapping
        Places, as in `Lake.stamps`.
    size : float
        Side of the images without a column `size`, arcsec.
    band : str
        Name of the passband.
    options : ImageOptions
        The other arguments, for all images.

    Returns
    -------
    list of ImageRequest
        One per row.

    Raises
    ------
    BadInput
        If `ra` or `dec` is missing, the name of a column is misspelt, or a value is not valid. The message names the
        table or its file, and the row, from 1.
    """
    titles: list[str] = []

    def is_used(title: str) -> bool:
        titles.append(title)
        return title in _COLUMNS

    place, columns = injected_rows.table_columns(table, "table", is_used)
    _check_titles(place, titles)
    base = image_options.check_request((0.0, 0.0), size, band, options, "stamps")
    requests = []
    for row in range(len(columns["ra"])):
        values = {name: float(column[row]) for name, column in columns.items() if not np.isnan(column[row])}
        title = f"{place}, row {row + 1}"
        try:
            requests.append(_with_place(replace(base, title=title), values))
        except BadInput as error:
            raise error.with_prefix(title) from None
    return requests


def _check_titles(place: Path, titles: Sequence[str]) -> None:
    """Raise BadInput if `ra` or `dec` is not among the titles of a table, or another title is nearly one of ours."""
    missing = [name for name in ("ra", "dec") if name not in titles]
    unused = [title for title in titles if title not in _COLUMNS]
    mistakes = []
    if missing:
        similar = [title for title in unused if title.lower() in missing or _meant(title, missing)]
        it = "them" if len(similar) > 1 else "it"
        remedy = f"; did you mean {', '.join(similar)}? Rename {it}" if similar else ""
        mistakes.append(f"{place}: has no column{'s' if len(missing) > 1 else ''} {', '.join(missing)}{remedy}")
    for title in unused:
        if meant := spelling.closest_names(title, _OPTIONAL, 1):
            mistakes.append(f"{place}: column {title!r}: did you mean {meant[0]}? Other names are ignored")
    refuse_mistakes(mistakes)


def _meant(title: str, missing: Sequence[str]) -> list[str]:
    return synonyms.find_columns(title, ("stars",), missing)


def _with_place(base: ImageRequest, values: Mapping[str, float]) -> ImageRequest:
    """Return a request with the values of a row of the table, by name; missing values are taken from `base`."""
    for name in ("ra", "dec"):
        if name not in values:
            raise BadInput(f"{name} is missing")
    ra, dec = image_options.check_place(values["ra"], values["dec"])
    size = image_options.check_size(values.get("size", base.size))
    exposure, seed = (
        image_options.check_count(name, _whole(name, values[name])) if name in values else given
        for name, given in (("exposure", base.exposure), ("seed", base.noise_seed))
    )
    mjd = sky_notation.mjd(values["date"], "date") if "date" in values else base.mjd
    return replace(base, ra=ra, dec=dec, size=size, exposure=exposure, noise_seed=seed, mjd=mjd)


def _whole(name: str, value: float) -> int:
    if value != round(value, 0):
        raise BadInput(f"{name} = {value:g}: must be a whole number")
    if abs(value) >= _MAX_EXACT:
        raise BadInput(f"{name} = {value:g}: must be below 2^53 = 9.0e15 in a table")
    return int(value)


def check_places(painter: SkyPainter, requests: Sequence[ImageRequest]) -> None:
    """Raise BadInput if a place is outside the catalogue, or if the options of the first image are not valid.

    The message names the row of the table, from 1. A place near the edge of the catalogue is refused later.
    """
    ra, dec = (np.array([getattr(request, name) for request in requests]) for name in ("ra", "dec"))
    for row in np.flatnonzero(~painter.covers(ra, dec))[:1].tolist():
        raise painter.outside_area(ra[row], dec[row]).with_prefix(requests[row].title)
    for request in requests[:1]:
        painter.check(request)


def draw_all(painter: SkyPainter, requests: Sequence[ImageRequest], processes: int) -> Iterator[SkyImage]:
    """Draw images in several processes.

    Parameters
    ----------
    painter : SkyPainter
        The painter of the lake in this process.
    requests : sequence of ImageRequest
        What to draw.
    processes : int
        Number of processes. With 1, the images are drawn in this process.

    Yields
    ------
    SkyImage
        The images, in the order of the requests.

    Raises
    ------
    BadInput
        If an image cannot be drawn; the message names the row of the table, from 1. Also if a process is killed.
    """
    batch_size = _batch_size(painter, requests, processes)
    if processes == 1:
        for request in requests:
            yield _draw(painter, request)
        return
    # The processes of this library do not import the user's script, so that scripts and notebooks need no guard.
    import loky
    from loky.process_executor import TerminatedWorkerError

    batches = [requests[first : first + batch_size] for first in range(0, len(requests), batch_size)]
    executor = loky.ProcessPoolExecutor(min(processes, max(len(batches), 1)), timeout=_IDLE_S, env=_ENVIRONMENT)
    try:
        waiting: deque[Future[_Drawn]] = deque()
        for batch in batches:
            waiting.append(executor.submit(_draw_batch, painter.source, batch))
            if len(waiting) > processes:
                yield from _results(painter, waiting.popleft())
        while waiting:
            yield from _results(painter, waiting.popleft())
    except TerminatedWorkerError:
        raise BadInput("stamps: a process was killed, perhaps for lack of memory; use fewer processes") from None
    finally:
        executor.shutdown(wait=True, kill_workers=True)


def _batch_size(painter: SkyPainter, requests: Sequence[ImageRequest], processes: int) -> int:
    """Return the number of images that a process draws before it sends them.

    There are at least four batches per process, and a batch has at most about _BATCH_PIXELS pixels.
    """
    if not requests:
        return 1
    largest = max(requests, key=lambda request: request.size)
    aim, _ = painter.aim(largest)
    pixels = max((largest.size / aim.detector.pixel_scale) ** 2, 1.0)
    return int(np.clip(min(len(requests) / (4 * processes), _BATCH_PIXELS / pixels), 1, _MAX_BATCH))


def _results(painter: SkyPainter, task: Future[_Drawn]) -> Iterator[SkyImage]:
    """Yield the images that a process has drawn, and then raise its error if there is one."""
    images, error = task.result()
    for image in images:
        yield image.attach(painter)
    if error is not None:
        raise error


def _draw_batch(tables: PainterTables, batch: Sequence[ImageRequest]) -> _Drawn:
    """Return the images of a batch before the first error, and the error."""
    painter, images = sky_images.shared_painter(tables), []
    for request in batch:
        try:
            images.append(_draw(painter, request))
        except BadInput as error:
            return images, error
    return images, None


def _draw(painter: SkyPainter, request: ImageRequest) -> SkyImage:
    try:
        return painter.draw(request)
    except BadInput as error:
        raise error.with_prefix(request.title) from None
