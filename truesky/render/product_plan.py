"""The plan of a request's images: which detectors are rendered now, and which keep the images that they have.

RenderInputs   the versions of tables, the mission and the exposures that the images depend on, resolved once
products       the plan of the table `products`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import layout, names, read, reuse
from lake_schema.store.plan import Json, Part, Plan
from lake_schema.store.provenance import code_version
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.products import PRODUCTS
from truesky.render.exposure import persistence
from truesky.render.planning import parts, preconditions, variants
from truesky.render.planning.mission import mission_of
from truesky.render.planning.parts import Chosen
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
from truesky.request import structure
from truesky.request.schema import WRITTEN, Request


@dataclass(frozen=True, slots=True)
class RenderInputs:
    """Tables, mission and exposures that a request's images depend on.

    Attributes
    ----------
    request : Request
        The request.
    mission : MissionConfiguration
        Mission configuration of the request.
    versions : mapping of str to Version
        Versions of the tables that are read, by name.
    published : mapping of str to str
        Key of each product that the request has already, by the name of its part.
    chosen : Chosen
        Exposures, tasks that are asked for, and tasks whose images may be kept.
    exposures : pyarrow.Table
        Rows of `chosen.exposures`, and of earlier exposures that left something in their detectors.
    earlier : mapping of (int, str) to list
        Tasks of these earlier exposures, by exposure and detector.
    """

    request: Request
    mission: MissionConfiguration
    versions: Mapping[str, read.Version]
    published: Mapping[str, str]
    chosen: Chosen
    exposures: pa.Table
    earlier: Mapping[tuple[int, str], Sequence[Json]]

    @classmethod
    def of(cls, lake: Path, request: Request) -> RenderInputs:
        """Resolve the inputs of a request's images.

        Parameters
        ----------
        lake : Path
            Folder of the lake.
        request : Request
            The request.

        Returns
        -------
        RenderInputs
            The inputs.

        Raises
        ------
        BadInput
            If a table is missing or was made for another request, or nothing can be rendered.
        """
        mission, versions = mission_of(request.mission), _versions(lake, request)
        preconditions.refuse_other_plan(versions, request, mission)
        published = reuse.held(lake, PRODUCTS.name, request.name)
        chosen = parts.chosen(versions["exposures"], versions["tasks"], request, exposures_of(published))
        before = parts.before(versions, chosen.exposures, chosen.tasks, variants.missions(mission))
        return cls(request, mission, versions, published, chosen, *before)

    @classmethod
    def of_plan(cls, lake: Path, request: Request, chosen: Chosen) -> RenderInputs:
        """Resolve the inputs of the images of a plan that is not published.

        Parameters
        ----------
        lake : Path
            Folder of the lake.
        request : Request
            The request.
        chosen : Chosen
            Exposures and tasks of the plan.

        Returns
        -------
        RenderInputs
            The inputs. The tables may have been made for another request.

        Raises
        ------
        LakeError
            If a table is missing.
        """
        mission, versions = mission_of(request.mission), _versions(lake, request)
        published = reuse.held(lake, PRODUCTS.name, request.name)
        before = parts.before(versions, chosen.exposures, chosen.tasks, variants.missions(mission))
        return cls(request, mission, versions, published, chosen, *before)

    def with_earlier(self, tasks: Sequence[Json]) -> list[Json]:
        """Tasks, and earlier tasks of the same detectors whose sources are drawn again."""
        if not self.earlier:
            return list(tasks)
        rows = map(ExposureRow.of, self.exposures.to_pylist())
        drawn = {row.exposure_id for row in rows if persistence.is_drawn(row)}
        before = (one for task in tasks for one in self.earlier.get((task["exposure_id"], task["detector"]), ()))
        return [*tasks, *(one for one in before if one["exposure_id"] in drawn)]

    def kept_or_asked(self, asked: Set[str]) -> list[Json]:
        """Tasks whose parts are asked for, and those with images whose PSFs can still be read, in their order."""
        columns = (self.exposures[name].to_pylist() for name in ("exposure_id", "psf"))
        psfs = dict(zip(*columns, strict=True))

        def stays(task: Json) -> bool:
            drawn = [task, *self.earlier.get((task["exposure_id"], task["detector"]), ())]
            files = [from_file.file_of(psf, one["detector"]) for one in drawn if (psf := psfs[one["exposure_id"]])]
            return part_name(task) in self.published and all(file.is_file() for file in files)

        return [task for task in self.chosen.tasks if part_name(task) in asked or stays(task)]


def _versions(lake: Path, request: Request) -> dict[str, read.Version]:
    """Versions of the tables that the images are made of, by name."""
    inputs = {name: read.for_request(lake, name, request.name) for name in INPUTS}
    lenses = _lenses(lake, request, inputs["galaxies"])
    return inputs if lenses is None else {**inputs, LENSES: lenses}


def _lenses(lake: Path, request: Request, galaxies: read.Version) -> read.Version | None:
    """The strong lenses, if there are some; those of another request only where they lie in the same galaxies."""
    if layout.current_key(lake, LENSES) is None:
        return None
    found, own = read.for_request(lake, LENSES, request.name), names.key_of(lake, request.name, LENSES)
    shared = own is None and found.key in names.holders(lake, LENSES).values()
    return None if shared and found.manifest["facts"].get("galaxies") != galaxies.key else found


def products(inputs: RenderInputs) -> Plan:
    """Plan the table `products`.

    Parameters
    ----------
    inputs : RenderInputs
        Inputs of the images.

    Returns
    -------
    Plan
        A part for each detector that is asked for, and for each whose image is kept: it was rendered as it would be
        now.
    """
    facts, exposures = _facts(inputs), inputs.exposures
    asked = {part_name(task) for task in inputs.chosen.asked}
    tasks = inputs.kept_or_asked(asked)
    psfs = psf_files(exposures, inputs.with_earlier(tasks))
    keys = product_keys({**facts, "psf": psfs}, exposures, tasks, inputs.versions, inputs.mission, inputs.earlier)
    made = tuple(
        Part(name, {"exposure_id": task["exposure_id"], "detector": task["detector"], reuse.PRODUCT: key})
        for task, key in zip(tasks, keys, strict=True)
        if (name := part_name(task)) in asked or inputs.published[name] == key
    )
    if len(made) < len(tasks):
        names_ = {part.name for part in made}
        psfs = psf_files(exposures, inputs.with_earlier([task for task in tasks if part_name(task) in names_]))
    return Plan(PRODUCTS, {**facts, "psf": psfs} if psfs else facts, made)


def _facts(inputs: RenderInputs) -> Json:
    """Facts of the plan: all that its images share."""
    request = inputs.request
    facts: dict[str, Any] = {
        "request": request.facts("seed", "noise_seed", "accuracy", "mission", "effects", "truth", *WRITTEN),
        "code": code_version(),
        "mission": inputs.mission.fingerprint,
        "inputs": {name: version.key for name, version in inputs.versions.items()},
    }
    if request.sources is not None:
        # Sources of the tables are the only ones: no bodies move.
        facts["request"]["bodies"] = "none"
    facts["request"].update(structure.facts(request.structure))
    if request.bodies is not None:
        facts["bodies"] = ephemeris_files(request.bodies, inputs.chosen.exposures)
    if request.structure.stamps is not None:
        facts["stamps"] = stamp_files(request.structure.stamps.file)
    return facts
