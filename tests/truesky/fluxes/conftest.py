"""Libraries and catalogues that the tests of fluxes share."""

import numpy as np
import pyarrow as pa
import pytest

from truesky.fluxes.libraries import templates
from truesky.fluxes.spectra import lines


@pytest.fixture(scope="session")
def library():
    return templates.galaxy_library()


@pytest.fixture(scope="session")
def stars_library():
    return templates.stellar_library()


@pytest.fixture
def galaxies():
    """Return a function that makes random rows of `galaxies` with columns for spectra; arguments override them."""

    def make(n: int = 20, seed: int = 1, **columns) -> pa.Table:
        rng = np.random.default_rng(seed)
        frac = rng.uniform(0.0, 1.0, n)
        values = {
            "id": np.arange(100, 100 + n),
            "ra": rng.uniform(0.0, 360.0, n),
            "dec": rng.uniform(-90.0, 90.0, n),
            "_healpix_29": np.arange(n),
            "kind": rng.choice([0, 1, 4], n).astype(np.int8),
            "z_true": rng.uniform(0.01, 2.3, n),
            "abs_mag_r01": rng.uniform(-23.0, -16.0, n),
            "mag_r01": rng.uniform(18.0, 28.0, n),
            "frac_1": frac,
            "frac_2": 1.0 - frac,
            "kappa": rng.normal(0.0, 0.02, n),
            "gamma1": rng.normal(0.0, 0.02, n),
            "gamma2": rng.normal(0.0, 0.02, n),
            "a_v": rng.gamma(2.0, 0.1, n),
        }
        values["z_obs"] = values["z_true"]
        for k in (1, 2):
            values[f"sed_{k}"] = rng.integers(0, 31, n)
            values[f"ext_law_{k}"] = rng.integers(0, 5, n)
            values[f"ebv_{k}"] = rng.uniform(0.0, 0.6, n)
        for name in lines.columns():
            values[name] = 10.0 ** rng.uniform(-18.0, -15.0, n)
        fixed = {name: np.full(n, value) if np.ndim(value) == 0 else value for name, value in columns.items()}
        return pa.table(values | fixed)

    return make


@pytest.fixture
def bare(galaxies):
    """Return galaxies of one template without lines, dust, lensing and Milky Way extinction."""

    def make(n: int = 1, **columns) -> pa.Table:
        nothing = dict.fromkeys(
            [
                "kappa",
                "gamma1",
                "gamma2",
                "a_v",
                "ebv_1",
                "ebv_2",
                "ext_law_1",
                "ext_law_2",
                "frac_2",
                *lines.columns(),
            ],
            0.0,
        )
        return galaxies(n, **(nothing | {"frac_1": 1.0} | columns))

    return make


@pytest.fixture
def stars(stars_library):
    """Return a function that makes random rows of the table `stars`."""

    def make(n: int = 20, seed: int = 2, **columns) -> pa.Table:
        rng = np.random.default_rng(seed)
        values = {
            "id": np.arange(n),
            "ra": rng.uniform(0.0, 360.0, n),
            "dec": rng.uniform(-90.0, 90.0, n),
            "_healpix_29": np.arange(n),
            "sed": rng.integers(0, len(stars_library), n),
            "mag_h": rng.uniform(5.0, 26.0, n),
            "a_v": rng.gamma(2.0, 0.2, n),
        }
        fixed = {name: np.full(n, value) if np.ndim(value) == 0 else value for name, value in columns.items()}
        return pa.table(values | fixed)

    return make
