"""The user's PSF files are checked when exposures are planned.

check       those of planned exposures
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path

from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors
from truesky.render.planning.planned_exposures import Exposure
from truesky.render.psf import from_file


def check(
    exposures: Iterable[tuple[Exposure, MissionConfiguration]],
    user_passbands: Mapping[str, Passband],
    request_psfs: Sequence[tuple[str, str]] = (),
) -> None:
    """Refuse exposures whose detectors have no PSF that can be read.

    exposures : of every kind there is, each with the mission that it is planned with
    own       : passbands besides the embedded ones
    given     : band and file of each PSF that the request draws an exposure's from
    """
    checked: set[tuple[str, str, Path]] = set()
    for exposure, mission in exposures:
        if exposure.psf is None:
            continue
        candidates = [file for band, file in request_psfs if band == exposure.band]
        files = candidates if exposure.psf in candidates else [exposure.psf]
        for file, detector in product(files, detectors.detectors(exposure.camera, mission)):
            path = from_file.path_for_detector(file, detector.name)
            is_used = not exposure.detectors or detector.name in exposure.detectors
            if is_used and (exposure.camera, exposure.band, path) not in checked:
                checked.add((exposure.camera, exposure.band, path))
                from_file.read(path, detector, user_passbands.get(exposure.band) or passbands.load(exposure.band))
