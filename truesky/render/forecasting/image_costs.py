"""Add up the forecast costs of planned images while a plan is made, chunk by chunk, to save memory."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, cached_property
from importlib.resources import files
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.channels import registry
from truesky.render.exposure import truth_maps
from truesky.render.forecasting.preparation import PsfKey
from truesky.render.planning import preconditions, tasks, variants
from truesky.render.planning.mission import mission_of
from truesky.request.schema import Request

# Rows of the table `exposures` and rows of the table `tasks` (one per detector) that belong to them.
PlanRows = tuple[pa.Table, pa.Table]
# Columns of the two tables by which images with the same PSF are grouped.
_EXPOSURE_COLUMNS = ("exposure_id", "camera", "band", "image_type", "settings")
_GROUP = ("channel", "camera", "band", "image_type", "settings", "detector")


@cache
def run_costs() -> dict[str, Any]:
    """Return the measured costs of a run outside its tasks: the contents of run_costs.toml."""
    return tomllib.loads((files("truesky.render.forecasting") / "run_costs.toml").read_text(encoding="utf-8"))


class ImageCosts:
    """Sums of the forecast costs of the images that a request selects, over the chunks of its plan.

    Parameters
    ----------
    request : Request
        The request, with the detectors to render from the command line.

    Attributes
    ----------
    detectors, exposures : int
        Number of images of detectors to render, and of all planned exposures.
    planned : int
        Number of all planned images of detectors.
    seconds : float
        CPU seconds of the reference machine.
    longest_s : float
        CPU seconds of the image that takes longest.
    bytes : float
        Size of the image files, after compression if the request has it, of the tables of drawn sources, and of PSFs.
    memory_gb : float
        Largest peak memory of a process that renders an image, in GB.
    channels : set of str
        Names of the channels of the images.
    """

    def __init__(self, request: Request) -> None:
        self.request = request
        self.detectors = self.exposures = self.planned = 0
        self.seconds = self.longest_s = self.bytes = self.memory_gb = 0.0
        self.channels: set[str] = set()
        self._selection = tasks.TaskSelection(request)
        self._kinds: set[tuple[str, ...]] = set()

    def watch(self, chunks: Iterable[PlanRows]) -> Iterator[PlanRows]:
        """Yield the chunks of a plan unchanged, and add each one to the sums."""
        for exposures, rows in chunks:
            self.add(exposures, rows)
            yield exposures, rows

    def add(self, exposures: pa.Table, rows: pa.Table) -> None:
        """Add a chunk of a plan: rows of the table `exposures`, and the rows of the table `tasks` for them."""
        self.exposures += exposures.num_rows
        self.planned += rows.num_rows
        requested = self._selection.select(preconditions.renderable_tasks(exposures, rows))
        if not requested.num_rows:
            return
        self.detectors += requested.num_rows
        self.seconds += float(pc.sum(requested["seconds"]).as_py())
        self.longest_s = max(self.longest_s, float(pc.max(requested["seconds"]).as_py()))
        self.memory_gb = max(self.memory_gb, float(pc.max(requested["memory"]).as_py()))
        self.channels |= {*requested["channel"].unique().to_pylist()}
        joined = requested.select(["exposure_id", "channel", "detector"]).join(
            exposures.select(_EXPOSURE_COLUMNS), "exposure_id"
        )
        groups = joined.group_by(_GROUP).aggregate([])
        self._kinds |= {tuple(row[name] for name in _GROUP) for row in groups.to_pylist()}
        self._add_bytes(requested, exposures)

    def _add_bytes(self, requested: pa.Table, exposures: pa.Table) -> None:
        joined = requested.select(["exposure_id", "channel", "bytes", "sources"]).join(
            exposures.select(["exposure_id", "image_type"]), "exposure_id"
        )
        sums = joined.group_by(["channel", "image_type"]).aggregate(
            [("bytes", "sum"), ("sources", "sum"), ("bytes", "count")]
        )
        tables = run_costs()["tables"]
        for row in sums.to_pylist():
            channel = registry.CHANNELS[row["channel"]]
            sees_sky = channel.sees_sky(row["image_type"])
            if self.request.compression != "none":
                self.seconds += row["bytes_sum"] * run_costs()["compression"]["byte_s"]
            kind, readout = (row["channel"], row["image_type"]), self.request.readout
            self.bytes += row["bytes_sum"] * size_ratio(*kind, self.request.compression, readout, self.request.truth)
            self.bytes += tables["image_bytes"] * row["bytes_count"]
            if sees_sky:
                self.bytes += tables["source_bytes"] * row["sources_sum"]
            if sees_sky and channel.dispersion is None:
                self.bytes += tables["psf_bytes"] * row["bytes_count"]
            if sees_sky and channel.dispersion is not None:
                spectra = min(row["sources_sum"], tables["most_spectra"] * row["bytes_count"])
                self.bytes += tables["spectrum_bytes"] * spectra

    def psfs(self) -> set[PsfKey]:
        """Return the PSFs that the images need, without PSFs in the user's files."""
        lookup = variants.mission_lookup(self._mission)
        user_bands = dict(self.request.psfs)
        return {
            PsfKey(channel, camera, detector, band, lookup(settings))
            for channel, camera, band, image_type, settings, detector in self._kinds
            if registry.CHANNELS[channel].sees_sky(image_type) and band not in user_bands
        }

    @cached_property
    def _mission(self) -> MissionConfiguration:
        return mission_of(self.request.mission)


def size_ratio(name: str, image_type: str, compression: str, readout: str, truth: Sequence[str]) -> float:
    """Return the size of the files of images and truth maps relative to that without compression.

    Parameters
    ----------
    name, image_type : str
        Channel and type of the images.
    compression, readout, truth : str, str, sequence of str
        Compression, form of the images, and names of the truth maps, as the request has them.

    Returns
    -------
    float
        1 without compression.
    """
    if compression == "none":
        return 1.0
    channel, ratios = registry.CHANNELS[name], run_costs()["compression"]
    map_ratios = ratios["maps"]
    effects = channel.with_readout(readout).effects.get(image_type) or ()
    maps = truth_maps.available_maps(truth, [effect.name for effect in effects], channel.sees_sky(image_type))
    parts = [(channel.cost.file_bytes_per_pixel, ratios[name])]
    parts += [(truth_maps.BYTES_PER_PIXEL[m], map_ratios.get(m, 1.0)) for m in maps]
    return float(sum(size * ratio for size, ratio in parts) / sum(size for size, _ in parts))
