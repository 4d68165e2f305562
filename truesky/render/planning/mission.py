"""Find the mission parameters and the user's passbands that belong to a request."""

from lake_schema.errors import BadInput
from lake_schema.mission import configuration
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store.plan import Json
from truesky.fluxes import inputs, passbands
from truesky.fluxes.passbands import Passband
from truesky.request.files import UserCurves
from truesky.request.schema import MissionChoice, Request

# Sections of a user's request on which the planned exposures, and the CPU time to render them, depend. If one changes,
# the exposures must be planned again.
PLAN_SECTIONS = ("seed", "area", "universe", "pointings", "observations", "explore", "truth", "psfs")


def mission_of(choice: MissionChoice) -> MissionConfiguration:
    """Return the parameters of the mission (telescopes, cameras, survey) that a request selects.

    A parameter may have several values in the mission database, with statuses such as "measured" or "required". The
    request gives the order in which statuses are preferred. It may also replace values, and add its own cameras.
    """
    overrides = {key: (override.value, override.unit) for key, override in choice.overrides}
    return configuration.resolve(ladder=choice.ladder, overrides=overrides, cameras=choice.cameras)


def user_filters(request: Request) -> tuple[dict[str, Passband], Json]:
    """Return the user's passbands in which the request has pointings, and the SHA-256 of their files.

    The passbands are a dict by name. The hashes are {"files": {"fluxes.passbands.NAME": hash}}, or {} without
    passbands of the user; they become part of the recorded inputs of the plan. Raises BadInput if neither truesky nor
    the request has a response curve for a band, or if a response is above 1.
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
