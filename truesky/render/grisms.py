"""Traces and sensitivities of grisms as configurations that extraction software reads (grismconf, slitlessutils).

    python -m truesky.render.grisms --out FOLDER [--lake LAKE --exposure N [--name REQUEST]] [--detectors DET11 ..]

FOLDER/RGS000_DET11.conf, with a table of the sensitivity of each of its orders beside it, for every grism and detector:
of the mission database, without the error of the grism wheel.  Of an exposure of a lake
(FOLDER/RGS000_000012_DET11.conf) they are those that its spectra were drawn with.

nominal      a detector in an exposure through a grism, of a mission
of_exposure  the detectors of a rendered exposure
orders       what they detect, in electrons a second
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
from truesky.fluxes import passbands
from truesky.render import detector_inputs
from truesky.render.camera import detectors
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.dispersing import grism_files
from truesky.render.dispersing.draw import Order
from truesky.render.exposure import visible_spectra
from truesky.render.planning import planned_exposures


def nominal_aim(grism: str, detector: str, mission: MissionConfiguration) -> Aim:
    """A detector as it looks through a grism that is not turned; BadInput for one that the camera does not have.

    grism, detector : names;  mission : whose wheel's error is left to whoever asks for the orders
    """
    row = planned_exposures.untilted_exposure(grism, mission)
    return Aim.from_exposure(row, detectors.detector(row.camera, detector, mission))


def orders(aim: Aim, mission: MissionConfiguration, seed: int) -> tuple[Order, ...]:
    """Of a grism: electrons a second in 1 A for each erg s-1 cm-2 A-1 at the pupil, as its spectra are drawn.

    aim : the exposure and detector;  mission : the exposure's;  seed : of the request
    What a turned grism takes of the light of sources at the field's edge is not in it.
    """
    rate_per_flux = electron_rate(aim.exposure) / (UJY_CGS * LIGHT_ANGSTROM_S * passbands.log_width(aim.band))
    trace_orders = visible_spectra.make_orders(aim, mission, seed)
    return tuple(replace(order, response=order.response * rate_per_flux) for order in trace_orders)


def aims_of_exposure(
    root: Path, exposure: int, request: str | None = None
) -> Iterator[tuple[str, Aim, MissionConfiguration, int]]:
    """(detector, its aim, the exposure's mission, the request's seed) of every detector that was rendered.

    root : folder of the lake;  exposure : its number;  request : whose, where a lake has those of several
    Errors : BadInput where there is no such exposure, or it is none of spectra
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
    """(name of a configuration, its aim, mission values and seed)."""
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
    """Prints how many configurations it wrote."""
    parser = argparse.ArgumentParser(
        prog="python -m truesky.render.grisms", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write to (made where it is not there)")
    parser.add_argument("--lake", help="folder of a lake with rendered spectra")
    parser.add_argument("--exposure", type=int, help="number of the exposure in the lake")
    parser.add_argument("--name", help="of the request whose images are meant, where the lake has several")
    parser.add_argument("--detectors", nargs="+", metavar="NAME", help="these alone")
    options = parser.parse_args(argv)
    return command.run("grisms", lambda: _write_configurations(options))


def _write_configurations(options: argparse.Namespace) -> int:
    if bool(options.lake) != (options.exposure is not None):
        raise BadInput("--lake and --exposure are given together, or neither")
    if options.name and not options.lake:
        raise BadInput("--name is of a request of a lake: --lake is missing")
    folder = user_files.check_folder(options.out)
    # All of it is known to be right before the first file.
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
