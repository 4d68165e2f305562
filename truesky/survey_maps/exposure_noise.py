"""Noise of a pixel of blank sky in planned exposures: light of the sky, dark current, and readout."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.reduction.infrared.ramps import Estimator
from truesky.render.camera.detectors import Detector
from truesky.render.effects.readout import ramp_noise
from truesky.render.effects.scene import Scene
from truesky.render.exposure import scene_factory
from truesky.request.accuracy import SURVEY


def variances(
    exposures: Sequence[ExposureRow], detectors: Sequence[Detector], mission: MissionConfiguration
) -> tuple[Float, Float]:
    """Return the sky and the variance of a pixel of blank sky, for pairs of an exposure and a detector.

    Parameters
    ----------
    exposures : sequence of ExposureRow, length n
        Exposures with the same mission parameters.
    detectors : sequence of Detector, length n
        A detector of each exposure.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    sky : float array, shape (n,)
        Sky in the middle of the detector, electrons / s / pixel.
    variance : float array, shape (n,)
        Variance of the signal of a pixel, electrons^2.

    Notes
    -----
    A detector that is read once has the variance sky t + dark t + r^2, with the mean r^2 of its amplifiers. For NISP it
    is the variance of the estimate from all reads of the ramp, as `reduction` computes it, with drifts of the
    electronics. Interpixel capacitance is left out: it correlates neighbouring pixels, and a fit to the PSF undoes it.
    """
    sky, variance = np.zeros(len(exposures)), np.zeros(len(exposures))
    groups = defaultdict(list)
    for i, (exposure, detector) in enumerate(zip(exposures, detectors, strict=True)):
        # Detectors have the same readout in all exposures of the same time.
        groups[exposure.channel, exposure.camera, detector.name, exposure.exposure_time_s].append(i)
    for indices in groups.values():
        exposure, detector = exposures[indices[0]], detectors[indices[0]]
        scene = scene_factory.from_exposure(exposure, detector, mission, SURVEY)
        group = [exposures[i] for i in indices]
        sky[indices] = np.array([e.sky for e in group]) * scene_factory.sky_levels(group, detector)
        electrons = sky[indices] * exposure.exposure_time_s + scene.dark_electrons
        variance[indices] = _variance(scene, electrons)
    return sky, variance


def _variance(scene: Scene, electrons: Float) -> Float:
    if scene.ramp:
        return Estimator.from_scene(scene, (ramp_noise.DRIFT.name,)).variance(electrons)
    read_noise = np.asarray(scene.amplifier_values("read_noise", "electron"))
    return np.asarray(electrons + float((read_noise**2).mean()))
