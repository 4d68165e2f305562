"""Read from the lake (folder of stored tables) everything that is needed to render one detector of an exposure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow.compute as pc

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.published import read_back
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.plan import Json
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.inputs import galaxy_library_from_facts, passband_from_facts, stellar_library_from_facts
from truesky.render.camera import detectors
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamp_sizes
from truesky.render.exposure import board_neighbours, visible_sources, visible_spectra
from truesky.render.exposure.records import PreviousExposure, PreviousSky, Rows, Variant
from truesky.render.planning import exposure_chunks, variants
from truesky.render.previous_exposures import ChargeMaps, find_previous_exposures, moving_bodies
from truesky.render.psf import from_file
from truesky.render.sources import catalogue_rows, galaxy_stamps, varying_stars
from truesky.render.sources.catalogue_rows import LENSES
from truesky.render.sources.disc_structure import DiscStructure
from truesky.render.sources.nuclei import read_nuclei
from truesky.render.sources.solar_system import Population
from truesky.render.sources.transients import read_transients
from truesky.request.accuracy import Accuracy
from truesky.request.structure import Arms, Stamps


def load_aim(lake: Folder, facts: Json) -> tuple[Aim, Variant, MissionConfiguration]:
    """Return a detector with its exposure, its settings, and the mission parameters of the request.

    `facts` are the recorded inputs of the image: the request, versions of the input tables, exposure number and name of
    the detector. The second result is the variant: the parameters of telescope and camera, the accuracy, and the
    effects that the user switches on or off, after the changes that belong to this exposure.
    """
    request = facts["request"]
    forced = dict.fromkeys(request["effects"]["on"], True) | dict.fromkeys(request["effects"]["off"], False)
    inputs = {
        name: read.version(lake, name, facts["inputs"][name]) for name in ("exposures", "galaxy_fluxes", "mission")
    }
    numbers, in_exposure = [facts["exposure_id"]], pc.field("exposure_id") == facts["exposure_id"]
    (exposed,) = map(
        ExposureRow.from_row, exposure_chunks.rows(inputs["exposures"], numbers, where=in_exposure).to_pylist()
    )
    mission = read_back(inputs["mission"])
    variant = variants.variant(exposed.settings, mission, Accuracy(**request["accuracy"]), forced)
    detector = detectors.detector(exposed.camera, facts["detector"], variant.mission)
    band = passband_from_facts(lake, inputs["galaxy_fluxes"].manifest["facts"], exposed.band)
    return Aim.from_exposure(exposed, detector, band, request["seed"], request["readout"]), variant, mission


def load_inputs(lake: Folder, facts: Json, charge_maps: ChargeMaps | None = None) -> tuple[Aim, Rows, Variant]:
    """Read everything that is needed to render one detector of an exposure.

    Parameters
    ----------
    lake : Folder
        Lake (folder of stored tables).
    facts : dict
        Recorded inputs of the image: `request` (its settings), `inputs` (version of each input table), `exposure_id`,
        `detector`, and checksums of user files.
    charge_maps : ChargeMaps, optional
        Memory for the charge maps of earlier exposures. By default none are kept.

    Returns
    -------
    aim : Aim
        The detector with its exposure, world coordinate system, passband and effects.
    rows : Rows
        Catalogue rows that may contribute light, and earlier exposures that leave persistence in the detector.
    variant : Variant
        Mission parameters, accuracy, and detector effects that are switched on or off, for this exposure.

    Raises
    ------
    BadInput
        If a file of the user (PSF, moving bodies, galaxy stamps) has changed since its checksum was recorded.
    """
    request, (aim, variant, mission) = facts["request"], load_aim(lake, facts)
    exposed, inputs = aim.exposure, {name: read.version(lake, name, key) for name, key in facts["inputs"].items()}
    number = facts["exposure_id"]
    in_detector = (pc.field("exposure_id") == number) & (pc.field("detector") == facts["detector"])
    (task,) = exposure_chunks.rows(inputs["tasks"], [number], where=in_detector).to_pylist()
    previous_exposures = find_previous_exposures(
        lake, facts, exposed, task["detector"], mission, charge_maps or ChargeMaps()
    )
    check_psf_files(exposed, previous_exposures, facts)
    bodies = moving_bodies(exposed, facts)
    rows = _read_rows(lake, inputs, aim, task, variant, bodies, previous_exposures, request["seed"])
    return aim, _with_structure(rows, request, facts.get("stamps", {})), variant


def check_psf_files(exposed: ExposureRow, previous_exposures: Sequence[object], facts: Json) -> None:
    """Check that the user's PSF files have not changed since their checksums were recorded.

    Parameters
    ----------
    exposed : ExposureRow
        The exposure.
    previous_exposures : sequence
        Previous exposures, whose persistence is drawn, as `find_previous_exposures` returns them.
    facts : dict
        Recorded inputs of the image, with the checksums of PSF files by path in `psf`.

    Raises
    ------
    BadInput
        If a file has changed.
    """
    drawn = [previous.exposure for previous in previous_exposures if isinstance(previous, PreviousExposure)]
    for exposure_row in (exposed, *drawn):
        if exposure_row.psf:
            file = str(from_file.path_for_detector(exposure_row.psf, facts["detector"]))
            if file_sha256(Path(file)) != facts["psf"][file]:
                raise BadInput(f"{file}: has changed since the rendering began")


def _with_structure(rows: Rows, request: Json, files: Mapping[str, str]) -> Rows:
    """Add the request's options for drawing galaxies (spiral arms, images instead of profiles) to catalogue rows.

    `files` has the SHA-256 of the user's library of galaxy images by path, or is empty.
    """
    structure, seed = request.get("structure", {}), request["seed"]
    if "arms" in structure:
        rows = replace(rows, discs=DiscStructure(Arms(**structure["arms"]), seed))
    for file, sha256 in files.items():
        rows = replace(rows, stamps=galaxy_stamps.from_file(Stamps(Path(file), **structure["stamps"]), seed, sha256))
    return rows


def _star_columns(inputs: Mapping[str, read.Version]) -> tuple[str, ...]:
    return varying_stars.add_columns(visible_sources.STAR_COLUMNS, inputs["stars"].schema.names)


def _read_rows(
    lake: Folder,
    inputs: Mapping[str, read.Version],
    aim: Aim,
    task: Json,
    variant: Variant,
    bodies: Callable[[int], Population] | None,
    previous_exposures: tuple[PreviousExposure | PreviousSky, ...],
    seed: int,
) -> Rows:
    """Read the catalogue rows of all sources whose light may reach a detector.

    The rows come from the HEALPix cells that overlap the detector, and from cells around these if the sources are
    bright enough. `task` is the detector's row of the table `tasks`, with these cells. `bodies` computes the positions
    of moving bodies, and `previous_exposures` leave persistence in the detector.
    """
    exposed, detector, band = aim.exposure, aim.detector, aim.band
    margin = aim.channel.margin(detector.section, variant.mission)
    spread = visible_spectra.margin_arcsec(exposed, detector, variant.mission, band, seed)
    extra_reach = max(stamp_sizes.reach(detector.pixel_scale) - margin, spread - margin, 0.0)
    limits = visible_sources.flux_limits(exposed, detector, band, variant)
    catalogues = []
    for rows, fluxes, columns, limit in (
        ("galaxies", "galaxy_fluxes", visible_sources.GALAXY_COLUMNS, limits.far_galaxy),
        ("stars", "star_fluxes", _star_columns(inputs), limits.spikes),
    ):
        bands = visible_spectra.flux_bands(exposed, inputs[fluxes].schema.names)
        versions = inputs[rows], inputs[fluxes]
        catalogues.append(
            catalogue_rows.read_sources(*versions, task, columns, bands, extra_reach, limits.min_flux, limit)
        )
    lenses = None
    if LENSES in inputs:
        deflection = catalogue_rows.max_deflection(inputs["galaxies"])
        lenses = catalogue_rows.read_lenses(inputs[LENSES], task, deflection, extra_reach, limits.min_flux)
        versions = inputs["galaxies"], inputs["galaxy_fluxes"]
        lensed_rows = catalogue_rows.add_lensed_galaxies(catalogues[0][:2], lenses, *versions, task, extra_reach)
        catalogues[0] = *lensed_rows, catalogues[0][2]
    return Rows(
        *catalogues[0][:2],
        *catalogues[1][:2],
        galaxy_library=galaxy_library_from_facts(lake, inputs["galaxy_fluxes"].manifest["facts"]),
        stellar_library=stellar_library_from_facts(lake, inputs["star_fluxes"].manifest["facts"]),
        complete_margin_arcsec=margin + min(complete for *_, complete in catalogues),
        lenses=lenses,
        bodies=bodies,
        previous_exposures=previous_exposures,
        transients=read_transients(inputs, task, extra_reach, (limits.min_point_flux, limits.min_flux)),
        nuclei=read_nuclei(inputs, task, extra_reach, (limits.min_point_flux, limits.min_flux)),
        neighbours=board_neighbours.bright_stars(inputs, aim, variant),
    )
