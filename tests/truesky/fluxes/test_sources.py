"""Test the checks of catalogue rows, and the magnification."""

import dataclasses

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput, OutOfRange
from truesky.fluxes import sources


def null_at(table: pa.Table, name: str, row: int) -> pa.Table:
    values = table[name].to_pylist()
    values[row] = None
    return table.set_column(table.column_names.index(name), name, pa.array(values, table[name].type))


@pytest.mark.parametrize("name", ["z_obs", "sed_1", "ebv_2", "mag_r01", "abs_mag_r01", "kappa", "gamma2", "a_v"])
def test_a_gap_is_refused_with_column_and_source(galaxies, library, name):
    with pytest.raises(BadInput, match=f"{name}.*source 103"):
        sources.galaxies_from_table(null_at(galaxies(), name, 3), library)
    with pytest.raises(BadInput, match=name):
        sources.galaxies_from_table(galaxies().drop_columns([name]), library)


@pytest.mark.parametrize("name", ["mag_r01", "kappa", "a_v"])
def test_nan_is_refused_with_column_and_source(galaxies, library, name):
    values = galaxies()[name].to_numpy().copy()
    values[5] = np.nan
    with pytest.raises(BadInput, match=f"{name}.*source 105"):
        sources.galaxies_from_table(galaxies(**{name: values}), library)


@pytest.mark.parametrize(
    ("name", "value"),
    [("mag_r01", 61.0), ("abs_mag_r01", -31.0), ("a_v", -0.1), ("a_v", 41.0), ("flux_oii", -1e-17)],
)
def test_numbers_outside_the_tables_bounds_are_refused(galaxies, library, name, value):
    with pytest.raises(OutOfRange, match=name):
        sources.galaxies_from_table(galaxies(**{name: value}), library)


@pytest.mark.parametrize(("name", "value"), [("sed", 768), ("mag_h", 41.0), ("a_v", -0.1)])
def test_impossible_stars_are_refused(stars, stars_library, name, value):
    with pytest.raises(OutOfRange, match=name):
        sources.stars_from_table(stars(**{name: value}), stars_library)
    with pytest.raises(BadInput, match=f"{name}.*source 2"):
        sources.stars_from_table(null_at(stars(), name, 2), stars_library)


@pytest.mark.parametrize(
    ("sed", "frac", "name"), [(768, 0.5, "sed_2"), (3, 1.5, "frac_2"), (3, -0.1, "frac_2"), (3, 0.6, "frac_2")]
)
def test_impossible_mixtures_are_refused(stars, stars_library, sed, frac, name):
    """In the last case, the fractions sum to more than 1."""
    table = stars(sed_2=sed, frac_2=frac, sed_3=5, frac_3=0.5 if frac == 0.6 else 0.0)
    with pytest.raises(OutOfRange, match=name):
        sources.stars_from_table(table, stars_library)


def test_a_mixture_is_what_its_columns_say(stars, stars_library):
    """Templates without a fraction may be missing or null; `sed` has the remaining fraction."""
    table = stars(n=2, sed=[7, 8], sed_2=[1, 2], frac_2=[0.25, 0.0])
    table = table.append_column("sed_3", pa.array([None, 9])).append_column("frac_3", pa.array([None, 0.125]))
    found = sources.stars_from_table(table, stars_library)
    assert found.frac.tolist() == [[0.75, 0.875], [0.25, 0.0], [0.0, 0.125]]
    assert found.sed[:, 0].tolist() == [7, 1, 7]
    assert found.sed[:, 1].tolist() == [8, 8, 9]
    assert len(found.select(np.array([1]))) == 1


def test_kinds_of_other_libraries_are_refused(galaxies, library):
    kinds = np.zeros(20, np.int8)
    kinds[7] = 2
    with pytest.raises(BadInput, match="source 107 has kind 2"):
        sources.galaxies_from_table(galaxies(kind=kinds), library)


def test_a_wrong_number_of_lines_is_refused(galaxies, library):
    """With fewer lines, compiled code would read beyond the end of the array."""
    rows = sources.galaxies_from_table(galaxies(5), library)
    for fewer in (rows.lines[:, :-1], rows.lines[:4]):
        with pytest.raises(ValueError, match="lines are of shape"):
            dataclasses.replace(rows, lines=fewer)


def test_a_line_may_be_missing(galaxies, library):
    table = null_at(galaxies(flux_hbeta=0.0), "flux_halpha", 0).drop_columns(["flux_nii"])
    fluxes = sources.galaxies_from_table(table, library).lines
    assert fluxes[0, 0] == 0.0
    assert (fluxes[1:, 0] > 0.0).all()
    assert not fluxes[:, [1, 6, 7]].any()
    np.testing.assert_allclose(fluxes[:, 5], fluxes[:, 4] / 2.98)
    np.testing.assert_array_equal(fluxes[:, 3], fluxes[:, 2])


@given(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_magnification_is_the_inverse_determinant(kappa, gamma1, gamma2):
    jacobian = np.array([[1.0 - kappa - gamma1, -gamma2], [-gamma2, 1.0 - kappa + gamma1]])
    determinant = np.linalg.det(jacobian)
    if determinant < 0.02:
        return
    mu = sources.magnification([kappa], [gamma1], [gamma2], [1])
    assert mu[0] == pytest.approx(1.0 / determinant, rel=1e-12, abs=0.0)


@pytest.mark.parametrize("kappa", [1.0, 0.95, 1.5, -np.inf, np.nan])
def test_beyond_the_critical_curve_is_refused_with_the_source(kappa):
    with pytest.raises(OutOfRange, match="source 42"):
        sources.magnification([0.0, kappa], [0.0, 0.5], [0.0, 0.0], [41, 42])


def test_no_rows(galaxies, stars, library, stars_library):
    assert len(sources.galaxies_from_table(galaxies().slice(0, 0), library)) == 0
    assert len(sources.stars_from_table(stars().slice(0, 0), stars_library)) == 0
