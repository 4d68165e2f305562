"""Draw images of many places on the sky, in several processes."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from lake_schema.errors import BadInput
from truesky.api import sky_images
from truesky.api.sky_images import ImageOptions, ImageRequest, PainterSource, SkyImage, SkyPainter
from truesky.catalogue import injected_rows
from truesky.request import sky_notation
from truesky.request.toml_values import refuse_name

# Columns of a table of places, besides `ra` and `dec`.
_OPTIONAL = ("size", "exposure", "seed", "date")
# Number of images that a process draws before it returns them, and number of such batches that may wait per process.
_BATCH, _WAITING = 8, 3
# Time without work after which a process ends, s.
_IDLE_S = 60
_Batch = list[tuple[int, ImageRequest]]


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
        If a column is missing or unknown, or a value is not valid. The message names the row, from 1.
    """
    place, columns = injected_rows.table_columns(table, "table")
    for name in columns:
        if name not in ("ra", "dec", *_OPTIONAL):
            raise BadInput(f"{place}: column {refuse_name(name, ('ra', 'dec', *_OPTIONAL))}")
    if missing := [name for name in ("ra", "dec") if name not in columns]:
        raise BadInput(f"{place}: has no column {missing[0]}")
    base = sky_images.check_request((0.0, 0.0), size, band, options)
    requests = []
    for row in range(len(columns["ra"])):
        values = {name: float(column[row]) for name, column in columns.items() if np.isfinite(column[row])}
        try:
            requests.append(_with_place(base, values))
        except BadInput as error:
            raise BadInput(f"{place}, row {row + 1}: {error}") from None
    return requests


def _with_place(base: ImageRequest, values: Mapping[str, float]) -> ImageRequest:
    """Return a request with the values of a row of the table, by name; missing values are taken from `base`."""
    for name in ("ra", "dec"):
        if name not in values:
            raise BadInput(f"{name} is missing")
    ra, dec = sky_images.check_place(values["ra"], values["dec"])
    size = sky_images.check_size(values.get("size", base.size))
    exposure, seed = (
        sky_images.check_count(name, _whole(name, values[name])) if name in values else given
        for name, given in (("exposure", base.exposure), ("seed", base.noise_seed))
    )
    mjd = sky_notation.mjd(values["date"], "date") if "date" in values else base.mjd
    return replace(base, ra=ra, dec=dec, size=size, exposure=exposure, noise_seed=seed, mjd=mjd)


def _whole(name: str, value: float) -> int:
    if value != int(value):
        raise BadInput(f"{name} = {value:g}: must be a whole number")
    return int(value)


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
    numbered = list(enumerate(requests, 1))
    if processes == 1:
        for number, request in numbered:
            yield _draw(painter, number, request)
        return
    # The processes of this library do not import the user's script, so that scripts and notebooks need no guard.
    import loky
    from loky.process_executor import TerminatedWorkerError

    batches = [numbered[first : first + _BATCH] for first in range(0, len(numbered), _BATCH)]
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    executor = loky.ProcessPoolExecutor(min(processes, len(batches)), timeout=_IDLE_S, env=limits)
    try:
        waiting: deque[tuple[_Batch, Future[list[SkyImage]]]] = deque()
        for batch in batches:
            waiting.append((batch, executor.submit(_draw_batch, painter.source, batch)))
            if len(waiting) >= _WAITING * processes:
                yield from _results(painter, *waiting.popleft())
        while waiting:
            yield from _results(painter, *waiting.popleft())
    except TerminatedWorkerError:
        raise BadInput("stamps: a process was killed, perhaps for lack of memory; use fewer processes") from None
    finally:
        executor.shutdown(wait=True, kill_workers=True)


def _results(painter: SkyPainter, batch: _Batch, task: Future[list[SkyImage]]) -> Iterator[SkyImage]:
    for image, (_, request) in zip(task.result(), batch, strict=True):
        yield painter.attach_optics(image, request)


def _draw_batch(source: PainterSource, batch: _Batch) -> list[SkyImage]:
    painter = _painter(source)
    return [_draw(painter, number, request) for number, request in batch]


@lru_cache(maxsize=1)
def _painter(source: PainterSource) -> SkyPainter:
    return sky_images.painter(source)


def _draw(painter: SkyPainter, number: int, request: ImageRequest) -> SkyImage:
    try:
        return painter.draw(request)
    except BadInput as error:
        raise BadInput(f"table, row {number}: {error}") from None
