"""Compute the key of the images of each detector (a hash of everything that determines them), and their names.

An image is rendered again only if its key changes.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType

import pyarrow as pa

from lake_schema import user_files
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import read
from lake_schema.store.plan import Json
from lake_schema.store.provenance import digest, file_sha256
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera import detectors
from truesky.render.camera.detectors import Detector
from truesky.render.channels import registry
from truesky.render.drawing import stamp_sizes
from truesky.render.effects.readout import detector_crosstalk
from truesky.render.exposure import board_neighbours, persistence
from truesky.render.planning import variants
from truesky.render.psf import from_file
from truesky.render.sources import catalogue_rows, ephemerides, galaxy_stamps, selection
from truesky.render.sources.catalogue_rows import CATALOGUES, CELLS, FARTHEST, LENSES
from truesky.render.sources.transients import CHANGING_TABLES, TRANSIENTS
from truesky.request.accuracy import SURVEY

# Function of an exposure and the name of a detector. It returns the checksums of the catalogue files of stars on
# neighbouring detectors, as a dictionary for the recorded inputs of the image.
NeighbourFiles = Callable[[ExposureRow, str], Json]


def product_keys(
    facts: Json,
    exposures: pa.Table,
    tasks: Sequence[Json],
    inputs: Mapping[str, read.Version],
    mission: MissionConfiguration,
    previous_tasks: Mapping[tuple[int, str], Sequence[Json]] = MappingProxyType({}),
) -> list[str]:
    """Return for each detector the key of its images: a hash of all inputs that determine them, and of nothing else.

    Parameters
    ----------
    facts : dict
        Recorded inputs of all images: settings of the request, mission, code version, and checksums of user files.
    exposures : pyarrow.Table
        Rows of the table `exposures` for the detectors and for the earlier exposures.
    tasks : sequence of dict
        Rows of the table `tasks`, one per detector to be rendered.
    inputs : mapping of str to Version
        Stored versions of the input tables, by table name.
    mission : MissionConfiguration
        Mission database: parameters of the telescopes, cameras and survey.
    previous_tasks : mapping of (int, str) to sequence of dict
        Rows of the table `tasks` for earlier exposures that leave persistence in a detector, by (exposure number,
        detector name).

    Returns
    -------
    list of str
        One key per row of `tasks`, in the same order.
    """
    flux_facts = inputs["galaxy_fluxes"].manifest["facts"]
    shared = {key: facts[key] for key in ("request", "mission", "code")}
    shared["library"] = [flux_facts.get("files"), flux_facts.get("sources")]
    if TRANSIENTS in inputs and (series := inputs[TRANSIENTS].manifest["facts"].get("light_curves")):
        shared["light_curves"] = series["sha256"]
    rows = {row.exposure_id: row for row in map(ExposureRow.from_row, exposures.to_pylist())}
    files = {
        name: (catalogue_rows.max_deflection(inputs[name]), _files_of_cells(inputs[name], inputs[fluxes]))
        for name, fluxes in CATALOGUES
    }
    for name in filter(inputs.__contains__, (LENSES, *CHANGING_TABLES)):
        files[name] = catalogue_rows.max_deflection(inputs["galaxies"]), _files_of_cells(inputs[name])

    def catalogue_files(task: Json) -> list[list[tuple[str, ...]]]:
        exposure, detector = rows[task["exposure_id"]], task["detector"]
        reach = stamp_sizes.reach(detectors.detector(exposure.camera, detector, mission).pixel_scale)
        reaches = {name: reach for name in files}
        reaches["galaxies"] = max(FARTHEST, reach)
        channel = registry.CHANNELS[exposure.channel]
        # The image also depends on files of stars far from the detector if diffraction spikes are drawn, or if a grism
        # displaces light.
        if channel.diffraction_edges is not None or channel.dispersion is not None:
            reaches["stars"] = max(FARTHEST, reach)
        if channel.dispersion is not None:
            reaches |= dict.fromkeys((LENSES, *CHANGING_TABLES), max(FARTHEST, reach))
        checksums = []
        for name, (deflection, files_by_cell) in files.items():
            cells = selection.cells_within_reach(task, deflection, reaches[name])
            checksums.append(sorted({of_file for cell in cells for of_file in files_by_cell.get(cell, ())}))
        return checksums

    neighbour_files = _neighbour_files(files["stars"], mission)

    def facts_of_task(task: Json) -> Json:
        return {
            "exposure": asdict(rows[task["exposure_id"]]),
            "task": {name: task[name] for name in ("detector", "cells", "radius")},
            "catalogues": catalogue_files(task) if task["cells"] else [],
            **(neighbour_files(rows[task["exposure_id"]], task["detector"]) if task["cells"] else {}),
            **_user_file_checksums(facts, rows[task["exposure_id"]], task["detector"]),
        }

    def facts_of_previous(task: Json) -> Json:
        row = rows[task["exposure_id"]]
        return facts_of_task(task) if persistence.is_drawn(row) else {"exposure": asdict(row)}

    def previous_facts_of(task: Json) -> list[Json]:
        return [facts_of_previous(t) for t in previous_tasks.get((task["exposure_id"], task["detector"]), ())]

    previous = map(previous_facts_of, tasks)
    extras = ({"earlier": previous_facts} if previous_facts else {} for previous_facts in previous)
    return [digest({**shared, **facts_of_task(task), **extra}) for task, extra in zip(tasks, extras, strict=True)]


def part_name(task: Json) -> str:
    """Return the name of the partition of the table `products` for a detector, such as "000012-3-4.parquet".

    `task` has the exposure number and the name of the detector.
    """
    return f"{task['exposure_id']:06d}-{task['detector'].lower()}.parquet"


def exposures_of(names: Iterable[str]) -> set[int]:
    """Return the exposure numbers in names of partitions of the table `products`; other names are ignored."""
    return {int(number) for name in names if (number := name.partition("-")[0]).isdigit()}


def _neighbour_files(
    stars: tuple[float, Mapping[int, list[tuple[str, ...]]]], mission: MissionConfiguration
) -> NeighbourFiles:
    """Return a function that lists the files of stars which change an image by crosstalk from other detectors.

    These are catalogue files with stars on detectors that share a readout board with the image's detector. `stars` is a
    pair: the largest distance (deg) between a star and the order-8 HEALPix cell under which it is stored, and the
    checksums of the star files by number of the cell.
    """
    boards: dict[tuple[str, str, str | None], tuple[Detector, ...]] = {}

    def files_of_neighbours(exposure: ExposureRow, detector: str) -> Json:
        if detector_crosstalk.EFFECT not in (
            registry.find_effects_or_none(exposure.channel, exposure.image_type) or ()
        ):
            return {}
        key = exposure.camera, detector, exposure.settings
        if key not in boards:
            variant_mission = variants.variant(exposure.settings, mission, SURVEY, {}).mission
            boards[key] = board_neighbours.other_detectors(exposure.camera, detector, variant_mission)
        places = [board_neighbours.detector_circle(exposure, neighbour) for neighbour in boards[key]]
        cells = {cell for place in places for cell in selection.cells_within_reach(place, stars[0], 0.0)}
        checksums = sorted({checksum for cell in cells for checksum in stars[1].get(cell, ())})
        return {"beside": checksums} if checksums else {}

    return files_of_neighbours


def _user_file_checksums(facts: Json, exposure: ExposureRow, detector: str) -> Json:
    """Return the SHA-256 of the user's files from which an image is made: PSF, moving bodies and galaxy stamps.

    `facts` has the checksums of all user files of the request; only those that matter for this detector are returned.
    """
    files = {}
    if psf := exposure.psf:
        files["psf"] = facts["psf"][str(from_file.path_for_detector(psf, detector))]
    if "bodies" in facts and registry.CHANNELS[exposure.channel].sees_bodies(exposure.image_type):
        (files["bodies"],) = facts["bodies"].values()
    if "stamps" in facts:
        (files["stamps"],) = facts["stamps"].values()
    return files


def psf_files(exposures: pa.Table, tasks: Sequence[Json]) -> dict[str, str]:
    """Return the SHA-256 of the user's PSF files for some detectors, by path.

    `tasks` are rows of the table `tasks`. The result is {} if their exposures use no PSF files; a missing file raises
    an error.
    """
    psf_by_exposure = dict(zip(exposures["exposure_id"].to_pylist(), exposures["psf"].to_pylist(), strict=True))
    pairs = {(psf_by_exposure[task["exposure_id"]], task["detector"]) for task in tasks}
    files = [from_file.path_for_detector(psf, detector) for psf, detector in pairs if psf]
    return {str(file): file_sha256(user_files.check_file(file, "PSF")) for file in files}


def ephemeris_files(file: Path, exposures: pa.Table) -> dict[str, str]:
    """Return the SHA-256 of the user's table of Solar System bodies, as {path: hash}.

    Raises BadInput if the table is invalid, or has no bodies on the days of the exposures that show such bodies.
    """
    sha256 = file_sha256(user_files.check_file(file, "table of bodies", "solar_system.bodies"))
    rows = map(ExposureRow.from_row, exposures.to_pylist())
    dates = [row.mjd for row in rows if registry.CHANNELS[row.channel].sees_bodies(row.image_type)]
    ephemerides.check(ephemerides.read(file, sha256), file, dates)
    return {str(file): sha256}


def stamp_files(file: Path) -> dict[str, str]:
    """Return the SHA-256 of the user's library of galaxy images, as {path: hash}.

    Raises BadInput if the library is invalid.
    """
    sha256 = file_sha256(user_files.check_file(file, galaxy_stamps.KIND, "structure.stamps.file"))
    galaxy_stamps.read(file, sha256)
    return {str(file): sha256}


def _files_of_cells(*tables: read.Version) -> Mapping[int, list[tuple[str, ...]]]:
    """Return for each order-8 HEALPix cell the SHA-256 of the catalogue files with its sources.

    `tables` are a catalogue and tables with the same partitions, such as its fluxes. Each partition that contains the
    cell gives one tuple, with the hash of its file in each table.
    """
    files_by_cell: dict[int, list[tuple[str, ...]]] = defaultdict(list)
    for part in tables[0].manifest["parts"]:
        checksums = tuple(table.partition_sha256(part["name"]) for table in tables)
        for cell in part["facts"][CELLS]:
            files_by_cell[cell].append(checksums)
    return files_by_cell
