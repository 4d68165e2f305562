"""Print images of point sources behind elliptical lenses by lenstronomy, with which the tests compare truesky.

    python -m scripts.lensed_image_references > tests/truesky/variability/lensed_image_references.csv

The packages numpy, astropy and lenstronomy must be installed; truesky is not used. Versions are in the first line of
the file. Each row is an image of a system; the first columns describe the system.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import version

import numpy as np

PACKAGES = ("lenstronomy", "astropy")
# Number of systems, and parameters of the universe (flat, cosmological constant, no radiation).
SYSTEMS, OMEGA_M, HUBBLE = 80, 0.319, 67.0
COLUMNS = (
    "system", "einstein_radius", "axis_ratio", "position_angle", "source_east", "source_north", "z_lens", "z_source",
    "east", "north", "magnification", "delay",
)  # fmt: skip


def systems() -> Iterator[tuple[float, ...]]:
    """Yield random systems: the values of the columns after `system` and before `east`.

    Half of the sources are uniform in the Einstein circle. The others are near the centre, where there are four images.
    Einstein radii are uniform in the logarithm.
    """
    rng = np.random.default_rng(20)
    for number in range(SYSTEMS):
        radius, axis_ratio = 10.0 ** rng.uniform(-0.5, 0.5), rng.uniform(0.3, 0.98)
        offset = radius * np.sqrt(rng.random()) * (1.0 if number % 2 else 0.25)
        phi, angle = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, 180.0)
        z_lens = rng.uniform(0.1, 1.2)
        z_source = z_lens + rng.uniform(0.2, 3.0)
        values = radius, axis_ratio, angle, offset * np.cos(phi), offset * np.sin(phi), z_lens, z_source
        # Rounded, so that the file contains the system exactly.
        yield tuple(round(float(value), 6) for value in values)


def rows() -> Iterator[str]:
    """Yield the lines of the file: versions of the packages, names of the columns, then the images of the systems."""
    yield f"# {', '.join(f'{name} {version(name)}' for name in PACKAGES)}; scripts/lensed_image_references.py"
    yield ",".join(COLUMNS)
    for number, system in enumerate(systems()):
        given = ",".join(f"{value:.6f}" for value in system)
        for image in _images(*system):
            yield f"{number},{given},{','.join(f'{value:.10g}' for value in image)}"


def _images(
    radius: float, axis_ratio: float, angle: float, east: float, north: float, z_lens: float, z_source: float
) -> list[tuple[float, ...]]:
    """Return (east, north, magnification, delay in days) of the images of a source, in the order of arrival."""
    from astropy.cosmology import FlatLambdaCDM
    from lenstronomy.LensModel.lens_model import LensModel
    from lenstronomy.LensModel.Solver.lens_equation_solver import LensEquationSolver
    from lenstronomy.Util.param_util import phi_q2_ellipticity

    cosmology = FlatLambdaCDM(H0=HUBBLE, Om0=OMEGA_M, Tcmb0=0.0)
    model = LensModel(["SIE"], z_lens=z_lens, z_source=z_source, cosmo=cosmology)
    # Its x is north and its y is east, so that angles from x to y are position angles.
    e1, e2 = phi_q2_ellipticity(np.radians(angle), axis_ratio)
    lens = [{"theta_E": radius, "e1": e1, "e2": e2, "center_x": 0.0, "center_y": 0.0}]
    x, y = LensEquationSolver(model).image_position_from_source(
        north, east, lens, solver="lenstronomy", min_distance=0.01 * radius, search_window=5.0 * radius,
        precision_limit=1e-13, num_iter_max=500, magnification_limit=1e-5,
    )  # fmt: skip
    times = model.arrival_time(x, y, lens)
    magnification, order = model.magnification(x, y, lens), np.argsort(times)
    return [(y[i], x[i], magnification[i], times[i] - times[order[0]]) for i in order]


if __name__ == "__main__":
    for line in rows():
        print(line)
