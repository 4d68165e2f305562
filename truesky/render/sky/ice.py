"""Loss of light by thin ice on the optics of Euclid, which grows for months until a mirror is heated."""

from __future__ import annotations

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration


def transmission(band: str, mjd: float, mission: MissionConfiguration) -> float:
    """Return the fraction of the light that passes the ice on the optics of Euclid.

    Parameters
    ----------
    band : str
        Band or grism band of Euclid, such as "euclid_vis".
    mjd : float
        Date of the exposure (MJD).
    mission : MissionConfiguration
        Mission database, with the curve of the loss, and the factor by which it is multiplied.

    Returns
    -------
    float
        1 without ice. Before the first and after the last date of the curve, its first or last value applies. A band
        that the curve lacks, such as one of the user, has no loss.

    Raises
    ------
    BadInput
        If the factor makes the loss 1 or more at this date.
    """
    amount = mission.value("plm.ice", "")
    if amount == 0.0:
        return 1.0
    rows = mission.rows("plm.ice_loss")
    dates, losses = ([float(row.get(name, "0")) for row in rows] for name in ("mjd", band))
    loss = amount * float(np.interp(mjd, dates, losses))
    if loss >= 1.0:
        raise BadInput(f"mission: plm.ice = {amount:g}: ice would absorb all light of {band} on MJD {mjd:g}")
    return 1.0 - loss
