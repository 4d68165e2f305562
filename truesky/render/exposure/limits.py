"""A scene that does not fit into a task's memory or time is refused before it is drawn."""

from __future__ import annotations

from lake_schema.errors import BadInput
from truesky.render.channels.aim import Aim
from truesky.render.drawing import cost
from truesky.render.exposure import visible_sources
from truesky.render.exposure.visible_sources import Light

# Memory of a task, bytes: what an executor's core may count on; where a forecast says more, as much.
_MAX_BYTES = 2e9
# And its drawing's time, CPU s: a scene that takes longer is a mistake.
_MAX_SECONDS = 6 * 3600.0


def refuse_too_large(aim: Aim, light: Light) -> None:
    """Before anything is drawn: a task must fit into its memory, and end."""
    # Spectra are held a few at a time, whatever the scene.
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
            f"{where} take {required / 1e9:.1f} GB, a task has {available / 1e9:.2g}: "
            "ask for fainter sources to be left out"
        )
    seconds = cost.seconds(sources, sizes, light.psf, detector.nx, detector.ny)
    if seconds > _MAX_SECONDS:
        raise BadInput(
            f"{where} take {seconds / 3600:.1f} h, a task has {_MAX_SECONDS / 3600:g}: "
            "ask for less accuracy, or for fainter sources to be left out"
        )
