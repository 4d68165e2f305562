"""Measure speed and accuracy of band fluxes: python -m benchmarks.fluxes [--quick] [--json FILE] [--measure FILE].

The job that computes fluxes interpolates tables. Here its fluxes are compared with direct integration in steps of 1 A,
in the 22 passbands of Serrano et al. 2024. The sample consists of galaxies with two spectral templates and emission
lines, over the whole parameter space of the tables. Times are CPU seconds of one core. Option --measure writes the
errors for all settings (resolutions of the tables) in all passbands to a file such as
truesky/fluxes/tables/flux_errors.csv, from which the job chooses its settings.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyarrow as pa

from benchmarks.report import best_time, machine
from lake_schema.arrays import Float
from lake_schema.store.provenance import git_commit
from truesky.fluxes import band_fluxes, integration, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.sources import Galaxies, galaxies_from_table
from truesky.fluxes.spectra import lines
from truesky.fluxes.tables import build_tables, flux_tables
from truesky.fluxes.tables.settings import CANDIDATES, choose
from truesky.request.accuracy import DRAFT, SURVEY, Accuracy

BANDS = (
    "euclid_vis", "euclid_y", "euclid_j", "euclid_h", "gaia_g", "gaia_bp", "gaia_rp", "des_g", "des_r", "des_i",
    "des_z", "lsst_u", "lsst_g", "lsst_r", "lsst_i", "lsst_z", "lsst_y", "cfis_u", "cfis_r", "jedis_g", "ps1_i",
    "hsc_z",
)  # fmt: skip

# Seed of the galaxies that are used to choose the resolutions of the tables.
_SEED_CHOICE = 1
# Seed of the galaxies with which the accuracy is tested.
_SEED_TEST = 2
# Seed of the galaxies with which the speed is measured.
_SEED_SPEED = 3
# Number of galaxies with which the accuracy is measured.
_SAMPLE = 20_000
# Number of galaxies with which the speed is measured.
_SPEED_SAMPLE = 200_000
# Number of galaxies of each sample with --quick.
_QUICK = 500
_MAG = 2.5 / np.log(10.0)
# Flux density in microjansky of 1 maggie (AB magnitude 0), the unit of speclite.
_AB_UJY = 3631e6


def sample(n: int, seed: int) -> pa.Table:
    """Return `n` random galaxies with the columns of the table `galaxies` that determine fluxes.

    Redshift, templates, reddening and extinction are uniform over the ranges that the flux tables cover.
    """
    rng = np.random.default_rng(seed)
    frac = rng.uniform(0.0, 1.0, n)
    z = rng.uniform(build_tables.Z_FIRST + 0.001, build_tables.Z_LAST - 0.01, n)
    columns: dict[str, Any] = {
        "id": np.arange(n),
        "ra": rng.uniform(0.0, 360.0, n),
        "dec": np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n))),
        "_healpix_29": np.arange(n),
        "kind": np.zeros(n, np.int8),
        "z_true": np.maximum(z, 0.0),
        "z_obs": z,
        "abs_mag_r01": rng.uniform(-23.0, -16.0, n),
        "mag_r01": rng.uniform(18.0, 26.0, n),
        "frac_1": frac,
        "frac_2": 1.0 - frac,
        "kappa": rng.normal(0.0, 0.02, n),
        "gamma1": rng.normal(0.0, 0.02, n),
        "gamma2": rng.normal(0.0, 0.02, n),
        "a_v": rng.uniform(0.0, build_tables.A_V_LAST, n),
    }
    for k in (1, 2):
        columns[f"sed_{k}"] = rng.integers(0, templates.GALAXY_LIBRARY_SIZE, n).astype(np.int16)
        columns[f"ext_law_{k}"] = rng.integers(0, 5, n).astype(np.int8)
        columns[f"ebv_{k}"] = rng.uniform(0.0, build_tables.EBV_LAST, n)
    for name in lines.columns():
        columns[name] = 10.0 ** rng.uniform(-18.0, -15.5, n)
    return pa.table(columns)


def measure(file: Path, n: int = _SAMPLE, bands: Sequence[str] = ()) -> None:
    """Write the rms and the largest relative error of fluxes for every candidate setting in every passband.

    A setting is the resolution of a flux table in wavelength, E(B-V) and A_V.

    Parameters
    ----------
    file : Path
        CSV file to write; an existing file is replaced.
    n : int, optional
        Number of galaxies whose fluxes are compared with direct integration.
    bands : sequence of str, optional
        Names of the passbands. The default is all passbands.
    """
    library = templates.galaxy_library()
    rows = galaxies_from_table(sample(n, _SEED_CHOICE), library)
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("band", "step", "n_ebv", "n_av", "rms", "largest"))
        for name in bands or passbands.names():
            band = passbands.load(name)
            truth = integration.galaxy_fluxes(rows, [band], library)
            for setting in CANDIDATES:
                grid = flux_tables.open_grid([band], [setting], library)
                error = np.abs(flux_tables.galaxy_fluxes(rows, grid) / truth - 1.0)
                rms, largest = float(np.sqrt(np.mean(error**2))), float(error.max())
                writer.writerow((name, setting.step, setting.n_ebv, setting.n_av, f"{rms:.2e}", f"{largest:.2e}"))
            stream.flush()
            print(name)


def accuracy_of(rows: Galaxies, truth: Float, library: Library, accuracy: Accuracy) -> Float:
    """Return the errors of the fluxes that the job computes for a requested accuracy.

    Parameters
    ----------
    rows : Galaxies
        The galaxies.
    truth : float array, shape (n, 22)
        Fluxes from direct integration in the passbands BANDS, microjansky.
    library : Library
        Library of galaxy spectra.
    accuracy : Accuracy
        Allowed errors.

    Returns
    -------
    float array, shape (n, 22)
        Errors in magnitudes; negative if the flux is too high.

    Notes
    -----
    SystemExit is raised if no table reaches the accuracy in a passband.
    """
    f_nu, _ = _interpolate(rows, library, accuracy)
    return np.asarray(-_MAG * np.log(f_nu / truth))


def _interpolate(rows: Galaxies, library: Library, accuracy: Accuracy) -> tuple[Float, flux_tables.Grid]:
    curves = [passbands.load(name) for name in BANDS]
    settings = [choice.setting for choice in choose(BANDS, accuracy)]
    if missing := [name for name, setting in zip(BANDS, settings, strict=True) if setting is None]:
        raise SystemExit(f"no setting of the flux tables reaches the accuracy in {', '.join(missing)}")
    grid = flux_tables.open_grid(curves, [setting for setting in settings if setting], library)
    return flux_tables.galaxy_fluxes(rows, grid), grid


def speclite_difference(n: int, library: Library) -> float:
    """Return the largest difference (mag) between the fluxes of truesky and of speclite for the same `n` spectra.

    Only the passbands whose curves truesky takes from speclite are compared.
    """
    import astropy.units as u
    from speclite.filters import load_filter

    table = sample(n, _SEED_TEST)
    table = table.set_column(table.column_names.index("mag_r01"), "mag_r01", pa.array(np.full(n, 20.0)))
    worst, grid = 0.0, passbands.grid()
    with (Path(passbands.__file__).with_suffix(".csv")).open(newline="", encoding="utf-8") as stream:
        published = {row["name"]: row["source"] for row in csv.DictReader(stream)}
    spectra_by_medium = {medium: band_fluxes.galaxy_spectra(table, library, medium) for medium in ("air", "vacuum")}
    for name in BANDS:
        kind, _, source = published[name].partition(":")
        if kind != "speclite":
            continue
        band = passbands.load(name)
        spectra = spectra_by_medium[band.medium]
        unit = u.erg / u.s / u.cm**2 / u.AA
        reference_flux = np.array(load_filter(source).get_ab_maggies(spectra * unit, grid * u.AA), float) * _AB_UJY
        ours = band_fluxes.band_fluxes(spectra, [band])[:, 0]
        worst = max(worst, float(np.abs(_MAG * np.log(ours / reference_flux)).max()))
    return worst


def job_speed(n: int) -> float:
    """Return the galaxies per CPU second for which the job computes fluxes in 22 passbands, without Spark.

    The time includes reading the catalogue of `n` galaxies and writing and publishing the table of fluxes.
    """
    from lake_schema import ids, sky
    from lake_schema.store import layout, plan, publish
    from lake_schema.tables.galaxies import GALAXIES
    from truesky.fluxes import compute_fluxes
    from truesky.request import from_toml

    drawn = sample(n, _SEED_SPEED)
    index, ra, dec = sky.random_in_cell(5, 1607, n, np.random.default_rng(_SEED_SPEED))
    columns: dict[str, Any] = {c.name: np.full(n, c.lo or 0.0) for c in GALAXIES.columns if not c.nullable}
    columns |= {name: drawn[name].to_numpy() for name in drawn.column_names}
    columns |= {"ra": ra, "dec": dec, "ra_true": ra, "dec_true": dec, "_healpix_29": index}
    columns |= {"id": ids.source_id(0, 1607 << 6, np.arange(n)), "density_boost": np.ones(n)}
    declared_columns = {
        c.name: np.asarray(columns[c.name]).astype(c.type) for c in GALAXIES.columns if c.name in columns
    }
    rows = GALAXIES.build(declared_columns)
    part = plan.Task(layout.cell_file(5, 1607), {})
    with tempfile.TemporaryDirectory() as folder:
        lake = layout.resolve_lake(Path(folder) / "lake")
        lake.mkdir()
        publish.make_version(lake, plan.Plan(GALAXIES, {}, (part,)), lambda root, facts: plan.Output(rows))
        request = from_toml.from_table(
            {
                "name": "bench",
                "seed": 1,
                "area": {"cone": {"ra": 0.0, "dec": 0.0, "radius": 1.0}},
                "fluxes": {"bands": list(BANDS)},
            }
        )
        step = compute_fluxes.flux_step("galaxy", lake, request)
        seconds = _best_cpu_time(lambda: publish.make_version(lake, step.plan, step.run_task), 1)
    return n / seconds


def stars(n: int) -> dict[str, float]:
    """Return the speed (stars per CPU second) and the largest error (mag) of fluxes of `n` stars in 22 passbands."""
    from truesky.fluxes.sources import Stars

    library = templates.stellar_library()
    rng = np.random.default_rng(_SEED_TEST)
    # Each star is a mixture of four spectral templates, as most stars of the catalogue are.
    rows = Stars(
        rng.integers(0, len(library), (4, n)), rng.dirichlet(np.ones(4), n).T, rng.uniform(5.0, 26.0, n),
        rng.uniform(0.0, build_tables.STAR_A_V_LAST, n),
    )  # fmt: skip
    curves = [passbands.load(name) for name in BANDS]
    fluxes, truth = flux_tables.star_fluxes(rows, curves, library), integration.star_fluxes(rows, curves, library)
    seconds = _best_cpu_time(lambda: flux_tables.star_fluxes(rows, curves, library), 3)
    return {"stars_max_mag": float(np.abs(_MAG * np.log(fluxes / truth)).max()), "stars_per_s_core": n / seconds}


def error_curve(rows: Galaxies, truth: Float, library: Library) -> dict[str, list[float]]:
    """Return the error and the CPU time for each setting (resolution of flux tables), for a figure in a notebook.

    Each setting is used for all 22 passbands.

    Parameters
    ----------
    rows : Galaxies
        The galaxies.
    truth : float array, shape (n, 22)
        Fluxes from direct integration in the passbands BANDS, microjansky.
    library : Library
        Library of galaxy spectra.

    Returns
    -------
    dict of str to list of float
        Lists with one value per setting: `curve_us` (CPU time per galaxy, us), `curve_rms_mag` and `curve_max_mag` (rms
        and largest error, mag), and `curve_mb` (size of the table of one passband, MB).
    """
    curves = [passbands.load(name) for name in BANDS]
    names = ("curve_us", "curve_rms_mag", "curve_max_mag", "curve_mb")
    out: dict[str, list[float]] = {name: [] for name in names}
    for setting in CANDIDATES:
        grid = flux_tables.open_grid(curves, [setting] * len(curves), library)
        error = -_MAG * np.log(flux_tables.galaxy_fluxes(rows, grid) / truth)
        out["curve_us"].append(
            1e6 * _best_cpu_time(lambda grid=grid: flux_tables.galaxy_fluxes(rows, grid), 3) / len(rows)
        )  # type: ignore[misc]
        out["curve_rms_mag"].append(_rms(error))
        out["curve_max_mag"].append(float(np.abs(error).max()))
        out["curve_mb"].append(grid.tables[0].nbytes / 1e6)
    return out


def run(quick: bool) -> dict[str, Any]:
    """Measure speed and accuracy of fluxes, and return all results by name; `quick` uses few galaxies."""
    library = templates.galaxy_library()
    n = _QUICK if quick else _SAMPLE
    curves = [passbands.load(name) for name in BANDS]
    rows = galaxies_from_table(sample(n, _SEED_TEST), library)
    integrated: list[Float] = []
    # Integrate two galaxies before the clock starts, so that the compiled code is loaded.
    integration.galaxy_fluxes(rows.select(np.arange(2)), curves, library)
    integration_s = _best_cpu_time(lambda: integrated.append(integration.galaxy_fluxes(rows, curves, library)), 1)
    truth = integrated[0]
    survey, draft = (accuracy_of(rows, truth, library, accuracy) for accuracy in (SURVEY, DRAFT))
    speed_rows = rows if quick else galaxies_from_table(sample(_SPEED_SAMPLE, _SEED_SPEED), library)
    _, grid = _interpolate(speed_rows, library, SURVEY)
    speed = len(speed_rows) / _best_cpu_time(lambda: flux_tables.galaxy_fluxes(speed_rows, grid), 1 if quick else 5)
    figures: dict[str, Any] = {
        "objects": n,
        "rms_mag_all": _rms(survey),
        "rms_mag_worst_band": max(_rms(error) for error in survey.T),
        "max_mag": float(np.abs(survey).max()),
        "draft_rms_mag_all": _rms(draft),
        "draft_max_mag": float(np.abs(draft).max()),
        "galaxies_per_s_core": speed,
        "integration_galaxies_per_s_core": n / integration_s,
        "speedup_vs_integration": speed * integration_s / n,
        "speedup_vs_whole_spectra": speed * _full_spectrum_seconds(100 if quick else 1000, library),
        "job_galaxies_per_s_core": job_speed(n if quick else _SPEED_SAMPLE),
        "table_mb": max(table.nbytes for table in grid.tables) / 1e6,
        "table_mb_mean": float(np.mean([table.nbytes for table in grid.tables])) / 1e6,
        "build_s": _build_seconds(library, quick),
        "oracle_mag_max": speclite_difference(20 if quick else 200, library),
        **stars(n),
    }
    figures |= {f"rms_mag_{name}": _rms(error) for name, error in zip(BANDS, survey.T, strict=True)}
    for name, accuracy in (("draft", DRAFT), ("survey", SURVEY)):
        _, chosen = _interpolate(rows, library, accuracy)
        seconds = _best_cpu_time(lambda chosen=chosen: flux_tables.galaxy_fluxes(rows, chosen), 1 if quick else 5)  # type: ignore[misc]
        figures[f"{name}_us"] = 1e6 * seconds / n
    return figures if quick else figures | error_curve(rows, truth, library)


def _build_seconds(library: Library, quick: bool) -> float:
    """Return the CPU time (s) to compute the flux tables of the 22 passbands (2 if `quick`) with an empty cache."""
    bands = BANDS[:2] if quick else BANDS
    curves = [passbands.load(name) for name in bands]
    settings = [setting for choice in choose(bands, SURVEY) if (setting := choice.setting) is not None]
    previous_cache = os.environ.get("TRUESKY_CACHE")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TRUESKY_CACHE"] = folder
        try:
            return _best_cpu_time(lambda: flux_tables.open_grid(curves, settings, library), 1)
        finally:
            os.environ.pop("TRUESKY_CACHE")
            if previous_cache is not None:
                os.environ["TRUESKY_CACHE"] = previous_cache


def _full_spectrum_seconds(n: int, library: Library) -> float:
    """Return the CPU time (s) per galaxy to compute 22 fluxes from its whole spectrum, 600 to 24000 A, without tables.

    The spectrum is computed twice, with wavelengths in vacuum and in air. `n` is the number of galaxies.
    """
    table, curves = sample(n, _SEED_TEST), [passbands.load(name) for name in BANDS]

    def work() -> None:
        for start in range(0, n, 50):
            for medium in ("vacuum", "air"):
                f_lambda = band_fluxes.galaxy_spectra(table.slice(start, 50), library, medium)
                band_fluxes.band_fluxes(f_lambda, [band for band in curves if band.medium == medium])

    return _best_cpu_time(work, 1) / n


def _rms(error: Float) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _best_cpu_time(work: Callable[[], object], repeats: int) -> float:
    """Return the shortest CPU time (s) of several calls of a function."""
    return best_time(work, repeats, time.process_time)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    parser = argparse.ArgumentParser(prog="benchmarks.fluxes", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few objects, for tests")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--measure", type=Path, metavar="FILE")
    options = parser.parse_args(argv)
    if options.measure:
        measure(options.measure, _QUICK if options.quick else _SAMPLE)
        return 0
    figures = run(options.quick)
    for name, value in figures.items():
        print(f"{name:34} {', '.join(f'{v:.3g}' for v in value) if isinstance(value, list) else f'{value:,.4g}'}")
    if options.json:
        header = {"name": "fluxes", "commit": git_commit(), "machine": machine()}
        options.json.write_text(
            json.dumps({**header, "repeats": 1 if options.quick else 5, **figures}, indent=1) + "\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
