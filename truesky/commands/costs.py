"""Check a request and forecast its cost, for the commands check, plan and run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pyarrow as pa

from truesky.commands import plan
from truesky.render.forecasting import request_cost, speed
from truesky.render.forecasting.image_costs import ImageCosts
from truesky.render.forecasting.request_cost import RequestCost
from truesky.render.forecasting.sky_levels import SkyLevels
from truesky.request.schema import Request


def check_and_forecast(request: Request, lake: Path | None = None) -> RequestCost:
    """Check that no job would refuse a request, and forecast the cost to run it on this machine.

    Parameters
    ----------
    request : Request
        The parsed request.
    lake : Path, optional
        Folder of the lake whose catalogues give the density of sources, and whose logs the speed of this machine.

    Returns
    -------
    RequestCost
        The forecast for a new lake, with the cache as it is now, and the sky of each band.

    Raises
    ------
    BadInput
        If a job would refuse the request. The message names the key.
    """
    images, sky = ImageCosts(request), SkyLevels(request)
    if request.pointings or request.observations:
        for exposures, _ in images.watch(plan.checked_chunks(request, lake)):
            sky.add(exposures)
    else:
        plan.check_catalogues(request)
    return replace(request_cost.forecast(request, images, speed.estimate_speed(lake)), sky=tuple(sky.lines()))


def forecast_plan(root: Path, request: Request, rows: tuple[pa.Table, pa.Table] | None) -> RequestCost:
    """Forecast the cost of a request that has been checked and planned.

    Parameters
    ----------
    root : Path
        Folder of the lake; its logs give the speed of this machine.
    request : Request
        The request, with the detectors to render from the command line.
    rows : tuple of pyarrow.Table or None
        Rows of the tables `exposures` and `tasks`; None if nothing is rendered.

    Returns
    -------
    RequestCost
        The forecast. It includes tables and images that the lake already contains, although they will not be made
        again.
    """
    images = ImageCosts(request)
    if rows is not None:
        images.add(*rows)
    return request_cost.forecast(request, images, speed.estimate_speed(root))
