"""Resolve the mission configuration and the user's passbands of a request."""

from lake_schema.errors import BadInput
from lake_schema.mission import configuration
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store.plan import Json
from truesky.fluxes import inputs, passbands
from truesky.fluxes.passbands import Passband
from truesky.request.files import UserCurves
from truesky.request.schema import MissionChoice, Request

# Sections of a request that determine the planned exposures and their costs.
PLAN_SECTIONS = ("seed", "area", "universe", "pointings", "observations", "explore", "truth", "psfs")


def mission_of(choice: MissionChoice) -> MissionConfiguration:
    """Return the mission configuration that a request selects."""
    overrides = {key: (override.value, override.unit) for key, override in choice.overrides}
    return configuration.resolve(ladder=choice.ladder, overrides=overrides, cameras=choice.cameras)


def user_filters(request: Request) -> tuple[dict[str, Passband], Json]:
    """Return the user's passbands that the request observes in, by name, and their sha256 as facts of a plan.

    Raises BadInput if a band has neither an embedded nor a user passband, or if a passband exceeds 1.
    """
    requested = {pointing.band for pointing in request.pointings}
    requested |= {band for block in request.observations if block.table for band in block.table.bands}
    curves = UserCurves(tuple(curve for curve in request.curves.passbands if curve[0] in requested))
    bands, origins = inputs.read_passbands(curves)
    if unknown := sorted(requested - {*bands, *passbands.names()}):
        raise BadInput(f"band {unknown[0]}: truesky has no passband of this name, and the request has no curve for it")
    for name, band in bands.items():
        if band.response.max() > 1.0:
            problem = f"response must be the fraction of photons detected, at most 1, got {band.response.max():.4g}"
            raise BadInput(f"{dict(curves.passbands)[name].location or inputs.FILTER_PREFIX + name}: {problem}")
    return bands, {"files": {key: origin.sha256 for key, origin in origins.items()}} if bands else {}
