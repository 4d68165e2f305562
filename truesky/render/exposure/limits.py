"""Refuse scenes that need more memory or time than a task may use, before they are drawn."""

from __future__ import annotations

from lake_schema.errors import BadInput
from truesky.render.channels.aim import Aim
from truesky.render.drawing import cost
from truesky.render.exposure import visible_sources
from truesky.render.exposure.visible_sources import Light

# Memory of a task in bytes, which each core of an executor can use. If the forecast is higher, it is the limit.
_MAX_BYTES = 2e9
# CPU seconds to draw the sources of a task. Scenes that take longer are mistakes.
_MAX_SECONDS = 6 * 3600.0


def refuse_too_large(aim: Aim, light: Light) -> None:
    """Raise BadInput if the drawing of the sources would exceed the memory or time of a task."""
    # Memory for spectra is limited, because only a few are in memory at the same time.
    if light.psf is None or light.dispersed is not None:
        return
    exposure, detector, sources, sizes = aim.exposure, aim.detector, light.sources, light.sizes
    on_detector = visible_sources.touches_detector(sources, sizes, detector)
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
