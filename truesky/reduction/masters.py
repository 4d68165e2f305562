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
from truesky.reduction import frames as lake_frames
from truesky.reduction.combining import CombinedFrame, clipped_mean
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.render.effects.light import calibration_lamp, illumination


def from_frames(frames: Sequence[Frame], scratch: Path) -> Iterator[tuple[str, CombinedFrame, list[Frame]]]:
    """(kind, master, its frames) of what a detector's calibration frames allow: bias, dark, and a flat of each band.

    scratch : folder for the frames while they are combined: 4 bytes a pixel and frame
    """
    shape = frames[0].scene.ny, frames[0].scene.nx
    masters = {kind: calibration.neutral_master(shape, 0.0) for kind in ("bias", "dark")}
    if not lake_frames.select_types(frames, ("bias",)):
        raise BadInput(f"detector {frames[0].detector}: the lake has no frame of it of the image type bias")
    for kind in files.KINDS:
        for group in _group_frames(lake_frames.select_types(frames, (kind,)), kind):
            lake_frames.common_values(group, (*files.SHARED_CARDS, "MISSION"))
            stack = np.memmap(scratch / kind, np.float32, "w+", shape=(len(group), *shape))
            masters[kind] = _combine_frames(kind, group, masters, stack)
            del stack
            (scratch / kind).unlink()
            yield kind, masters[kind], group


def _group_frames(frames: Sequence[Frame], kind: str) -> list[list[Frame]]:
    """Frames that one master is made of: flats of one band."""
    groups: dict[str, list[Frame]] = {}
    for frame in frames:
        groups.setdefault(frame.exposure.band if kind == "flat" else "", []).append(frame)
    return list(groups.values())


def _combine_frames(
    kind: str, frames: Sequence[Frame], masters: Mapping[str, CombinedFrame], stack: Array
) -> CombinedFrame:
    """Frames of a kind -> their master; stack : float32[n, ny, nx] that it fills."""
    unit = np.zeros(stack.shape[1:])
    for number, frame in enumerate(frames):
        # Electrons that are 1 in the unit of the master.
        frame_unit = (
            _lamp_charge(frame) if kind == "flat" else frame.exposure.exposure_time_s if kind == "dark" else 1.0
        )
        counted = frame.electrons() if kind == "bias" else _counted_charge(frame, masters["bias"], masters["dark"])
        stack[number] = counted / frame_unit
        unit += frame_unit / len(frames)
    reading = calibration.reading_variance(frames[0].scene, frames[0].applied)

    def variance(expected: Float, rows: slice) -> Float:
        counted = 0.0 if kind == "bias" else np.maximum(expected * unit[rows], 0.0)
        return np.asarray((counted + reading[rows]) / unit[rows] ** 2)

    return clipped_mean(stack, variance)


def _counted_charge(frame: Frame, bias: CombinedFrame, dark: CombinedFrame) -> Float:
    """Electrons as they were counted, without bias and dark current."""
    electrons = amplifiers.undo_effects(frame.electrons() - bias.mean, frame.scene, frame.applied)
    return np.asarray(electrons - dark.mean * frame.scene.exposure_time_s)


def _lamp_charge(frame: Frame) -> Float:
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
    return command.run("masters", lambda: _write_masters(options))


def _write_masters(options: argparse.Namespace) -> int:
    out = user_files.check_folder(options.out)
    by_detector = lake_frames.from_lake(layout.resolve_lake(options.lake), options.detectors, request=options.name)
    selected = {
        key: frames
        for key, frames in by_detector.items()
        if options.detectors or lake_frames.select_types(frames, _required_types(frames[0]))
    }
    if not selected:
        raise BadInput(f"lake {options.lake} has no frames of the image type bias, and none of NISP's darks and flats")
    out.mkdir(parents=True, exist_ok=True)
    for frames in selected.values():
        with tempfile.TemporaryDirectory(dir=out, prefix=".frames-") as scratch:
            for master in _detector_masters(frames, Path(scratch)):
                path = files.master_path(out, master.frames[0], master.kind)
                files.write_master(path, master.combined, master.kind, master.frames, master.cards)
                noise = float(np.median(master.combined.uncertainty))
                print(
                    f"{path}: {len(master.frames)} frames, median {np.median(master.combined.mean):.5g}, "
                    f"uncertainty of a pixel {noise:.3g}"
                )
    return 0


def _required_types(frame: Frame) -> tuple[str, ...]:
    """Image types of which a detector has one at least that masters are made of."""
    return ("dark", "flat") if frame.scene.ramp else ("bias",)


def _detector_masters(frames: Sequence[Frame], scratch: Path) -> Iterator[nisp.Master]:
    if frames[0].scene.ramp:
        return nisp.make_masters(frames, scratch)
    return (nisp.Master(*master) for master in from_frames(frames, scratch))


if __name__ == "__main__":
    command.exit_with_status(main)
