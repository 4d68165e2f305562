"""Find the earlier exposures that leave persistence in a detector, and keep their charge maps in memory.

The charge map of an exposure is read from the catalogue and drawn when it is first needed. It does not depend on the
later exposure, so that a process that renders several exposures of a detector draws each map once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pyarrow.compute as pc

from lake_schema.arrays import Float32
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.plan import Json
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.inputs import galaxy_library_from_facts, passband_from_facts, stellar_library_from_facts
from truesky.render.camera import detectors
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim
from truesky.render.exposure import persistence, visible_sources, visible_spectra
from truesky.render.exposure.records import PreviousExposure, PreviousSky, Rows
from truesky.render.planning import exposure_chunks, variants
from truesky.render.sources import catalogue_rows, ephemerides, solar_system, varying_stars
from truesky.render.sources.catalogue_rows import LENSES
from truesky.render.sources.nuclei import read_nuclei
from truesky.render.sources.solar_system import Population
from truesky.render.sources.transients import read_transients
from truesky.request.accuracy import Accuracy

# Environment variable with the memory in MB that a process may use to keep charge maps.
SETTING = "TRUESKY_CHARGE_MAPS"
# Memory for charge maps, MB, if $TRUESKY_CHARGE_MAPS is not set. It is enough for the exposures of the previous two
# hours: 30 maps of a NISP detector.
DEFAULT_LIMIT_MB = 500.0
_MB = 1e6


class ChargeMaps:
    """Charge maps of the exposures of one plan that a process keeps in memory, up to a limit.

    If memory is short, maps of other detectors are removed first, then those of the earliest exposures. When a detector
    is rendered in order of time, maps that no later exposure needs are thus the first to be removed.

    Parameters
    ----------
    limit_mb : float
        Largest memory of all maps together, MB (1e6 bytes). 0 to keep none.

    Notes
    -----
    A pickled instance contains no maps, so that each Spark task starts without maps.
    """

    def __init__(self, limit_mb: float = 0.0) -> None:
        self.limit_mb = limit_mb
        self._maps: dict[tuple[str, float, int], Float32] = {}

    @classmethod
    def from_environment(cls) -> ChargeMaps:
        """Return an empty memory with the limit in $TRUESKY_CHARGE_MAPS (MB), else 500 MB.

        Raises BadInput if the variable is not a number >= 0.
        """
        text = os.environ.get(SETTING, "").strip()
        if not text:
            return cls(DEFAULT_LIMIT_MB)
        with suppress(ValueError):
            limit_mb = float(text)
            if limit_mb >= 0.0:
                return cls(limit_mb)
        raise BadInput(f"${SETTING} = {text!r} must be a number of MB >= 0 (0: keep no charge maps)")

    @property
    def megabytes(self) -> float:
        """Memory of the kept maps, MB."""
        return sum(charge.nbytes for charge in self._maps.values()) / _MB

    def get(self, exposure: ExposureRow, detector: str, draw: Callable[[], Float32]) -> Float32:
        """Return the charge map of an exposure, and keep it if the limit allows.

        Parameters
        ----------
        exposure : ExposureRow
            The exposure.
        detector : str
            Name of the detector.
        draw : callable
            Function without arguments that draws the map. It is called if the map is not in memory.

        Returns
        -------
        float32 array, shape (ny, nx)
            Expected electrons, read-only.
        """
        key = detector, exposure.mjd, exposure.exposure_id
        if key in self._maps:
            return self._maps[key]
        charge = draw()
        charge.flags.writeable = False
        self._maps[key] = charge
        for removed in sorted(self._maps, key=lambda kept: (kept[0] == detector, *kept[1:])):
            if self.megabytes <= self.limit_mb:
                break
            del self._maps[removed]
        return charge

    def __reduce__(self) -> tuple[type[ChargeMaps], tuple[float]]:
        return ChargeMaps, (self.limit_mb,)


def moving_bodies(exposure: ExposureRow, facts: Json) -> Callable[[int], Population] | None:
    """Return the function that gives the moving bodies of an exposure, or None for the random population of truesky.

    `facts` are the recorded inputs of the images, with the checksum of the user's table of bodies. Raises BadInput if
    this file has changed.
    """
    bodies = solar_system.empty_population if facts["request"].get("bodies") == "none" else None
    if registry.CHANNELS[exposure.channel].sees_bodies(exposure.image_type):
        for file, sha256 in facts.get("bodies", {}).items():
            if file_sha256(Path(file)) != sha256:
                raise BadInput(f"{file}: has changed since the rendering began")
            bodies = ephemerides.read(Path(file), sha256).on_day
    return bodies


def find_previous_exposures(
    lake: Folder,
    facts: Json,
    exposed: ExposureRow,
    detector: str,
    mission: MissionConfiguration,
    charge_maps: ChargeMaps,
) -> tuple[PreviousExposure | PreviousSky, ...]:
    """Find the earlier exposures that leave persistence in a detector.

    Parameters
    ----------
    lake : Folder
        Lake (folder of stored tables).
    facts : dict
        Recorded inputs of the image (see `detector_inputs.load_inputs`).
    exposed : ExposureRow
        Exposure to be rendered.
    detector : str
        Name of the detector to be rendered.
    mission : MissionConfiguration
        Mission parameters of the request.
    charge_maps : ChargeMaps
        Memory for the charge maps.

    Returns
    -------
    tuple of PreviousExposure or PreviousSky
        The exposures in order of time: with the function that draws their charge map, or only with their sky level if
        truesky cannot render them. It is empty if the channel has no persistence.
    """
    if registry.CHANNELS[exposed.channel].persistence_effect is None:
        return ()
    inputs = {name: read.version(lake, name, key) for name, key in facts["inputs"].items()}
    mission_for = variants.mission_lookup(mission)
    start_mjd = exposed.mjd - persistence.window_days(exposed.camera, mission_for(exposed.settings))
    in_window = (pc.field("mjd") >= start_mjd) & (pc.field("mjd") <= exposed.mjd)
    same_camera = pc.field("camera") == exposed.camera
    candidates = exposure_chunks.rows(
        inputs["exposures"], dates=(start_mjd, exposed.mjd), where=in_window & same_camera
    ).to_pylist()
    rows = {row.exposure_id: row for row in map(ExposureRow.from_row, candidates)}
    in_detector = pc.field("exposure_id").isin(list(rows)) & (pc.field("detector") == detector)
    tasks = exposure_chunks.rows(inputs["tasks"], rows, where=in_detector).to_pylist()
    previous_tasks = persistence.previous_tasks(tasks, rows, mission_for)[exposed.exposure_id, detector]
    charges = _Charges(lake, inputs, facts, mission, charge_maps)
    return tuple(
        PreviousExposure(row, charges.of_task(row, previous_task))
        if persistence.is_drawn(row := rows[previous_task["exposure_id"]])
        else PreviousSky(row)
        for previous_task in previous_tasks
    )


@dataclass(frozen=True, slots=True)
class _Charges:
    """Draws charge maps of earlier exposures.

    Attributes
    ----------
    lake : Folder
        Lake (folder of stored tables).
    inputs : mapping of str to Version
        Stored versions of the tables from which images are made, by table name.
    facts : dict
        Recorded inputs of the images (see `detector_inputs.load_inputs`).
    mission : MissionConfiguration
        Mission parameters of the request.
    charge_maps : ChargeMaps
        Memory for the maps.
    """

    lake: Folder
    inputs: Mapping[str, read.Version]
    facts: Json
    mission: MissionConfiguration
    charge_maps: ChargeMaps

    def of_task(self, exposure: ExposureRow, task: Json) -> Callable[[], Float32]:
        """Return the function that gives the charge map of an exposure; `task` is its row of the table `tasks`."""
        return lambda: self.charge_maps.get(exposure, task["detector"], lambda: self._draw(exposure, task))

    def _draw(self, exposure: ExposureRow, task: Json) -> Float32:
        request = self.facts["request"]
        forced = dict.fromkeys(request["effects"]["on"], True) | dict.fromkeys(request["effects"]["off"], False)
        variant = variants.variant(exposure.settings, self.mission, Accuracy(**request["accuracy"]), forced)
        detector = detectors.detector(exposure.camera, task["detector"], variant.mission)
        band = passband_from_facts(self.lake, self.inputs["galaxy_fluxes"].manifest["facts"], exposure.band)
        aim = Aim.from_exposure(exposure, detector, band, request["seed"])
        rows = self._read_rows(aim, task, variant.mission)
        return persistence.draw_charge_map(aim, rows, variant, request["seed"])

    def _read_rows(self, aim: Aim, task: Json, mission: MissionConfiguration) -> Rows:
        """Read the sources of an earlier exposure that are bright enough to leave persistence, and its strong lenses.

        `task` is the row of the table `tasks` for the detector and exposure of `aim`, and `mission` has the mission
        parameters of this exposure.
        """
        exposure, detector, inputs, seed = aim.exposure, aim.detector, self.inputs, self.facts["request"]["seed"]
        min_flux = persistence.min_flux(exposure, persistence.brightest_column_fraction(aim, mission))
        spectral_reach = visible_spectra.margin_arcsec(exposure, detector, mission, aim.band, seed)
        extra_reach = max(spectral_reach - aim.channel.margin(detector.section, mission), 0.0)
        # Read the columns of spectra for exposures through a grism only. In other images, sources with persistence are
        # assumed to have flat f_nu.
        is_dispersed = aim.channel.dispersion is not None
        shapes = visible_sources.GALAXY_COLUMNS if is_dispersed else visible_sources.SHAPE_COLUMNS
        star_columns = varying_stars.add_columns(visible_sources.STAR_COLUMNS, inputs["stars"].schema.names)
        versions = inputs["galaxies"], inputs["galaxy_fluxes"]
        galaxies, stars = (
            catalogue_rows.read_bright(
                inputs[rows],
                inputs[fluxes],
                [catalogue_rows.BrightQuery(task, columns, exposure.band, min_flux, extra_reach)],
            )[0]
            for (rows, fluxes), columns in zip(catalogue_rows.CATALOGUES, (shapes, star_columns), strict=True)
        )
        lenses = None
        if LENSES in inputs:
            deflection = catalogue_rows.max_deflection(inputs["galaxies"])
            lenses = catalogue_rows.read_lenses(inputs[LENSES], task, deflection, extra_reach, min_flux)
            galaxies = catalogue_rows.add_lensed_galaxies(galaxies, lenses, *versions, task, extra_reach)
        return Rows(
            *galaxies,
            *stars,
            lenses=lenses,
            transients=read_transients(inputs, task, extra_reach, (min_flux, min_flux)),
            nuclei=read_nuclei(inputs, task, extra_reach, (min_flux, min_flux)),
            bodies=moving_bodies(exposure, self.facts),
            galaxy_library=galaxy_library_from_facts(self.lake, inputs["galaxy_fluxes"].manifest["facts"]),
            stellar_library=stellar_library_from_facts(self.lake, inputs["star_fluxes"].manifest["facts"]),
        )
