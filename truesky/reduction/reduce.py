"""Calibrated images from the raw frames of a lake: bias, dark, response of the amplifiers, flat, vignetting.

    python -m truesky.reduction.reduce --lake LAKE [--name REQUEST] --masters FOLDER --out FOLDER [--detectors ..]
                                 [--exposures ..] [--rate] [--without ..] [--cosmic-rays SIGMA]
                                 [--level2 [--aperture ARCSEC] [--threshold SIGMA] [--least-pixels N]]

A file a frame that sees the sky, with the extensions SCI (electrons, e-/s or, of level 2, counts of the mean gain), WHT
(inverse variance) and FLG (bits). Of level 2 a catalogue of its sources, its PSF and a .head lie beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lake_schema import command, user_files
from lake_schema.errors import BadInput
from lake_schema.fits.images import Card
from lake_schema.store import layout
from truesky.reduction import calibration, cosmic_rays, files, level2
from truesky.reduction import frames as lake_frames
from truesky.reduction.calibration import Masters, ReducedImage
from truesky.reduction.catalogue import Limits
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.reduction.infrared.persistence_prediction import PersistencePrediction
from truesky.render.channels import registry
from truesky.render.channels.image_types import SKY_TYPES

# Of a level 2 where none is asked for: van Dokkum 2001.
_COSMIC_RAY_SIGMA = 4.5


@dataclass(frozen=True, slots=True)
class ReductionOptions:
    """What is made of a frame.

    unit        : of the pixels: electron, electron/s or adu
    without     : of files.UNDONE what is left as it is
    cosmic_rays : standard deviations above which they are found, 0 = they are not looked for
    """

    unit: str = "electron"
    without: tuple[str, ...] = ()
    cosmic_rays: float = 0.0


def reduce_frame(
    frame: Frame, masters: Masters, reduction: ReductionOptions, prediction: PersistencePrediction | None = None
) -> tuple[ReducedImage, tuple[Card, ...]]:
    """A frame with the masters of its detector: the image and its header.

    frame, masters, wish : what is made of it with what
    foreseen : what earlier exposures leave in a detector of NISP; None: that is left as it is
    """
    electrons = {"electron": 1.0, "electron/s": frame.scene.exposure_time_s}.get(reduction.unit) or frame.mean_gain
    corrected_effects = frame.applied - set(reduction.without)
    if frame.scene.ramp:
        ramp_effects = () if "nonlinearity" in reduction.without else tuple(corrected_effects)
        image = nisp.calibrate(frame, masters, prediction, ramp_effects, electrons)
    else:
        fringes = frame.fringes() if "fringes" in corrected_effects else None
        image = calibration.calibrate(
            frame.electrons(), frame.saturated_pixels(), masters, frame.scene, corrected_effects, electrons, fringes
        )
    if reduction.cosmic_rays:
        image = cosmic_rays.flag_hits(image, cosmic_rays.find_hits(image, reduction.cosmic_rays))
    return image, files.reduced_cards(frame, reduction.unit, electrons, reduction.without)


def main(argv: Sequence[str] | None = None) -> int:
    """Prints a line an image."""
    parser = argparse.ArgumentParser(prog="truesky reduce", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lake", required=True, help="folder of the lake, with rendered frames")
    parser.add_argument("--name", help="of the request whose frames are meant, where the lake has several")
    parser.add_argument(
        "--masters", type=Path, help="folder that truesky.reduction.masters has written, or of your own"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the calibrated images")
    parser.add_argument("--detectors", nargs="+", default=[], metavar="NAME", help="default: all")
    parser.add_argument("--exposures", nargs="+", type=int, default=[], metavar="ID", help="default: all")
    parser.add_argument("--rate", action="store_true", help="electrons a second instead of those of the exposure")
    parser.add_argument("--without", nargs="+", default=[], choices=files.CORRECTIONS, help="what is left as it is")
    parser.add_argument(
        "--cosmic-rays", type=float, metavar="SIGMA", help=f"flag them; with --level2 {_COSMIC_RAY_SIGMA:g}, 0 = no"
    )
    parser.add_argument("--level2", action="store_true", help="in counts, with sources, PSF and .head beside")
    parser.add_argument("--aperture", type=float, metavar="ARCSEC", help="diameter of MAG_APER (3 FWHM)")
    parser.add_argument("--threshold", type=float, default=Limits().threshold, metavar="SIGMA", help="of sources (1.5)")
    parser.add_argument("--least-pixels", type=int, default=Limits().pixels, metavar="N", help="of a source (5)")
    options = parser.parse_args(argv)
    return command.run("reduce", lambda: _write_images(options))


def _write_images(options: argparse.Namespace) -> int:
    out = user_files.check_folder(options.out)
    reduction, settings = _reduction_options(options), _catalogue_settings(options)
    root = layout.resolve_lake(options.lake)
    by_detector = lake_frames.from_lake(root, options.detectors, options.exposures, options.name)
    science = [
        sky_frames for frames in by_detector.values() if (sky_frames := [frame for frame in frames if _sees_sky(frame)])
    ]
    if not science:
        raise BadInput(f"lake {options.lake} has no such frame that sees the sky")
    if settings is not None:
        level2.check_psfs([frame for frames in science for frame in frames])
    out.mkdir(parents=True, exist_ok=True)
    all_frames = lake_frames.from_lake(root, options.detectors, (), options.name) if options.exposures else by_detector
    for frames in science:
        exposure, prediction = frames[0].exposure, None
        if frames[0].scene.ramp and "persistence" not in reduction.without:
            prediction = PersistencePrediction(all_frames[exposure.camera, frames[0].detector])
        for frame, masters in _with_masters(frames, options.masters, reduction.without):
            image, cards = reduce_frame(frame, masters, reduction, prediction)
            path = out / f"{frame.stem}.fits"
            suffix = ""
            if settings is None:
                files.write_image(path, image, cards)
            else:
                suffix = f", {level2.write(path, frame, image, cards, settings)} sources"
            good = image.weight > 0.0
            sky_text = f"sky {np.median(image.image[good]):.5g}" if good.any() else "no pixel is good"
            print(f"{path}: {sky_text}, {100.0 * good.mean():.2f} % of the pixels are good{suffix}")
    return 0


def _with_masters(
    frames: Sequence[Frame], folder: Path | None, without: Sequence[str]
) -> Iterator[tuple[Frame, Masters]]:
    """Frames of a detector with its masters, which are read once a band, and a ramp."""
    groups = [(frame.exposure.band, frame.ramp if frame.scene.ramp else ()) for frame in frames]
    for group in dict.fromkeys(groups):
        group_frames = [frame for frame, frame_group in zip(frames, groups, strict=True) if frame_group == group]
        kinds = files.master_kinds(group_frames[0])
        if folder is None and not {*without} >= {*kinds}:
            raise BadInput(f"--masters: which folder? Or --without {' '.join(kinds)}")
        masters = (nisp.read_masters if group_frames[0].scene.ramp else files.read_masters)(
            folder or Path(), group_frames[0], without
        )
        yield from ((frame, masters) for frame in group_frames)


def _sees_sky(frame: Frame) -> bool:
    """Of NISP standard stars and nebulae, too."""
    kind = frame.exposure.image_type
    return kind in SKY_TYPES or (bool(frame.scene.ramp) and registry.CHANNELS[frame.exposure.channel].sees_sky(kind))


def _reduction_options(options: argparse.Namespace) -> ReductionOptions:
    if options.level2 and options.rate:
        raise BadInput("--rate: images of level 2 are in counts")
    limit = options.cosmic_rays
    if limit is None:
        limit = _COSMIC_RAY_SIGMA if options.level2 else 0.0
    if limit:
        cosmic_rays.check_limit(limit)
    unit = "adu" if options.level2 else "electron/s" if options.rate else "electron"
    return ReductionOptions(unit, tuple(options.without), limit)


def _catalogue_settings(options: argparse.Namespace) -> level2.CatalogueSettings | None:
    limits = Limits(options.threshold, options.least_pixels)
    if not options.level2 and (limits != Limits() or options.aperture is not None):
        raise BadInput("--aperture, --threshold, --least-pixels: without --level2 there is no catalogue")
    return level2.CatalogueSettings(limits, options.aperture) if options.level2 else None


if __name__ == "__main__":
    command.exit_with_status(main)
