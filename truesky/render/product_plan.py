"""Plan the table `products` of a request: which detectors are rendered now, and which images are kept.

An image is kept if its key (hash of everything that determines it) has not changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import layout, read, request_links, reuse
from lake_schema.store.plan import Json, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.products import PRODUCTS
from truesky.render.channels.image_types import shared_settings
from truesky.render.exposure import persistence
from truesky.render.planning import exposure_chunks, preconditions, variants
from truesky.render.planning.exposure_chunks import RenderSelection
from truesky.render.planning.mission import mission_of
from truesky.render.planning.preconditions import INPUTS
from truesky.render.products.keys import (
    ephemeris_files,
    exposures_of,
    part_name,
    product_keys,
    psf_files,
    stamp_files,
)
from truesky.render.psf import from_file
from truesky.render.sources.catalogue_rows import LENSES
from truesky.render.sources.nuclei import ACTIVE_NUCLEI
from truesky.render.sources.transients import LENSED_IMAGES, TRANSIENTS
from truesky.request import structure
from truesky.request.schema import IMAGE_OPTIONS, Request
from truesky.running.task_chains import Link, LinkFunction


@dataclass(frozen=True, slots=True)
class RenderInputs:
    """Everything on which the images of a request depend: tables, mission parameters and exposures.

    Attributes
    ----------
    request : Request
        The user's request.
    mission : MissionConfiguration
        Mission parameters of the request.
    versions : mapping of str to Version
        Stored versions of the input tables, by table name.
    published_keys : mapping of str to str
        Key (hash of everything that determines an image) of each image that the request already has, by name of its
        partition of the table `products`.
    selection : RenderSelection
        Exposures and detectors to render, and detectors whose images may be kept.
    exposures : pyarrow.Table
        Rows of the table `exposures` for the exposures of `selection`, and for other exposures of the same cameras,
        among them all earlier ones that leave persistence in their detectors.
    previous_tasks : mapping of (int, str) to list of dict
        Rows of the table `tasks` for the earlier exposures of a detector that leave persistence, by (exposure number,
        detector name).
    """

    request: Request
    mission: MissionConfiguration
    versions: Mapping[str, read.Version]
    published_keys: Mapping[str, str]
    selection: RenderSelection
    exposures: pa.Table
    previous_tasks: Mapping[tuple[int, str], Sequence[Json]]

    @classmethod
    def from_request(cls, lake: Path, request: Request) -> RenderInputs:
        """Find the inputs of a request's images, and check that they fit the request.

        Parameters
        ----------
        lake : Path
            Lake (folder of stored tables), with the plan of the request.
        request : Request
            The user's request.

        Returns
        -------
        RenderInputs
            The inputs.

        Raises
        ------
        BadInput
            If a table is missing or was made for another request, or if truesky can render none of the exposures.
        """
        mission, versions = mission_of(request.mission), input_versions(lake, request)
        preconditions.refuse_other_plan(versions, request, mission)
        published = reuse.reusable_tasks(lake, PRODUCTS.name, request.name)
        selection = exposure_chunks.select_for_rendering(
            versions["exposures"], versions["tasks"], request, exposures_of(published)
        )
        exposures_and_tasks = exposure_chunks.with_previous_exposures(
            versions, selection.exposures, selection.tasks, variants.mission_lookup(mission)
        )
        return cls(request, mission, versions, published, selection, *exposures_and_tasks)

    @classmethod
    def from_plan(cls, lake: Path, request: Request, selection: RenderSelection) -> RenderInputs:
        """Find the inputs of images whose plan (rows of `exposures` and `tasks`) is not stored in the lake.

        Parameters
        ----------
        lake : Path
            Lake (folder of stored tables).
        request : Request
            The user's request.
        selection : RenderSelection
            Planned exposures and detectors.

        Returns
        -------
        RenderInputs
            The inputs. It is not checked whether the tables were made for this request.

        Raises
        ------
        LakeError
            If a table is missing.
        """
        mission, versions = mission_of(request.mission), input_versions(lake, request)
        published = reuse.reusable_tasks(lake, PRODUCTS.name, request.name)
        exposures_and_tasks = exposure_chunks.with_previous_exposures(
            versions, selection.exposures, selection.tasks, variants.mission_lookup(mission)
        )
        return cls(request, mission, versions, published, selection, *exposures_and_tasks)

    def with_previous_tasks(self, tasks: Sequence[Json]) -> list[Json]:
        """Return rows of the table `tasks`, then the rows of earlier exposures that leave persistence in their images.

        The earlier rows have the same detectors. Only earlier exposures whose sources are drawn again are included.
        """
        if not self.previous_tasks:
            return list(tasks)
        rows = map(ExposureRow.from_row, self.exposures.to_pylist())
        drawn = {row.exposure_id for row in rows if persistence.is_drawn(row)}
        previous_tasks = (
            previous_task
            for task in tasks
            for previous_task in self.previous_tasks.get((task["exposure_id"], task["detector"]), ())
        )
        return [*tasks, *(previous_task for previous_task in previous_tasks if previous_task["exposure_id"] in drawn)]

    def requested_or_reusable(self, requested: Set[str]) -> list[Json]:
        """Return the rows of the table `tasks` that are requested, or whose images the request already has.

        `requested` has the partition names of requested images. An existing image is left out if a PSF file from which
        it was made is missing. The order is that of `selection.tasks`.
        """
        columns = (self.exposures[name].to_pylist() for name in ("exposure_id", "psf"))
        psfs = dict(zip(*columns, strict=True))

        def can_reuse(task: Json) -> bool:
            drawn = [task, *self.previous_tasks.get((task["exposure_id"], task["detector"]), ())]
            files = [
                from_file.path_for_detector(psf, drawn_task["detector"])
                for drawn_task in drawn
                if (psf := psfs[drawn_task["exposure_id"]])
            ]
            return part_name(task) in self.published_keys and all(file.is_file() for file in files)

        return [task for task in self.selection.tasks if part_name(task) in requested or can_reuse(task)]

    def chain_links(self) -> LinkFunction:
        """Return the function that gives the place of a task of the table `products` in a chain.

        A chain contains the exposures of a detector in order of time, as long as each one has persistence of earlier
        ones. The tasks of `products` must be among `selection.tasks`.
        """
        rows = {row.exposure_id: row for row in map(ExposureRow.from_row, self.exposures.to_pylist())}
        places: dict[tuple[int, str], tuple[int, float]] = {}
        starts: dict[tuple[Any, ...], int] = {}
        for task in sorted(self.selection.tasks, key=lambda task: _time_order(rows[task["exposure_id"]])):
            row, place = rows[task["exposure_id"]], (task["exposure_id"], task["detector"])
            sequence = row.camera, shared_settings(row.settings), task["detector"]
            if sequence not in starts or not self.previous_tasks.get(place):
                # Exposures without persistence also begin a chain, in which they are alone.
                starts[sequence] = row.exposure_id
            places[place] = starts[sequence], task["seconds"]

        def link(task: Task) -> Link:
            number, detector = task.facts["exposure_id"], task.facts["detector"]
            start, seconds = places[number, detector]
            return Link((start, detector), _time_order(rows[number]), seconds)

        return link


def _time_order(exposure: ExposureRow) -> tuple[float, int]:
    """Return the date and the number of an exposure, by which exposures are sorted."""
    return exposure.mjd, exposure.exposure_id


def input_versions(lake: Path, request: Request) -> dict[str, read.Version]:
    """Return the stored versions of the tables that a request's images are made from, by table name.

    The tables `strong_lenses` and `lensed_images` are included if the lake has them for the request, and `transients`
    and `active_nuclei` if the request has transients or variable sources.
    """
    has_variables = request.universe.variables and request.sources is None
    names = [*INPUTS, *[TRANSIENTS] * (request.transients is not None), *[ACTIVE_NUCLEI] * has_variables]
    inputs = {name: read.input_version(lake, name, request.name) for name in names}
    for name in (LENSES, LENSED_IMAGES):
        version = _optional(lake, name, request, inputs)
        inputs |= {} if version is None else {name: version}
    return inputs


def _optional(lake: Path, table: str, request: Request, inputs: Mapping[str, read.Version]) -> read.Version | None:
    """Return a table of a request that the lake may lack, or None if it has none.

    If only another request has the table, it is used only if it was made from the same versions of its inputs.
    """
    if layout.current_key(lake, table) is None:
        return None
    version, request_key = (
        read.input_version(lake, table, request.name),
        request_links.linked_key(lake, request.name, table),
    )
    shared = request_key is None and version.key in request_links.keys_by_request(lake, table).values()
    # Supernovae of another window, for example, have other images.
    sources = ("galaxies",) if table == LENSES else ("galaxies", LENSES, TRANSIENTS)
    is_same = all(
        version.manifest["facts"].get(name) == (inputs[name].key if name in inputs else None) for name in sources
    )
    return None if shared and not is_same else version


def products(inputs: RenderInputs) -> Plan:
    """Plan the table `products`, which has the images of a request.

    Parameters
    ----------
    inputs : RenderInputs
        Everything on which the images depend.

    Returns
    -------
    Plan
        One partition for each requested detector, and for each detector that already has an image whose inputs have not
        changed. The key (hash) of a partition tells whether an existing image can be kept instead of rendered.
    """
    facts, exposures = _facts(inputs), inputs.exposures
    requested = {part_name(task) for task in inputs.selection.requested}
    tasks = inputs.requested_or_reusable(requested)
    psfs = psf_files(exposures, inputs.with_previous_tasks(tasks))
    keys = product_keys(
        {**facts, "psf": psfs}, exposures, tasks, inputs.versions, inputs.mission, inputs.previous_tasks
    )
    product_parts = tuple(
        Task(name, {"exposure_id": task["exposure_id"], "detector": task["detector"], reuse.PRODUCT: key})
        for task, key in zip(tasks, keys, strict=True)
        if (name := part_name(task)) in requested or inputs.published_keys[name] == key
    )
    if len(product_parts) < len(tasks):
        product_names = {part.name for part in product_parts}
        psfs = psf_files(
            exposures, inputs.with_previous_tasks([task for task in tasks if part_name(task) in product_names])
        )
    return Plan(PRODUCTS, {**facts, "psf": psfs} if psfs else facts, product_parts)


def _facts(inputs: RenderInputs) -> Json:
    """Return the recorded inputs that all images of a request have in common.

    They are the settings of the request, and hashes of the code, mission parameters, input tables and user files.
    """
    request = inputs.request
    facts: dict[str, Any] = {
        "request": request.facts("seed", "noise_seed", "accuracy", "mission", "effects", "truth", *IMAGE_OPTIONS),
        "code": code_version(),
        "mission": inputs.mission.fingerprint,
        "inputs": {name: version.key for name, version in inputs.versions.items()},
    }
    if request.sources is not None:
        # The user has given tables with all sources, so that no moving bodies are added.
        facts["request"]["bodies"] = "none"
    facts["request"].update(structure.facts(request.structure))
    if request.bodies is not None:
        facts["bodies"] = ephemeris_files(request.bodies, inputs.selection.exposures)
    if request.structure.stamps is not None:
        facts["stamps"] = stamp_files(request.structure.stamps.file)
    return facts
