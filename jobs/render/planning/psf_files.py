"""The user's PSF files are checked when exposures are planned.

check       those of planned exposures
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from jobs.fluxes import passbands
from jobs.fluxes.passbands import Passband
from jobs.render.camera import detectors
from jobs.render.planning.planned_exposures import Exposure
from jobs.render.psf import from_file
from lake_schema.mission.configuration import MissionConfiguration


def check(exposures: Sequence[tuple[Exposure, MissionConfiguration]], own: Mapping[str, Passband]) -> None:
    """Refuse exposures whose detectors have no PSF that can be read; own : passbands besides the embedded ones."""
    seen: set[tuple[str, str, Path]] = set()
    for exposure, mission in exposures:
        if exposure.psf is None:
            continue
        for detector in detectors.detectors(exposure.camera, mission):
            path = from_file.file_of(exposure.psf, detector.name)
            wanted = not exposure.detectors or detector.name in exposure.detectors
            if wanted and (exposure.camera, exposure.band, path) not in seen:
                seen.add((exposure.camera, exposure.band, path))
                from_file.read(path, detector, own.get(exposure.band) or passbands.load(exposure.band))
