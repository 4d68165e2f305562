"""Giants of the Milky Way's components, from the isochrones of the catalogue."""

import numpy as np
import pytest

from truesky.catalogue.stars import milky_way
from truesky.variability.pulsation import StarProperties

GIANT = 1


def giants(component, n):
    """Return n giants of a component of the model, and the number of giants per kpc^3 for which each stands."""
    galaxy = milky_way.milky_way()
    own = galaxy.pieces.take(slice(galaxy.first[component, 0], galaxy.first[component, -1]))
    own = own.take(own.stage == GIANT)
    rng = np.random.default_rng(component)
    chosen, along = rng.choice(own.number.size, n, p=own.number / own.number.sum()), rng.random(n)

    def at(ends):
        return ends[0, chosen] + (ends[1, chosen] - ends[0, chosen]) * along

    track = own.track[chosen]
    metallicity = galaxy.tracks.metallicity[track] + galaxy.width[track] * (rng.random(n) - 0.5)
    stars = StarProperties(
        10.0 ** at(own.log_teff),
        at(own.log_g),
        10.0 ** at(own.log_mass),
        metallicity,
        at(own.m_h),
        np.ones(n, bool),
    )
    return stars, 1e9 * own.number.sum() / n


@pytest.fixture(scope="session")
def halo():
    return giants(2, 300_000)


@pytest.fixture(scope="session")
def thin_disc():
    return giants(0, 500_000)
