"""Synthetic files in OpenCosmo's layout: header, index and data, or a group of them per slice of a light-cone."""

import h5py
import numpy as np

DEX = "dex(solMass)"
UNITS = {
    "ra": "deg", "dec": "deg", "redshift_true": "", "redshift_obs": "", "lsst_r": "mag(AB)", "gal_id": "",
    "central": "",
    "logmp_obs_host": DEX, "logsm_obs": DEX, "logssfr_obs": "dex(1 / yr)", "bulge_to_total": "",
    "r50_bulge_2d": "kpc", "r50_disk_2d": "kpc", "alpha_bulge": "kpc", "beta_bulge": "kpc", "alpha_disk": "kpc",
    "beta_disk": "kpc", "psi_disk": "",
}  # fmt: skip


def columns(n=200, seed=3, ra=53.1, dec=-27.8):
    """Return values by name of the column."""
    rng = np.random.default_rng(seed)
    z, disk, bulge = rng.uniform(0.05, 2.0, n), rng.uniform(1.0, 6.0, n), rng.uniform(0.5, 3.0, n)
    return {
        "gal_id": 10**15 + 1000 * seed + np.arange(n),
        "central": rng.integers(0, 2, n).astype(np.int32),
        "ra": ra + rng.uniform(-0.1, 0.1, n),
        "dec": dec + rng.uniform(-0.1, 0.1, n),
        "redshift_true": z,
        "redshift_obs": z + 1e-3 * rng.normal(size=n),
        "lsst_r": 22.0 + 5.0 * np.log10(z) + rng.uniform(-1.0, 2.0, n),
        "logmp_obs_host": rng.uniform(11.0, 14.0, n),
        "logsm_obs": rng.uniform(8.0, 11.0, n),
        "logssfr_obs": rng.uniform(-12.0, -9.0, n),
        "bulge_to_total": rng.uniform(0.0, 1.0, n),
        "alpha_disk": disk,
        "beta_disk": disk * rng.uniform(0.2, 1.0, n),
        "r50_disk_2d": 0.765 * disk,
        "alpha_bulge": bulge,
        "beta_bulge": bulge * rng.uniform(0.5, 1.0, n),
        "r50_bulge_2d": 0.765 * bulge,
        "psi_disk": rng.uniform(0.0, 2.0 * np.pi, n),
    }


def write(path, *slices, units=UNITS, kind="diffsky_fits"):
    """Write one slice at the root, or several slices in groups that are named by the number of their step."""
    with h5py.File(path, "w") as file:
        for step, values in enumerate(slices):
            root = file if len(slices) == 1 else file.create_group(str(475 + 12 * step))
            root.create_group("header/file").attrs.update(data_type=kind, is_lightcone=1, origin="HACC")
            root.create_group("header/simulation/cosmology").attrs.update(h=0.6766, omega_m=0.30964, omega_b=0.04897)
            count = len(next(iter(values.values()), ()))
            root.create_group("index/level_0").update({"start": np.zeros(1, int), "size": np.array([count])})
            data = root.create_group("data")
            for name, column in values.items():
                data.create_dataset(name, data=column, chunks=(min(50, len(column)),) if len(column) else None)
                data[name].attrs.update(unit=units.get(name, ""), description=name)
    return path
