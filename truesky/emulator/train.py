"""Learn from rendered images how sources are detected and measured, and write the result to a model file.

    truesky train LAKE --out MODEL [--name REQUEST] [--band BAND] [--detectors ..] [--exposures ..]
                  [--masters FOLDER] [--threshold SIGMA] [--least-pixels N] [--aperture FWHM] [--cosmic-rays SIGMA]

Each frame of the sky is calibrated, its sources are detected and measured as by `truesky reduce`, and the detections
are compared with the true sources of the table `rendered_truth`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from lake_schema import user_files
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.store import layout, read
from lake_schema.store.provenance import code_version
from truesky.command_line import commands
from truesky.emulator import examples as example_tables
from truesky.emulator import features, frame_examples, model
from truesky.emulator.frame_examples import FrameExamples, Settings, TrueSources
from truesky.reduction import frames as lake_frames
from truesky.reduction.catalogue import Limits
from truesky.reduction.frames import Frame
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.products import read_back

# Columns of the table `galaxies` from which the sizes of galaxies follow.
SIZE_COLUMNS = (
    "bulge_fraction", "bulge_half_light_radius", "bulge_axis_ratio", "disk_half_light_radius", "disk_axis_ratio",
)  # fmt: skip
# A model of fewer examples is refused: it would have no neighbours of most sources.
_LEAST_EXAMPLES = 1000
_FEW_EXAMPLES = 50_000
_ENDINGS = (".parquet", ".model")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command `truesky train`, print a line per frame, and return the exit status.

    `argv` are the arguments of the command; None means the arguments of the process.
    """
    return commands.run("train", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Run `truesky train` with its parsed arguments, and return the exit status 0; errors are raised as LakeError."""
    path = user_files.check_target(options.out, _ENDINGS)
    settings = _settings(options)
    if options.masters is not None and not options.masters.is_dir():
        raise BadInput(f"--masters {user_files.format_path(options.masters)}: there is no such folder")
    root = layout.resolve_lake(options.lake)
    frames = frames_of_band(root, options.band, options.detectors, options.exposures, options.name)
    samples = []
    for frame, sample in measured_frames(root, frames, settings, options):
        conditions, outcomes = sample.conditions, sample.examples.outcomes
        print(
            f"{frame.stem}: {len(sample.rows)} sources, {int(outcomes.detected.sum())} detected, "
            f"{int(outcomes.blended.sum())} blended, {conditions['unmatched']:.0f} detections of none; "
            f"depth {conditions['depth']:.3f} mag"
        )
        samples.append(sample)
    examples = example_tables.join([sample.examples for sample in samples])
    if len(examples) < _LEAST_EXAMPLES:
        raise BadInput(f"{len(examples)} sources are too few for a model: it needs {_LEAST_EXAMPLES}, better 50,000")
    calibration = {"masters": options.masters is not None, "cosmic_rays": settings.cosmic_rays}
    facts = {**_facts(frames, samples, settings), "calibration": calibration, "faintest": _faintest(samples)}
    digest = model.write_model(path, examples, facts)
    few = f"; better {_FEW_EXAMPLES}" if len(examples) < _FEW_EXAMPLES else ""
    print(
        f"{user_files.format_path(path)}: {len(examples)} examples of {frames[0].exposure.band}{few}, sha256 {digest}"
    )
    return 0


def frames_of_band(
    root: Path, band: str | None, detectors: Sequence[str], exposures: Sequence[int], name: str | None
) -> list[Frame]:
    """Return the frames of the sky in one band of a lake, by exposure and detector.

    Parameters
    ----------
    root : Path
        Root folder of the lake.
    band : str or None
        Name of the passband; None if the lake has frames of one band only.
    detectors : sequence of str
        Names of detectors, or none for all.
    exposures : sequence of int
        Numbers of exposures, or none for all.
    name : str or None
        Name of the request, if the lake has several.

    Returns
    -------
    list of Frame
        At least one frame.

    Raises
    ------
    BadInput
        If there is no such frame, if there are several bands or cameras, or if the light is dispersed.
    """
    by_detector = lake_frames.from_lake(root, detectors, exposures, name)
    frames = [frame for group in by_detector.values() for frame in group if frame.exposure.image_type in SKY_TYPES]
    frames = [frame for frame in frames if frame.exposure.channel != "NISP-S"]
    bands = sorted({frame.exposure.band for frame in frames})
    if not frames:
        raise BadInput(f"lake {root} has no image of the sky: render some with truesky render")
    if band is not None and band not in bands:
        raise BadInput(f"--band {band}: the lake has images in {', '.join(bands)}")
    if band is None and len(bands) > 1:
        raise BadInput(f"--band is required: the lake has images in {', '.join(bands)}")
    frames = [frame for frame in frames if frame.exposure.band == (band or bands[0])]
    if len(cameras := {frame.exposure.camera for frame in frames}) > 1:
        raise BadInput(f"images of several cameras, {', '.join(sorted(cameras))}: select some with --exposures")
    return sorted(frames, key=lambda frame: (frame.exposure.exposure_id, frame.detector))


def measured_frames(
    root: Path, frames: Sequence[Frame], settings: Settings, options: argparse.Namespace
) -> Iterator[tuple[Frame, FrameExamples]]:
    """Yield each frame with its examples.

    Parameters
    ----------
    root : Path
        Root folder of the lake.
    frames : sequence of Frame
        The frames.
    settings : Settings
        Settings of calibration, detection and measurement.
    options : Namespace
        Options of the command: `name` of the request and folder of `masters`.

    Yields
    ------
    Frame, FrameExamples
        The frame and its examples.

    Raises
    ------
    BadInput
        If cosmic rays are to be replaced, and the lake has no noise-free image of a frame.
    """
    products = read.version(root, "products", request=options.name)
    truth = read.version(root, "rendered_truth", request=options.name)
    galaxies = read.version(root, "galaxies", products.manifest["facts"]["inputs"]["galaxies"])
    sizes = galaxies.rows(["id", *SIZE_COLUMNS])
    galaxy_ids, radius = sizes["id"].to_numpy(), galaxy_radius({name: sizes[name].to_numpy() for name in SIZE_COLUMNS})
    order = np.argsort(galaxy_ids)
    images = products.rows(["path", "exposure_id", "detector"], where=pc.field("content") == "noise_free").to_pylist()
    paths = {(row["exposure_id"], row["detector"]): row["path"] for row in images}
    for frame in frames:
        name = paths.get((frame.exposure.exposure_id, frame.detector))
        if name is None and settings.cosmic_rays and not frame.scene.ramp:
            raise BadInput(
                f"no noise-free image of {frame.stem}, with which cosmic rays are found: "
                'add "noise_free" to products.truth of the request, or --cosmic-rays 0'
            )
        sources = true_sources(truth, frame, galaxy_ids[order], radius[order])
        path = None if name is None else read_back.image_file(products, name)
        yield frame, frame_examples.measure(frame, sources, settings, options.masters, path)


def galaxy_radius(columns: dict[str, Float]) -> Float:
    """Return the half-light radii (arcsec) of galaxies with these `SIZE_COLUMNS`, as if they were round."""
    fraction, bulge, bulge_ratio, disk, disk_ratio = (columns[name] for name in SIZE_COLUMNS)
    return features.circular_radius(fraction, (bulge, bulge_ratio), (disk, disk_ratio))


def true_sources(truth: read.Version, frame: Frame, galaxy_ids: Int, radius: Float) -> TrueSources:
    """Return the true sources of a frame.

    Parameters
    ----------
    truth : Version
        Version of the table `rendered_truth`.
    frame : Frame
        The frame.
    galaxy_ids : int array, shape (n,)
        Identifiers of galaxies, ascending.
    radius : float array, shape (n,)
        Their half-light radii in arcsec.

    Returns
    -------
    TrueSources
        All sources with light. Points, and sources that are not in the list, have the radius 0.
    """
    is_here = (pc.field("exposure_id") == frame.exposure.exposure_id) & (pc.field("detector") == frame.detector)
    rows = truth.rows(["id", "x", "y", "mag"], where=is_here & pc.field("mag").is_valid())
    source_ids, x, y, magnitude = (rows[name].to_numpy() for name in ("id", "x", "y", "mag"))
    place = np.minimum(np.searchsorted(galaxy_ids, source_ids), max(len(galaxy_ids) - 1, 0))
    is_galaxy = np.zeros(len(source_ids), bool) if not len(galaxy_ids) else galaxy_ids[place] == source_ids
    is_galaxy &= ~features.is_point(source_ids)
    size = np.zeros(len(source_ids))
    size[is_galaxy] = radius[place[is_galaxy]]
    return TrueSources(source_ids, x, y, magnitude, size)


def _settings(options: argparse.Namespace) -> Settings:
    default = Settings()
    threshold, pixels = options.threshold, options.least_pixels
    limits = Limits(
        default.limits.threshold if threshold is None else threshold,
        default.limits.pixels if pixels is None else pixels,
    )
    sigma = default.cosmic_rays if options.cosmic_rays is None else options.cosmic_rays
    return Settings(limits, default.aperture if options.aperture is None else options.aperture, sigma)


def _facts(frames: Sequence[Frame], samples: Sequence[FrameExamples], settings: Settings) -> dict[str, object]:
    """Return the metadata of a model."""
    conditions = [sample.conditions for sample in samples]
    return {
        "camera": frames[0].exposure.camera, "band": frames[0].exposure.band, "settings": settings.facts(),
        "frames": len(frames), "code": code_version(),
        "unmatched_per_arcmin2": sum(row["unmatched"] for row in conditions) / sum(row["area"] for row in conditions),
        "conditions": {
            name: [min(row[name] for row in conditions), max(row[name] for row in conditions)]
            for name in ("depth", "sky", "psf_area")
        },
    }  # fmt: skip


def _faintest(samples: Sequence[FrameExamples]) -> float:
    """Return the brightness to which all frames with examples have some: the catalogue may end above the limit."""
    brightness = [sample.examples.features.brightness for sample in samples if len(sample.examples)]
    return min(float(values.max()) for values in brightness)
