"""Master bias, dark and flat of each detector, from the calibration frames of a lake.

    python -m truesky.reduction.masters --lake LAKE [--name REQUEST] --out FOLDER [--detectors 3-4 ..]

FOLDER/VIS_3-4_bias.fits (e-), .._dark.fits (e-/s) and .._flat.fits (response; 1 = all light is counted), each with its
uncertainty and the number of frames that a pixel is of. A flat is over its lamp's light as the mission declares it.
Of NISP NISP-P_4-16-4_DET22_dark.fits (of each ramp), NISP_DET22_linearity.fits (b of N (1 - b N), 1/e-, of flats at
three intensities and more) and NISP-P_euclid_y_DET22_flat.fits (of the lamps' mix that is like the sky).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from lake_schema import command, user_files
from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.reduction import amplifiers, calibration, files
from truesky.reduction import frames as frames_of
from truesky.reduction.combining import Combined, clipped_mean
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.render.effects.light import calibration_lamp, illumination


def made(frames: Sequence[Frame], scratch: Path) -> Iterator[tuple[str, Combined, list[Frame]]]:
    """(kind, master, its frames) of what a detector's calibration frames allow: bias, dark, and a flat of each band.

    scratch : folder for the frames while they are combined: 4 bytes a pixel and frame
    """
    shape = frames[0].scene.ny, frames[0].scene.nx
    masters = {kind: calibration.nothing(shape, 0.0) for kind in ("bias", "dark")}
    if not frames_of.of_types(frames, ("bias",)):
        raise BadInput(f"detector {frames[0].detector}: the lake has no frame of it of the image type bias")
    for kind in files.KINDS:
        for own in _alike(frames_of.of_types(frames, (kind,)), kind):
            frames_of.common(own, (*files.SAME, "MISSION"))
            stack = np.memmap(scratch / kind, np.float32, "w+", shape=(len(own), *shape))
            masters[kind] = _combined(kind, own, masters, stack)
            del stack
            (scratch / kind).unlink()
            yield kind, masters[kind], own


def _alike(frames: Sequence[Frame], kind: str) -> list[list[Frame]]:
    """Frames that one master is made of: flats of one band."""
    found: dict[str, list[Frame]] = {}
    for frame in frames:
        found.setdefault(frame.exposure.band if kind == "flat" else "", []).append(frame)
    return list(found.values())


def _combined(kind: str, frames: Sequence[Frame], masters: Mapping[str, Combined], stack: Array) -> Combined:
    """Frames of a kind -> their master; stack : float32[n, ny, nx] that it fills."""
    unit = np.zeros(stack.shape[1:])
    for number, frame in enumerate(frames):
        # Electrons that are 1 in the unit of the master.
        one = _lamp(frame) if kind == "flat" else frame.exposure.exposure_time_s if kind == "dark" else 1.0
        counted = frame.electrons() if kind == "bias" else _counted(frame, masters["bias"], masters["dark"])
        stack[number] = counted / one
        unit += one / len(frames)
    reading = calibration.reading_variance(frames[0].scene, frames[0].applied)

    def variance(expected: Float, rows: slice) -> Float:
        counted = 0.0 if kind == "bias" else np.maximum(expected * unit[rows], 0.0)
        return np.asarray((counted + reading[rows]) / unit[rows] ** 2)

    return clipped_mean(stack, variance)


def _counted(frame: Frame, bias: Combined, dark: Combined) -> Float:
    """Electrons as they were counted, without bias and dark current."""
    electrons = amplifiers.undone(frame.electrons() - bias.mean, frame.scene, frame.applied)
    return np.asarray(electrons - dark.mean * frame.scene.exposure_time_s)


def _lamp(frame: Frame) -> Float:
    """Electrons [ny, nx] that the lamp of a flat would bring were all its light counted."""
    electrons, *pattern = calibration_lamp.EFFECT.parameters(frame.scene)
    return np.asarray(electrons * illumination.apply(np.ones((frame.scene.ny, frame.scene.nx)), *pattern))


def main(argv: Sequence[str] | None = None) -> int:
    """Prints a line a master."""
    parser = argparse.ArgumentParser(prog="truesky masters", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lake", required=True, help="folder of the lake, with rendered calibration frames")
    parser.add_argument("--name", help="of the request whose frames are meant, where the lake has several")
    parser.add_argument("--out", type=Path, required=True, help="folder of the masters")
    parser.add_argument("--detectors", nargs="+", default=[], metavar="NAME", help="default: all that have any")
    options = parser.parse_args(argv)
    return command.status("masters", lambda: _written(options))


def _written(options: argparse.Namespace) -> int:
    out = user_files.folder(options.out)
    found = frames_of.of_lake(layout.lake(options.lake), options.detectors, request=options.name)
    some = {key: own for key, own in found.items() if options.detectors or frames_of.of_types(own, _needed(own[0]))}
    if not some:
        raise BadInput(f"lake {options.lake} has no frames of the image type bias, and none of NISP's darks and flats")
    out.mkdir(parents=True, exist_ok=True)
    for own in some.values():
        with tempfile.TemporaryDirectory(dir=out, prefix=".frames-") as scratch:
            for one in _of_detector(own, Path(scratch)):
                path = files.master_name(out, one.frames[0], one.kind)
                files.write_master(path, one.combined, one.kind, one.frames, one.cards)
                noise = float(np.median(one.combined.uncertainty))
                print(
                    f"{path}: {len(one.frames)} frames, median {np.median(one.combined.mean):.5g}, "
                    f"uncertainty of a pixel {noise:.3g}"
                )
    return 0


def _needed(frame: Frame) -> tuple[str, ...]:
    """Image types of which a detector has one at least that masters are made of."""
    return ("dark", "flat") if frame.scene.ramp else ("bias",)


def _of_detector(frames: Sequence[Frame], scratch: Path) -> Iterator[nisp.Made]:
    if frames[0].scene.ramp:
        return nisp.masters(frames, scratch)
    return (nisp.Made(*one) for one in made(frames, scratch))


if __name__ == "__main__":
    command.leave(main)
