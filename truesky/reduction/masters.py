"""Make master bias, dark and flat frames of each detector from the calibration frames of a lake.

    truesky masters LAKE [--name REQUEST] --out FOLDER [--detectors 3-4 ..]

Files of detector 3-4 of VIS are FOLDER/VIS_3-4_bias.fits (electrons), .._dark.fits (electrons per second) and
.._flat.fits (response; 1 if all light is counted). For each pixel, a file also has the uncertainty and the number of
combined frames. A flat is divided by the light of its lamp, which is known from the mission parameters. If a band has
fringes, exposures of the sky with three or more pointings give .._fringes.fits (fraction of the sky).

Files of detector DET22 of NISP are NISP-P_4-16-4_DET22_dark.fits (one for each readout mode: groups, reads, drops),
NISP_DET22_linearity.fits and NISP-P_euclid_y_DET22_flat.fits (one for each band, for the mixture of lamps whose colour
is most similar to the sky). The linearity is the coefficient b in 1/electron: of N electrons, N (1 - b N) are measured.
It is fitted to flats of one lamp at three or more intensities. NISP_DET22_bad_pixels.fits has the flags of hot pixels
and of pixels with a response far from 1, from all darks and flats.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lake_schema import command, user_files
from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.command_line import commands
from truesky.reduction import amplifiers, calibration, files, fringe_masters
from truesky.reduction import frames as lake_frames
from truesky.reduction.combining import CombinedFrame, clipped_mean
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.effects.light import calibration_lamp, illumination


def from_frames(frames: Sequence[Frame], scratch: Path) -> Iterator[tuple[str, CombinedFrame, list[Frame]]]:
    """Combine the frames of a CCD to masters: a bias, a dark, and for each band a flat and the fringes of the sky.

    The dark is omitted if there are no dark frames, and the flats if there are no flat frames. The fringes of a band
    are omitted if it has no fringes or no flat, or if its exposures of the sky do not suffice
    (`fringe_masters.can_combine`). Exposures with other mission parameters than the flat are not used for fringes.

    Parameters
    ----------
    frames : sequence of Frame
        Frames of the detector, at least one.
    scratch : Path
        Folder for temporary files, which take 4 bytes per pixel and frame.

    Yields
    ------
    kind : str
        Kind of master: "bias", "dark", "flat" or "fringes".
    master : CombinedFrame
        The master: bias in electrons, dark in electrons per second, flat as response, or fringes as a
        fraction of the sky.
    frames : list of Frame
        Frames that were combined.

    Raises
    ------
    BadInput
        If there is no bias frame, or if frames of a master differ in instrument, detector, seed or mission parameters.
    """
    shape = frames[0].scene.ny, frames[0].scene.nx
    masters = {kind: calibration.neutral_master(shape, 0.0) for kind in ("bias", "dark")}
    if not lake_frames.select_types(frames, ("bias",)):
        raise BadInput(f"detector {frames[0].detector}: the lake has no frame with image type bias")
    for kind in files.KINDS:
        for group in _group_frames(lake_frames.select_types(frames, (kind,)), kind):
            lake_frames.common_values(group, (*files.SHARED_CARDS, "MISSION"))
            stack = np.memmap(scratch / kind, np.float32, "w+", shape=(len(group), *shape))
            masters[kind] = _combine_frames(kind, group, masters, stack)
            del stack
            (scratch / kind).unlink()
            yield kind, masters[kind], group
            skies = _fringed_skies(frames, group[0]) if kind == "flat" else []
            if fringe_masters.can_combine(skies):
                # Only the flat of this band is in memory.
                yield "fringes", _combine_skies(skies, masters, group[0], scratch), skies


def _fringed_skies(frames: Sequence[Frame], flat: Frame) -> list[Frame]:
    """Return the exposures of the sky that show fringes, in the band and with the mission parameters of a flat."""
    shared = *files.SHARED_CARDS, "MISSION"
    return [
        frame
        for frame in lake_frames.select_types(frames, SKY_TYPES)
        if "fringes" in frame.applied
        and frame.exposure.band == flat.exposure.band
        and all(str(frame.card(keyword)) == str(flat.card(keyword)) for keyword in shared)
    ]


def _combine_skies(
    skies: Sequence[Frame], masters: Mapping[str, CombinedFrame], flat: Frame, scratch: Path
) -> CombinedFrame:
    """Combine exposures of the sky to the master of their fringes. `flat` is one of the flats of their band."""
    shape = skies[0].scene.ny, skies[0].scene.nx
    response = replace(masters["flat"], vignetted=files.has_vignetting(flat))
    flags = calibration.master_flags(shape, masters, ())
    stack = np.memmap(scratch / "fringes", np.float32, "w+", shape=(len(skies), *shape))
    used = calibration.Masters(masters["bias"], masters["dark"], response, flags)
    master = fringe_masters.combine(skies, used, stack)
    del stack
    (scratch / "fringes").unlink()
    return master


def _group_frames(frames: Sequence[Frame], kind: str) -> list[list[Frame]]:
    """Divide frames of one kind into groups that give one master each: flats by band, biases or darks all together."""
    groups: dict[str, list[Frame]] = {}
    for frame in frames:
        groups.setdefault(frame.exposure.band if kind == "flat" else "", []).append(frame)
    return list(groups.values())


def _combine_frames(
    kind: str, frames: Sequence[Frame], masters: Mapping[str, CombinedFrame], stack: Array
) -> CombinedFrame:
    """Combine n frames of a kind ("bias", "dark" or "flat") to a master.

    `masters` has the bias and dark that are subtracted from the frames. `stack`, float32[n, ny, nx], is overwritten as
    temporary space.
    """
    unit = np.zeros(stack.shape[1:])
    for number, frame in enumerate(frames):
        # Electrons of the frame that correspond to the value 1 in the master (lamp light, seconds, or 1 for a bias).
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
    """Return the electrons of a frame without bias and dark current, corrected for crosstalk and nonlinearity."""
    electrons = amplifiers.undo_effects(frame.electrons() - bias.mean, frame.scene, frame.applied)
    return np.asarray(electrons - dark.mean * frame.scene.exposure_time_s)


def _lamp_charge(frame: Frame) -> Float:
    """Return the electrons per pixel that the lamp of a flat would give at a response of 1, float64[ny, nx]."""
    electrons, *pattern = calibration_lamp.EFFECT.parameters(frame.scene)
    return np.asarray(electrons * illumination.apply(np.ones((frame.scene.ny, frame.scene.nx)), *pattern))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command `truesky masters`, print a line per master frame, and return the exit status.

    `argv` are the arguments of the command; None means the arguments of the process.
    """
    return commands.run("masters", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Run `truesky masters` with its parsed arguments, and return the exit status 0; errors are raised as LakeError."""
    out = user_files.check_folder(options.out)
    root = layout.resolve_lake(options.lake)
    by_detector = lake_frames.from_lake(root, options.detectors, request=options.name)
    selected = {
        key: frames
        for key, frames in by_detector.items()
        if options.detectors or lake_frames.select_types(frames, _required_types(frames[0]))
    }
    if not selected:
        remedy = 'add an [[observation]] with image_type = "bias" to the request, for NISP "dark" or "flat"'
        raise BadInput(f"lake {root} has no calibration frames for masters: {remedy}")
    out.mkdir(parents=True, exist_ok=True)
    for frames in selected.values():
        with tempfile.TemporaryDirectory(dir=out, prefix=".frames-") as scratch:
            for master in _detector_masters(frames, Path(scratch)):
                path = files.master_path(out, master.frames[0], master.kind)
                files.write_master(path, master.combined, master.kind, master.frames, master.cards)
                noise = float(np.median(master.combined.uncertainty))
                print(
                    f"{path}: {len(master.frames)} frames, median {np.median(master.combined.mean):.5g}, "
                    f"uncertainty per pixel {noise:.3g}"
                )
    return 0


def _required_types(frame: Frame) -> tuple[str, ...]:
    """Return image types of which a detector needs at least one frame: dark or flat for infrared, bias for a CCD."""
    return ("dark", "flat") if frame.scene.ramp else ("bias",)


def _detector_masters(frames: Sequence[Frame], scratch: Path) -> Iterator[nisp.Master]:
    if frames[0].scene.ramp:
        return nisp.make_masters(frames, scratch)
    return (nisp.Master(*master) for master in from_frames(frames, scratch))


if __name__ == "__main__":
    command.exit_with_status(main)
