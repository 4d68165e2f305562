"""A scene that does not fit into a task's memory or time is refused before it is drawn."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from jobs.render.camera.detectors import Detector
from jobs.render.channels import costs
from jobs.render.drawing import cost
from jobs.render.psf.model import Psf
from jobs.render.sources import selection
from jobs.render.sources.source_list import Sources
from lake_schema.arrays import Int, Row
from lake_schema.errors import BadInput

# Memory of a task, bytes: what an executor's core may count on.
_MOST_BYTES = 2e9
# And its drawing's time, CPU s: a scene that takes longer is a mistake.
_MOST_SECONDS = 6 * 3600.0


def refuse_too_large(exposure: Row, detector: Detector, sources: Sources, sizes: Int, spread: Psf) -> None:
    """Before anything is drawn: a task must fit into its memory, and end."""
    here = touching(sources, sizes, detector)
    where = f"exposure {exposure['exposure_id']}, detector {detector.name}: {int(here.sum())} sources"
    base = costs.of_channel(str(exposure["channel"])).base_gb * 1e9
    picture = None if sources.picture is None else sources.picture[here]
    wanted = base + cost.memory(sources.electrons[here], sizes[here], detector.nx, detector.ny, picture)
    if wanted > _MOST_BYTES:
        raise BadInput(
            f"{where} take {wanted / 1e9:.1f} GB, a task has {_MOST_BYTES / 1e9:g}: "
            "ask for fainter sources to be left out"
        )
    seconds = cost.seconds(sources, sizes, spread, detector.nx, detector.ny)
    if seconds > _MOST_SECONDS:
        raise BadInput(
            f"{where} take {seconds / 3600:.1f} h, a task has {_MOST_SECONDS / 3600:g}: "
            "ask for less accuracy, or for fainter sources to be left out"
        )


def touching(sources: Sources, sizes: Int, detector: Detector) -> npt.NDArray[np.bool_]:
    """Sources with a stamp on the detector."""
    return selection.touching(sources.column, sources.row, sizes + sources.length, detector.nx, detector.ny)
