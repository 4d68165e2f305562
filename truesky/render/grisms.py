"""Write the traces and sensitivities of the grisms as configuration files for grismconf and slitlessutils.

A configuration is a file such as RGS000_DET11.conf for a grism and a detector, and next to it a table with the
sensitivity of each spectral order. The values come from the mission database, without an error of the grism wheel, or
are the ones with which the spectra of a rendered exposure were drawn; files then have names such as
RGS000_000012_DET11.conf.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration, resolve
from lake_schema.store import read
from lake_schema.units import LIGHT_ANGSTROM_S, UJY_CGS
from truesky.fluxes import passbands
from truesky.render import detector_inputs
from truesky.render.camera import detectors
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.dispersing import grism_files
from truesky.render.dispersing.draw import Order
from truesky.render.exposure import visible_spectra
from truesky.render.planning import planned_exposures


def nominal_aim(grism: str, detector: str, mission: MissionConfiguration) -> Aim:
    """Return a NISP detector in a made-up exposure of one second through an untilted grism.

    Parameters
    ----------
    grism, detector : str
        Names of the grism, such as "RGS000", and of the detector, such as "DET11". An unknown grism raises
        StopIteration, an unknown detector BadInput.
    mission : MissionConfiguration
        Mission database. It contains the error of the angle to which the grism wheel turns. Unless this error is 0,
        it will turn the traces that are computed for the exposure.

    Returns
    -------
    Aim
        The detector with its exposure at ra = dec = 0.
    """
    row = planned_exposures.untilted_exposure(grism, mission)
    return Aim.from_exposure(row, detectors.detector(row.camera, detector, mission))


def orders(aim: Aim, mission: MissionConfiguration, seed: int) -> tuple[Order, ...]:
    """Return the spectral orders of a grism on a detector, with which the spectra of an exposure are drawn.

    Parameters
    ----------
    aim : Aim
        Detector of an exposure through a grism.
    mission : MissionConfiguration
        Mission parameters of the exposure.
    seed : int
        Seed of the request, from which the error of the angle of the grism wheel is drawn.

    Returns
    -------
    tuple of Order
        Each order with its trace on the detector and its response: electrons per second and angstrom for a flux density
        of 1 erg s-1 cm-2 A-1 at the pupil.

    Notes
    -----
    The loss of light by vignetting, which a tilted grism causes at the edge of the field, is not included.
    """
    rate_per_flux = electron_rate(aim.exposure) / (UJY_CGS * LIGHT_ANGSTROM_S * passbands.log_width(aim.band))
    trace_orders = visible_spectra.make_orders(aim, mission, seed)
    return tuple(replace(order, response=order.response * rate_per_flux) for order in trace_orders)


def aims_of_exposure(
    root: Path, exposure: int, request: str | None = None
) -> Iterator[tuple[str, Aim, MissionConfiguration, int]]:
    """Yield every detector of an exposure through a grism that has been rendered.

    Parameters
    ----------
    root : Path
        Lake (folder of stored tables and images).
    exposure : int
        Number of the exposure.
    request : str, optional
        Name of the request; required if the lake has several.

    Yields
    ------
    detector : str
        Name of the detector.
    aim : Aim
        The detector with its exposure.
    mission : MissionConfiguration
        Mission parameters of the exposure.
    seed : int
        Seed of the request, from which random errors such as the angle of the grism wheel are drawn.

    Raises
    ------
    BadInput
        If the lake has no images of the exposure, or if it is not an exposure of the sky through a grism.
    """
    version = read.version(root, "products", request=request)
    parts = [part["facts"] for part in version.manifest["parts"] if part["facts"]["exposure_id"] == exposure]
    if not parts:
        raise BadInput(f"table products has no exposure {exposure}")
    for part in parts:
        facts = {**version.manifest["facts"], **part}
        aim, variant, _ = detector_inputs.load_aim(root, facts)
        if aim.channel.dispersion is None or not aim.sees_sky:
            description = f"{aim.exposure.channel} {aim.exposure.image_type}"
            raise BadInput(f"exposure {exposure}: {description} is no image of spectra")
        yield part["detector"], aim, variant.mission, facts["request"]["seed"]


def write(
    folder: Path,
    lake: Path | None = None,
    exposure: int | None = None,
    detector_names: Sequence[str] = (),
    request: str | None = None,
) -> int:
    """Write the configurations of all grisms, or of a rendered exposure, and return their number.

    Parameters
    ----------
    folder : Path
        Folder to write to, which is created if needed. Files with the same names are replaced.
    lake : Path, optional
        Folder of a lake with rendered spectra; None for the nominal values of all grisms.
    exposure : int, optional
        Number of the exposure in the lake; required with a lake.
    detector_names : sequence of str, optional
        Names of the detectors; by default all.
    request : str, optional
        Name of the request; required if the lake has several.

    Returns
    -------
    int
        Number of configurations.

    Raises
    ------
    BadInput
        If a detector does not exist or has not been rendered, or the exposure has no spectra. Nothing is written then.
    """
    # Make the whole list first, so that nothing is written if one configuration is invalid.
    if lake is None or exposure is None:
        configurations = list(_nominal_configurations(detector_names))
    else:
        configurations = [
            (f"{aim.exposure.grism}_{exposure:06d}_{name}", aim, mission, seed)
            for name, aim, mission, seed in aims_of_exposure(lake, exposure, request)
            if not detector_names or name in detector_names
        ]
    if missing := set(detector_names) - {aim.detector.name for _, aim, _, _ in configurations}:
        raise BadInput(f"exposure {exposure}: detector {min(missing)} has not been rendered")
    folder.mkdir(parents=True, exist_ok=True)
    for name, aim, mission, seed in configurations:
        shape = aim.detector.ny, aim.detector.nx
        grism_files.write(folder, name, orders(aim, mission, seed), shape)
    return len(configurations)


def _nominal_configurations(detector_names: Sequence[str]) -> Iterator[tuple[str, Aim, MissionConfiguration, int]]:
    """Yield for each grism and detector: name without ending, detector with exposure, mission parameters, and seed."""
    for grism in sorted(grism for names in planned_exposures.GRISMS.values() for grism in names):
        camera = planned_exposures.untilted_exposure(grism, resolve()).camera
        mission = resolve(overrides={f"{camera}.grism_wheel_error": (0.0, "deg")})
        for name in detector_names or [detector.name for detector in detectors.detectors(camera, mission)]:
            yield f"{grism}_{name}", nominal_aim(grism, name, mission), mission, 0
