"""Fit a table of stellar isochrones, and write the coefficients to truesky/catalogue/stars/isochrones.csv.

    python scripts/fit_isochrones.py ISOCHRONES [--test OTHER ...] [--out FILE]

ISOCHRONES is a Parquet or CSV file with one row per point and the columns metallicity ([M/H]), log_age (log10 yr), eep
(equivalent evolutionary point, numbered as in Dotter 2016), initial_mass (Msun), log_teff (K) and log_l (Lsun). The
isochrones of MIST (https://waps.cfa.harvard.edu/MIST) have these columns under other names. OTHER is a table with the
same columns, except eep; the hottest stars of its old isochrones are compared with the hottest stars of the fit.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyarrow.parquet

import lake_schema  # noqa: F401  (restricts numpy, imported later, to common CPU instructions)

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lake_schema.arrays import Float
from truesky.catalogue.stars import isochrones as model

NAMES = ("metallicity", "log_age", "eep", "initial_mass", "log_teff", "log_l")
SOURCE = """# Fit to MIST isochrones, v/v_crit = 0.4: Choi et al. 2016, ApJ 823, 102; Dotter 2016, ApJS 222, 8.
# A row is a point of evolution at a knot of log age; columns are coefficients of powers 0 .. 4 of [M/H]:
# log10 L / Lsun, log10 Teff / K; mass: log10 of the mass that leaves the main sequence, Msun, then log10 of the
# differences of initial mass between points, in units of it."""
# Smallest difference of the initial masses of two points, relative to the turn-off mass. Smaller differences are
# rounding errors of the tables, and are replaced by this value.
_MIN_MASS_DIFFERENCE = 1e-5


def read(path: Path) -> dict[str, Float]:
    """Return the columns of a Parquet or CSV file that NAMES lists, as float64 arrays; missing columns are left out."""
    table = pyarrow.parquet.read_table(path) if path.suffix == ".parquet" else pyarrow.csv.read_csv(path)
    return {name: table[name].to_numpy().astype(float) for name in NAMES if name in table.column_names}


def sample_isochrones(table: dict[str, Float]) -> tuple[Float, Float, dict[str, Float]]:
    """Interpolate each isochrone at the fixed points of evolution that the fit uses.

    These points are fixed initial masses on the main sequence, then equivalent evolutionary points. Isochrones outside
    the range of age and metallicity of the fit are left out.

    Parameters
    ----------
    table : dict of str to float array, shape (n,)
        Columns of the table by the names in NAMES.

    Returns
    -------
    age, metallicity : float array, shape (k,)
        log10 age in yr, and [M/H], of each isochrone.
    samples : dict of str to float array, shape (k, points)
        `log_l` (log10 L / Lsun), `log_teff` (log10 K) and `mass`. `mass` is NaN on the main sequence, except at its
        last point (log10 of the turn-off mass, Msun). At later points it is log10 of the difference of initial mass to
        the point before, relative to the turn-off mass.
    """
    age = table["log_age"]
    inside = (age > model.AGES[0] - 1e-6) & (age < model.AGES[-1] + 1e-6)
    inside &= (table["metallicity"] >= model.min_metallicity(age)) & (table["metallicity"] <= model.METALLICITIES[-1])
    rows = {name: values[inside] for name, values in table.items()}
    key = np.stack([rows["metallicity"], rows["log_age"]], 1)
    isochrone_keys, isochrone_index = np.unique(key, axis=0, return_inverse=True)
    samples: dict[str, list[Float]] = {"log_l": [], "log_teff": [], "mass": []}
    for k in range(len(isochrone_keys)):
        isochrone = {name: values[isochrone_index.ravel() == k] for name, values in rows.items()}
        evolved = isochrone["eep"] >= model.PHASES[0]
        mass = np.interp(model.PHASES, isochrone["eep"], isochrone["initial_mass"])
        main_masses = np.concatenate(
            [
                model.FIXED_MASSES,
                model.FIXED_MASSES[-1] * (mass[0] / model.FIXED_MASSES[-1]) ** np.array(model.UPPER_FRACTIONS),
            ]
        )
        main = ~evolved | (isochrone["eep"] == model.PHASES[0])
        for name in ("log_l", "log_teff"):
            values = [np.interp(main_masses, isochrone["initial_mass"][main], isochrone[name][main])]
            values += [np.interp(model.PHASES[1:], isochrone["eep"], isochrone[name])]
            samples[name].append(np.concatenate(values))
        mass_steps = np.log10(np.maximum(np.diff(mass) / mass[0], _MIN_MASS_DIFFERENCE))
        samples["mass"].append(np.concatenate([np.full(main_masses.size - 1, np.nan), [np.log10(mass[0])], mass_steps]))
    return isochrone_keys[:, 1], isochrone_keys[:, 0], {name: np.array(values) for name, values in samples.items()}


def fit_coefficients(age: Float, metallicity: Float, values: Float) -> Float:
    """Fit a property of isochrones by least squares, as a function of age and metallicity at each point of evolution.

    The function is a polynomial in [M/H] at each knot (fixed value) of log age, and linear in log age between knots.

    Parameters
    ----------
    age, metallicity : float array, shape (k,)
        log10 age in yr, and [M/H], of each isochrone.
    values : float array, shape (k, points)
        Values to fit, such as log10 Teff.

    Returns
    -------
    float array, shape (points, knots, powers)
        Coefficients of the powers 0, 1, ... of [M/H] at each knot of log age.
    """
    knot, weight = model.bracket_age(age)
    shares = np.zeros((age.size, len(model.AGES)))
    shares[np.arange(age.size), knot] = 1.0 - weight
    shares[np.arange(age.size), knot + 1] += weight
    powers = metallicity[:, None] ** np.arange(model.DEGREE + 1)
    design = (shares[:, :, None] * powers[:, None, :]).reshape(age.size, -1)
    solution, *_ = np.linalg.lstsq(design, values, rcond=None)
    return solution.T.reshape(values.shape[1], len(model.AGES), model.DEGREE + 1)


def write(path: Path, coefficients: dict[str, Float], comments: list[str]) -> None:
    """Write the coefficients of the fit to a CSV file, with its sources as comments at the top.

    Parameters
    ----------
    path : Path
        File to write; an existing file is replaced.
    coefficients : dict of str to float array, shape (points, knots, powers)
        Coefficients by name of the fitted property (log_l, log_teff, mass). Cells of NaN stay empty.
    comments : list of str
        Lines about the errors of the fit, written below the sources.
    """
    powers = range(model.DEGREE + 1)
    lines = [SOURCE, *(f"# {line}" for line in comments)]
    lines.append(",".join(["point", "log_age", *(f"{name}_{k}" for name in coefficients for k in powers)]))
    names = (
        [f"m{m:g}" for m in model.FIXED_MASSES]
        + [f"u{u:g}" for u in model.UPPER_FRACTIONS]
        + [f"e{e}" for e in model.PHASES[1:]]
    )
    for p, name in enumerate(names):
        for a, age in enumerate(model.AGES):
            cells = [f"{v:.4f}" if np.isfinite(v) else "" for values in coefficients.values() for v in values[p, a]]
            lines.append(",".join([name, f"{age:g}", *cells]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def residuals(age: Float, metallicity: Float, samples: dict[str, Float]) -> list[str]:
    """Describe the differences between the fit in `model.TABLE` and the isochrones, as text.

    Parameters
    ----------
    age, metallicity : float array, shape (k,)
        log10 age in yr, and [M/H], of each isochrone.
    samples : dict of str to float array, shape (k, points)
        log_teff (log10 K) and log_l (log10 L / Lsun) at the points of the fit, from `sample_isochrones`.

    Returns
    -------
    list of str
        One line per range of age and phase of evolution, with the rms and the largest difference of Teff (%) and of the
        bolometric magnitude.
    """
    fit = model.isochrones(10.0 ** (age - 9.0), metallicity)
    main, comments = fit.main_sequence, []
    phases = {"main sequence": slice(0, main), "to the tip of the giant branch": slice(main, main + model.FLASH),
              "core helium burning and later": slice(main + model.FLASH, None)}  # fmt: skip
    for low, high in ((7.8, 9.0), (9.0, 9.6), (9.6, 10.2)):
        in_age_range = (age >= low - 1e-6) & (age <= high + 1e-6)
        for name, part in phases.items():
            off_t = 100.0 * np.log(10.0) * (fit.log_teff - samples["log_teff"])[in_age_range, part]
            off_l = 2.5 * (fit.log_l - samples["log_l"])[in_age_range, part]
            comments.append(
                f"log age {low} .. {high}, {name}: Teff {off_t.std():.1f} % rms, {np.abs(off_t).max():.1f} % at most; "
                f"M_bol {off_l.std():.2f} mag rms, {np.abs(off_l).max():.2f} at most"
            )
    return comments


def compare_hottest(path: Path) -> list[str]:
    """Compare the hottest stars of old isochrones in another table with the hottest stars of the fit.

    Return one line of text for each of five pairs of age and metallicity that the table in `path` contains.
    """
    table, comments = read(path), []
    for age, metals in ((12.5, -2.0), (12.5, -1.5), (10.0, -1.0), (10.0, -0.5), (5.0, 0.0)):
        ages = np.unique(table["log_age"])
        nearest = ages[np.argmin(np.abs(ages - 9.0 - np.log10(age)))]
        selected = (np.abs(table["log_age"] - nearest) < 1e-6) & (np.abs(table["metallicity"] - metals) < 1e-6)
        selected &= (table["log_l"] < 1.2) & (table["log_teff"] < 4.2) & (table["initial_mass"] > 0.6)
        if selected.any():
            k = np.flatnonzero(selected)[table["log_teff"][selected].argmax()]
            ours = model.isochrones([10.0 ** (nearest - 9.0)], [metals])
            at = ours.log_teff[0, : ours.main_sequence].argmax()
            theirs = f"{10.0 ** table['log_teff'][k]:.0f} K of {table['initial_mass'][k]:.3f} Msun"
            fit_text = f"{10.0 ** ours.log_teff[0, at]:.0f} K of {ours.mass[0, at]:.3f}"
            comments.append(f"{path.stem} {metals:g} {age:g} Gyr: hottest {theirs}, ours {fit_text}")
    return comments


def main() -> int:
    """Run the command and return its exit status, 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("isochrones", type=Path)
    parser.add_argument("--test", type=Path, nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=model.TABLE)
    options = parser.parse_args()
    age, metallicity, samples = sample_isochrones(read(options.isochrones))
    coefficients = {name: fit_coefficients(age, metallicity, values) for name, values in samples.items()}
    write(options.out, coefficients, [])
    model.TABLE = options.out
    comments = residuals(age, metallicity, samples)
    write(options.out, coefficients, comments)
    print("\n".join([*comments, *(line for path in options.test for line in compare_hottest(path))]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
