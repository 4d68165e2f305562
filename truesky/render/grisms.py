"""Write the traces and sensitivities of the grisms as configuration files for grismconf and slitlessutils.

    python -m truesky.render.grisms [LAKE --exposure N [--name REQUEST]] --out FOLDER [--detectors DET11 ..]

The command writes a file such as FOLDER/RGS000_DET11.conf for every grism and detector, and next to it a table with the
sensitivity of each spectral order. By default the values come from the mission database, and the grism wheel has no
error. With LAKE and --exposure, the values are the ones with which the spectra of this exposure were drawn, and names
are such as FOLDER/RGS000_000012_DET11.conf.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from lake_schema import command, user_files
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration, resolve
from lake_schema.store import layout, read
from lake_schema.units import LIGHT_ANGSTROM_S, UJY_CGS
from truesky.command_line.parser import Parser
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


def _configurations(options: argparse.Namespace) -> Iterator[tuple[str, Aim, MissionConfiguration, int]]:
    """Yield for each configuration file: name without ending, detector with exposure, mission parameters, and seed.

    `options` are the arguments of the command. They select the detectors of a rendered exposure, or all grisms.
    """
    if options.lake:
        for name, aim, mission, seed in aims_of_exposure(
            layout.resolve_lake(options.lake), options.exposure, options.name
        ):
            if not options.detectors or name in options.detectors:
                yield f"{aim.exposure.grism}_{options.exposure:06d}_{name}", aim, mission, seed
        return
    for grism in sorted(grism for names in planned_exposures.GRISMS.values() for grism in names):
        camera = planned_exposures.untilted_exposure(grism, resolve()).camera
        mission = resolve(overrides={f"{camera}.grism_wheel_error": (0.0, "deg")})
        for name in options.detectors or [detector.name for detector in detectors.detectors(camera, mission)]:
            yield f"{grism}_{name}", nominal_aim(grism, name, mission), mission, 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command: write the configuration files and print their number. Return the exit status."""
    parser = Parser(prog="python -m truesky.render.grisms", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to write to; it is created if needed")
    parser.add_lake("folder of a lake with rendered spectra", is_optional=True)
    parser.add_argument("--exposure", type=int, help="number of the exposure in the lake")
    parser.add_argument("--name", help="name of the request, required if the lake has several")
    parser.add_argument("--detectors", nargs="+", metavar="NAME", help="only these detectors")
    options = parser.parse_args(argv)
    return command.run("grisms", lambda: _write_configurations(options))


def _write_configurations(options: argparse.Namespace) -> int:
    if bool(options.lake) != (options.exposure is not None):
        raise BadInput("LAKE and --exposure must be given together")
    if options.name and not options.lake:
        raise BadInput("--name requires LAKE")
    folder = user_files.check_folder(options.out)
    # Make the whole list first, so that nothing is written if one configuration is invalid.
    configurations = list(_configurations(options))
    missing = set(options.detectors or ()) - {aim.detector.name for _, aim, _, _ in configurations}
    if missing:
        raise BadInput(f"exposure {options.exposure}: detector {min(missing)} has not been rendered")
    folder.mkdir(parents=True, exist_ok=True)
    for name, aim, mission, seed in configurations:
        shape = aim.detector.ny, aim.detector.nx
        grism_files.write(folder, name, orders(aim, mission, seed), shape)
    print(f"{options.out}: {len(configurations)} configurations")
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
