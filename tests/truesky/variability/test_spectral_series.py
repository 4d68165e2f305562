"""A user's spectral series of type Ia supernovae: it replaces the built-in one, and mistakes are named."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lake_schema.errors import BadInput
from truesky.variability import spectral_series, supernova_templates
from truesky.variability.supernova_templates import KINDS, TYPE_IA

PHASE, WAVELENGTH = np.arange(-10.0, 31.0, 5.0), np.arange(2000.0, 10_001.0, 100.0)


def columns(**changes):
    """Return the columns of a valid file, with some replaced."""
    phase, wavelength = (grid.ravel() for grid in np.meshgrid(PHASE, WAVELENGTH, indexing="ij"))
    flux = np.exp(-0.5 * ((phase - 5.0) / 12.0) ** 2) * (wavelength / 4000.0) ** -2
    return {"phase": phase, "wavelength": wavelength, "flux": flux, **changes}


def written(folder, values):
    path = folder / "series.parquet"
    pq.write_table(pa.table(values), path)
    return path


def test_a_series_is_read_and_normalised(tmp_path):
    template = spectral_series.read(written(tmp_path, columns()))
    np.testing.assert_array_equal(template.phase, PHASE - 5.0)
    at_given = template.flux[2][np.isin(template.wavelength, WAVELENGTH)]
    np.testing.assert_allclose(at_given / at_given[20], (WAVELENGTH / 4000.0) ** -2, rtol=1e-12)
    # Points between the given ones are on straight lines.
    np.testing.assert_allclose(np.diff(template.wavelength), 25.0)
    lines = np.interp(template.wavelength, WAVELENGTH, at_given)
    np.testing.assert_allclose(template.flux[2], lines, rtol=1e-12)


@pytest.mark.parametrize(("step", "resampled"), [(10.0, 10.0), (30.0, 15.0), (45.0, 22.5), (100.0, 25.0)])
def test_given_wavelengths_stay_points_of_the_series(tmp_path, step, resampled):
    """A line in a single point has its height and its flux, whatever the step."""
    wavelength = 2010.0 + step * np.arange(round(6000.0 / step) + 1)
    phase, grid = (values.ravel() for values in np.meshgrid(PHASE, wavelength, indexing="ij"))
    flux = np.exp(-0.5 * ((phase - 5.0) / 12.0) ** 2) * (1.0 + 4.0 * (grid == wavelength[50]))
    template = spectral_series.read(written(tmp_path, {"phase": phase, "wavelength": grid, "flux": flux}))
    np.testing.assert_allclose(np.diff(template.wavelength), resampled)
    at_peak = template.flux[2] / template.flux[2, 0]
    assert at_peak.max() == pytest.approx(5.0)
    assert np.sum(at_peak - 1.0) * resampled == pytest.approx(4.0 * step)


def test_rows_may_be_in_any_order(tmp_path):
    values, order = columns(), np.random.default_rng(2).permutation(len(columns()["phase"]))
    mixed = spectral_series.read(written(tmp_path, {name: column[order] for name, column in values.items()}))
    np.testing.assert_array_equal(mixed.flux, spectral_series.read(written(tmp_path, values)).flux)


def test_unequal_wavelengths_are_interpolated(tmp_path):
    values = columns()
    keep = (values["wavelength"] < 6000.0) | (values["wavelength"] % 200.0 == 0.0)
    template = spectral_series.read(written(tmp_path, {name: column[keep] for name, column in values.items()}))
    np.testing.assert_allclose(np.diff(template.wavelength), 25.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (lambda v: {name: column[1:] for name, column in v.items()}, "lacks the row of phase -10, wavelength 2000"),
        (
            lambda v: {name: np.append(column, column[:1]) for name, column in v.items()},
            "more than one row of phase -10",
        ),
        (lambda v: {**v, "flux": np.where(v["phase"] == 0.0, np.nan, v["flux"])}, "row 162: flux = nan"),
        (lambda v: {**v, "flux": -v["flux"]}, "row 0: flux = -"),
        (lambda v: {**v, "flux": 0.0 * v["flux"]}, "flux is 0 everywhere"),
        (lambda v: {**v, "wavelength": v["wavelength"] + 8000.0}, "do not cover bessell_b"),
        (lambda v: {name: column[:1] for name, column in v.items()}, "at least two phases"),
        (lambda v: {"phase": v["phase"], "flux": v["flux"]}, "wavelength"),
    ],
)
def test_mistakes_of_a_file(tmp_path, changes, message):
    with pytest.raises(BadInput, match=message) as error:
        spectral_series.read(written(tmp_path, changes(columns())))
    assert str(tmp_path) in str(error.value)


def test_a_file_is_recorded_and_must_not_change(tmp_path):
    assert spectral_series.facts(None) == {}
    assert spectral_series.templates_from_facts({}) is supernova_templates.templates()
    path = written(tmp_path, columns())
    recorded = spectral_series.facts(path)
    found = spectral_series.templates_from_facts(recorded)
    assert found.keys() == set(KINDS.values())
    np.testing.assert_array_equal(found[TYPE_IA].phase, PHASE - 5.0)
    written(tmp_path, columns(flux=columns()["flux"] * 2.0))
    with pytest.raises(BadInput, match="has changed since"):
        spectral_series.templates_from_facts(recorded)
