"""Check that the user's PSF files can be read, before anything is rendered."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path

from lake_schema.errors import BadInput, Mistakes
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors
from truesky.render.channels import registry
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

    Raises
    ------
    BadInput
        If a file is missing or not valid, or an exposure of spectra has a file, which is not supported. There is one
        line for each mistake.
    """
    checked: set[tuple[str, str, Path]] = set()
    with Mistakes() as mistakes:
        for exposure, mission in exposures:
            if exposure.psf is None:
                continue
            channel = registry.CHANNELS[exposure.channel]
            if channel.dispersion is not None and channel.sees_sky(exposure.image_type):
                problem = f"psf.{exposure.band}: spectra do not support PSF files, delete the key"
                mistakes.add(BadInput(problem))
                continue
            candidates = [file for band, file in request_psfs if band == exposure.band]
            files = candidates if exposure.psf in candidates else [exposure.psf]
            for file, detector in product(files, detectors.detectors(exposure.camera, mission)):
                path = from_file.path_for_detector(file, detector.name)
                is_used = not exposure.detectors or detector.name in exposure.detectors
                if is_used and (exposure.camera, exposure.band, path) not in checked:
                    checked.add((exposure.camera, exposure.band, path))
                    curve = user_passbands.get(exposure.band) or passbands.load(exposure.band)
                    try:
                        from_file.check(path, detector, curve)
                    except BadInput as error:
                        # The file of a single exposure is in a table of pointings.
                        key = f"psf.{exposure.band}" if candidates else "pointings: psf"
                        mistakes.add(error.with_prefix(key))
