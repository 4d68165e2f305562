"""Calibrate the raw frames of a lake: bias, dark, response of the amplifiers, flat, vignetting.

    truesky reduce LAKE [--name REQUEST] --masters FOLDER --out FOLDER [--detectors ..]
                        [--exposures ..] [--rate] [--without ..] [--cosmic-rays SIGMA]
                        [--level2 [--aperture ARCSEC] [--threshold SIGMA] [--least-pixels N]]

Each frame of the sky gives a FITS file with the extensions SCI, WHT (inverse variance) and FLG (flag bits). The unit of
SCI is the electron, with --rate electrons per second, and with --level2 counts (electrons / mean gain of amplifiers).
Level 2 adds a catalogue of sources, the PSF and a .head file (WCS as text) in the same folder.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lake_schema import command, user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput
from lake_schema.fits.images import Card
from lake_schema.store import layout
from truesky.command_line import commands
from truesky.command_line.parser import suggestion
from truesky.reduction import calibration, cosmic_rays, files, level2
from truesky.reduction import frames as lake_frames
from truesky.reduction.calibration import Masters, ReducedImage
from truesky.reduction.catalogue import Limits
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.reduction.infrared.persistence_prediction import PersistencePrediction
from truesky.render.channels import registry
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.effects.light import pixel_area

# Default threshold of the cosmic ray search for level 2, in standard deviations of the noise (van Dokkum 2001).
_COSMIC_RAY_SIGMA = 4.5


@dataclass(frozen=True, slots=True)
class ReductionOptions:
    """Options of the reduction of a frame.

    Attributes
    ----------
    unit : str
        Unit of the output pixels: "electron", "electron/s" or "adu".
    without : tuple of str
        Names of corrections that are omitted, such as "flat", see `files.CORRECTIONS`.
    cosmic_rays : float
        Threshold of the cosmic ray search in standard deviations of the noise, 1 to 1000; 0 to skip the search.
    """

    unit: str = "electron"
    without: tuple[str, ...] = ()
    cosmic_rays: float = 0.0


def reduce_frame(
    frame: Frame, masters: Masters, reduction: ReductionOptions, prediction: PersistencePrediction | None = None
) -> tuple[ReducedImage, tuple[Card, ...]]:
    """Calibrate a raw frame with the masters (combined bias, dark and flat frames) of its detector.

    Parameters
    ----------
    frame : Frame
        The raw frame.
    masters : Masters
        Masters of the detector. They are freed after use if the caller has no reference to them.
    reduction : ReductionOptions
        Unit of the result, omitted corrections, and threshold for cosmic rays.
    prediction : PersistencePrediction, optional
        Predicts the persistence in frames of a NISP detector, which is subtracted. None to leave it in the image; it is
        ignored for other cameras.

    Returns
    -------
    image : ReducedImage
        The calibrated image.
    cards : tuple of Card
        Header of the calibrated image.
    """
    electrons = {"electron": 1.0, "electron/s": frame.scene.exposure_time_s}.get(reduction.unit) or frame.mean_gain
    corrected_effects = frame.applied - set(reduction.without)
    if frame.scene.ramp:
        ramp_effects = () if "nonlinearity" in reduction.without else tuple(corrected_effects)
        image = nisp.calibrate(frame, masters, prediction, ramp_effects, electrons)
    else:
        area = files.corrects_area(frame, reduction.without)
        pattern = calibration.SkyPattern(masters.fringes, area=pixel_area.parameters(frame.scene)[1:] if area else None)
        image = calibration.calibrate(
            frame.electrons(), frame.saturated_pixels(), masters, frame.scene, corrected_effects, electrons, pattern
        )
        del pattern
    # The masters of a large detector take gigabytes, which are required for the next steps.
    del masters
    if reduction.cosmic_rays:
        image = cosmic_rays.flag_hits(image, cosmic_rays.find_hits(image, reduction.cosmic_rays))
    return image, files.reduced_cards(frame, reduction.unit, electrons, reduction.without)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command `truesky reduce`, print a line per calibrated image, and return the exit status.

    `argv` are the arguments of the command; None means the arguments of the process.
    """
    return commands.run("reduce", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Run `truesky reduce` with its parsed arguments, and return the exit status 0; errors are raised as LakeError."""
    out = user_files.check_folder(options.out)
    reduction, settings = _reduction_options(options), _catalogue_settings(options)
    root = layout.resolve_lake(options.lake)
    if options.masters is not None and not options.masters.is_dir():
        remedy = f"make it with truesky masters {options.lake} --out {options.masters}"
        raise BadInput(f"--masters {user_files.format_path(options.masters)}: there is no such folder: {remedy}")
    by_detector = lake_frames.from_lake(root, options.detectors, options.exposures, options.name)
    science = [
        sky_frames for frames in by_detector.values() if (sky_frames := [frame for frame in frames if _sees_sky(frame)])
    ]
    if not science:
        raise BadInput(f"lake {root} has no frame of the sky for these detectors and exposures")
    if settings is not None:
        level2.check_psfs([frame for frames in science for frame in frames])
    all_frames = lake_frames.from_lake(root, options.detectors, (), options.name) if options.exposures else by_detector
    for frames in science:
        exposure, prediction = frames[0].exposure, None
        if frames[0].scene.ramp and "persistence" not in reduction.without:
            prediction = PersistencePrediction(all_frames[exposure.camera, frames[0].detector])
        for frame, load in _with_masters(frames, options.masters, reduction.without):
            image, cards = reduce_frame(frame, load(), reduction, prediction)
            # Create the folder only now, so that missing masters leave no empty folder.
            out.mkdir(parents=True, exist_ok=True)
            path = out / f"{frame.stem}.fits"
            suffix = ""
            if settings is None:
                files.write_image(path, image, cards)
            else:
                suffix = f", {level2.write(path, frame, image, cards, settings)} sources"
            good = image.weight > 0.0
            sky_text = f"sky {np.median(image.image[good]):.5g}" if good.any() else "no good pixel"
            print(f"{path}: {sky_text}, {100.0 * good.mean():.2f} % of the pixels are good{suffix}")
    return 0


def _with_masters(
    frames: Sequence[Frame], folder: Path | None, without: Sequence[str]
) -> Iterator[tuple[Frame, Callable[[], Masters]]]:
    """Yield each frame of a detector with a function that returns its masters (combined bias, dark and flat frames).

    Frames are grouped by band and infrared readout mode. The masters of a CCD are read for each frame, since those of a
    large detector take gigabytes, but their flags are computed once. The masters of an infrared detector are read once.
    BadInput is raised if `folder` is None and `without` does not omit every kind of master.
    """
    groups = [(frame.exposure.band, frame.ramp if frame.scene.ramp else ()) for frame in frames]
    for group in dict.fromkeys(groups):
        group_frames = [frame for frame, frame_group in zip(frames, groups, strict=True) if frame_group == group]
        first = group_frames[0]
        kinds = files.master_kinds(first)
        kinds += tuple({"fringes"} & first.applied)
        if folder is None and not {*without} >= {*kinds}:
            raise BadInput(f"--masters FOLDER is required, or --without {' '.join(kinds)}")
        reader = _infrared_reader if first.scene.ramp else _ccd_reader
        read = reader(folder or Path(), first, without)
        yield from ((frame, partial(read, frame)) for frame in group_frames)


def _infrared_reader(folder: Path, first: Frame, without: Sequence[str]) -> Callable[[Frame], Masters]:
    masters = nisp.read_masters(folder, first, without)
    return lambda _: masters


def _ccd_reader(folder: Path, _: Frame, without: Sequence[str]) -> Callable[[Frame], Masters]:
    flags: list[Array] = []

    def read(frame: Frame) -> Masters:
        masters = files.read_masters(folder, frame, without, flags[0] if flags else None)
        flags[:] = [masters.flags]
        return masters

    return read


def _sees_sky(frame: Frame) -> bool:
    """Return True if the frame is an exposure of the sky; for NISP also of standard stars and planetary nebulae."""
    kind = frame.exposure.image_type
    return kind in SKY_TYPES or (bool(frame.scene.ramp) and registry.CHANNELS[frame.exposure.channel].sees_sky(kind))


def _reduction_options(options: argparse.Namespace) -> ReductionOptions:
    if options.level2 and options.rate:
        raise BadInput("--rate is not allowed with --level2: its images are in counts")
    for name in options.without:
        if name not in files.CORRECTIONS:
            similar = suggestion(name, files.CORRECTIONS)
            raise BadInput(f"--without {name} is not one of {', '.join(files.CORRECTIONS)}{similar}")
    limit = options.cosmic_rays
    if limit is None:
        limit = _COSMIC_RAY_SIGMA if options.level2 else 0.0
    if limit:
        cosmic_rays.check_limit(limit)
    unit = "adu" if options.level2 else "electron/s" if options.rate else "electron"
    return ReductionOptions(unit, tuple(options.without), limit)


def _catalogue_settings(options: argparse.Namespace) -> level2.CatalogueSettings | None:
    default, threshold, pixels = Limits(), options.threshold, options.least_pixels
    limits = Limits(default.threshold if threshold is None else threshold, default.pixels if pixels is None else pixels)
    if not options.level2 and (limits != default or options.aperture is not None):
        raise BadInput("--aperture, --threshold, --least-pixels: without --level2 there is no catalogue")
    return level2.CatalogueSettings(limits, options.aperture) if options.level2 else None


if __name__ == "__main__":
    command.exit_with_status(main)
