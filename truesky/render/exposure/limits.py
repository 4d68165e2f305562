"""Check, before the sources of a detector are drawn, that drawing does not need too much memory or time."""

from __future__ import annotations

import os

from lake_schema.errors import BadInput
from truesky.render.channels.aim import Aim
from truesky.render.drawing import cost
from truesky.render.exposure import visible_sources
from truesky.render.exposure.visible_sources import Light

# Memory that the simulation of one detector may use, bytes. Each core of a Spark executor has at least this memory. If
# an image of the channel (instrument mode) is predicted to need more even without sources, that prediction is the
# limit.
_MAX_BYTES = 2e9
# CPU time that drawing the sources of one detector may take, s. An image that takes longer is probably a mistake.
_MAX_SECONDS = 6 * 3600.0


def refuse_too_many_pixels(aim: Aim) -> None:
    """Check that the image of a detector fits into the memory of this machine, whatever its sources.

    `aim` is the exposure and the detector. Raises BadInput if the predicted memory exceeds the installed memory.
    """
    detector, costs = aim.detector, aim.channel.cost
    per_pixel = costs.sky_bytes_per_pixel if aim.sees_sky else costs.bytes_per_pixel
    required, installed = 1e9 * costs.base_gb + per_pixel * detector.nx * detector.ny, _installed_bytes()
    if required > installed:
        raise BadInput(
            f"exposure {aim.exposure.exposure_id}, detector {detector.name}: {detector.nx} x {detector.ny} pixels take "
            f"{required / 1e9:.1f} GB, this machine has {installed / 1e9:.1f} GB: render it on a larger machine"
        )


def _installed_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def refuse_too_large(aim: Aim, light: Light) -> None:
    """Check that drawing the sources of a detector does not need more memory or time than allowed.

    Images without light of the sky, and dispersed images, are not checked.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    light : Light
        Sources to be drawn.

    Raises
    ------
    BadInput
        If the predicted memory exceeds 2 GB, or the predicted CPU time exceeds 6 h. If the channel needs more than 2 GB
        even without sources, that memory is the limit.
    """
    # Dispersed images are not checked: they need little memory, because only a few spectra are in memory at a time.
    if light.psf is None or light.dispersed is not None:
        return
    exposure, detector, sources, sizes = aim.exposure, aim.detector, light.sources, light.sizes
    on_detector = visible_sources.touches_frame(sources, sizes, aim.drawn)
    where = f"exposure {exposure.exposure_id}, detector {detector.name}: {int(on_detector.sum())} sources"
    base = aim.channel.cost.base_gb * 1e9
    available = max(_MAX_BYTES, base + aim.channel.cost.sky_bytes_per_pixel * detector.nx * detector.ny)
    picture = None if sources.picture is None else sources.picture[on_detector]
    required = base + cost.memory(sources.electrons[on_detector], sizes[on_detector], detector.nx, detector.ny, picture)
    if required > available:
        raise BadInput(
            f"{where} take {required / 1e9:.1f} GB, a task may use {available / 1e9:.2g}: leave out faint sources"
        )
    seconds = cost.seconds(sources, sizes, light.psf, detector.nx, detector.ny)
    if seconds > _MAX_SECONDS:
        raise BadInput(
            f"{where} take {seconds / 3600:.1f} h, a task may use {_MAX_SECONDS / 3600:g}: "
            "choose a lower accuracy, or leave out faint sources"
        )
