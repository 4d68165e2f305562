"""Check that the user's PSF files can be read, before anything is rendered."""

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
    """Check that the PSF file of every requested detector of the exposures can be read.

    Parameters
    ----------
    exposures : iterable of (Exposure, MissionConfiguration)
        Planned exposures, each with the mission parameters used to plan it. Exposures without a PSF file are ignored.
    user_passbands : mapping of str to Passband
        The user's passbands by name, in addition to the passbands of truesky.
    request_psfs : sequence of (str, str)
        Band and PSF file, for each PSF file that the request gives for a whole band. If the file of an exposure is one
        of several files of its band, all of them are checked.

    Notes
    -----
    `truesky.render.psf.from_file.read` raises the errors for missing or invalid files.
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
