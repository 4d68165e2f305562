"""Angular power of mock galaxies with known spectra in a mask, and faults that the check must detect."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.lazy_healpy import healpy as hp
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.survey.randoms import RANDOMS
from scripts import two_point_references
from tests.truesky.survey_maps import depths
from tests.truesky.validation.lake.catalogues.test_faults import Version
from truesky.cosmology import FIDUCIAL
from truesky.survey_maps import random_points
from truesky.validation import theory
from truesky.validation.lake.catalogues import angular_power, redshift_multipoles
from truesky.validation.lake.catalogues.survey_mask import SurveyMask, read_mask
from truesky.validation.pseudo_power import L_MAX
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS, UNDECIDED

# Note of checks of random points that were drawn in another depth map.
OUTDATED = "table randoms was drawn in another version of table depth: run truesky randoms again"
NSIDE = 1 << GENERATION_ORDER
CELLS = sky.cells_in_cone(30.0, -40.0, 8.0, GENERATION_ORDER)


def holes():
    """Pixels of a circle with a large hole and many small ones."""
    pixels = depths.pixels_of(np.setdiff1d(CELLS, sky.cells_in_cone(32.0, -38.0, 1.5, GENERATION_ORDER)))
    return SurveyMask("euclid_vis", pixels[pixels % 11 > 0])


def drawn_galaxies(rng, number, overdensity):
    """Indices of order 29 of about `number` galaxies, with an overdensity in each cell of order 8."""
    count = rng.poisson(number / len(CELLS) * np.maximum(1.0 + overdensity, 0.0))
    return np.repeat(CELLS, count) << 42 | rng.integers(0, 1 << 42, count.sum())


@pytest.fixture(scope="module")
def galaxies_in_bins():
    """Columns of galaxies at 0.4 < z < 0.6 in halos of one mass, and of galaxies at z = 1.3 with convergence."""
    rng = np.random.default_rng(5)
    columns = {
        "kind": np.zeros(300_000, np.int8), "z_true": rng.uniform(0.4, 0.6, 300_000),
        "log_halo_mass": np.full(300_000, 12.5), "mag_r01": np.full(300_000, 20.0), "kappa": np.zeros(300_000),
    }  # fmt: skip
    tracers = angular_power._tracers(columns, np.ones(300_000, bool), (0.4, 0.6), FIDUCIAL)
    source = np.asarray(FIDUCIAL.comoving_distance(np.array([1.3]))), np.ones(1)
    powers = (
        lambda ell: theory.galaxy_power(FIDUCIAL, ell, tracers),
        lambda ell: theory.convergence_power(FIDUCIAL, ell, *source),
        lambda ell: theory.galaxy_convergence_power(FIDUCIAL, ell, tracers, *source),
    )
    c_l = [angular_power._at_all_multipoles(power) for power in powers]
    np.random.seed(3)  # noqa: NPY002 (healpy draws from the global state)
    delta, kappa = _pair(c_l)
    ring = hp.nest2ring(NSIDE, CELLS)
    near = drawn_galaxies(rng, 300_000, delta[ring])[:300_000]
    far = drawn_galaxies(rng, 60_000, np.zeros(len(CELLS)))
    columns = {name: values[: len(near)] for name, values in columns.items()} | {"_healpix_29": near}
    behind = {
        "kind": np.zeros(len(far), np.int8), "z_true": rng.normal(1.3, 0.01, len(far)),
        "log_halo_mass": np.full(len(far), 12.5), "mag_r01": np.full(len(far), 23.0),
        "kappa": kappa[hp.nest2ring(NSIDE, far >> 42)], "_healpix_29": far,
    }  # fmt: skip
    return {name: np.concatenate([columns[name], behind[name]]) for name in angular_power.COLUMNS}


def _pair(c_l):
    """Two maps with the spectra C_gg, C_kk and the cross spectrum C_gk."""
    gg, kk, gk = c_l
    first, second = hp.synalm(np.ones(L_MAX + 1), L_MAX), hp.synalm(np.ones(L_MAX + 1), L_MAX)
    ratio = gk / np.sqrt(gg)
    rest = np.sqrt(np.maximum(kk - ratio**2, 0.0))
    delta = hp.almxfl(first, np.sqrt(gg))
    kappa = hp.almxfl(first, ratio) + hp.almxfl(second, rest)
    return hp.alm2map(delta, NSIDE, L_MAX), hp.alm2map(kappa, NSIDE, L_MAX)


def publish_randoms(lake, cells, rows, **facts):
    """Publish random points with a density of 10 per arcmin2 in neighbouring cells, and return their version."""
    task = Task(layout.cell_file(5, int(cells[0]) >> 6), {})
    plan = Plan(RANDOMS, {"density": 10.0, "bands": ["euclid_vis"], **facts}, (task,))
    publish.make_version(lake, plan, lambda lake, facts: Output(rows))
    return read.version(lake, "randoms", plan.key)


def by_name(result):
    return {row.quantity: row for row in result.rows}


def test_galaxies_and_convergence_of_known_power_pass(galaxies_in_bins):
    """Sample: one field of 200 deg2; limits of 5 errors of Gaussian fields, a significance of 6e-7."""
    result = angular_power.compare(galaxies_in_bins, holes(), FIDUCIAL)
    rows = by_name(result)
    for name in ("galaxies_0.4", "convergence_0.4"):
        assert rows[name].error < 0.15
        assert abs(rows[name].value - 1.0) < 5.0 * rows[name].error
    assert rows["galaxies_0.4"].verdict == PASS
    assert {rows[f"galaxies_{z:g}"].verdict for z in (0.2, 0.6, 0.8)} == {NOT_APPLICABLE}
    assert set(result.series) == {"power_0.4", "convergence_power_0.4"}
    assert all(np.isfinite(values).all() for values in result.series.values())


@pytest.mark.parametrize(
    ("quantity", "change"),
    [
        ("galaxies_0.4", lambda columns: {"log_halo_mass": columns["log_halo_mass"] + 1.5}),
        ("convergence_0.4", lambda columns: {"kappa": -columns["kappa"]}),
    ],
)
def test_faults_are_found(galaxies_in_bins, quantity, change):
    """Galaxies of other halos, and convergence with the wrong sign."""
    wrong = galaxies_in_bins | change(galaxies_in_bins)
    assert by_name(angular_power.compare(wrong, holes(), FIDUCIAL))[quantity].verdict == FAIL


def test_coarse_lensing_maps_are_known_to_fail(galaxies_in_bins):
    rows = by_name(angular_power.compare(galaxies_in_bins, holes(), FIDUCIAL, 64))
    assert rows["convergence_0.4"].known_failure == "lensing maps contain structure only to l = 64"
    assert not rows["galaxies_0.4"].known_failure


def test_what_cannot_be_measured_has_a_reason(galaxies_in_bins):
    none = SurveyMask("euclid_vis", np.zeros(0, np.int64))
    (row,) = angular_power.compare(galaxies_in_bins, none, FIDUCIAL).rows
    assert row.note == "no pixel of band euclid_vis is covered, unmasked and in the area of the galaxies"
    small = SurveyMask("euclid_vis", depths.pixels_of(CELLS[:40]))
    for row in angular_power.compare(galaxies_in_bins, small, FIDUCIAL).rows:
        assert row.verdict == NOT_APPLICABLE
        assert "galaxies in the mask" in row.note or "which the field resolves" in row.note
    same = galaxies_in_bins | {"kappa": np.full(len(galaxies_in_bins["kappa"]), 0.01)}
    assert "same convergence" in by_name(angular_power.compare(same, holes(), FIDUCIAL))["convergence_0.4"].note


def test_a_mask_has_clean_and_covered_pixels_of_the_galaxies_only(tmp_path):
    pixels = depths.pixels_of(CELLS[:3])
    mask, covered = (pixels % 3).astype(np.int16), np.where(pixels % 2, 1.0, 0.9).astype(np.float32)
    version = depths.publish_depth(
        tmp_path,
        depths.columns_of(pixels, mask=mask, covered=covered),
        depths.columns_of(pixels, "lsst_r"),
    )
    found = read_mask(version, "euclid_vis", CELLS[1:5].tolist())
    wanted = pixels[(pixels % 3 != 2) & (pixels % 2 == 1) & (pixels >= CELLS[1] * depths.PIXELS)]
    np.testing.assert_array_equal(found.pixels, wanted)
    assert found.contains(wanted << 30).all()
    assert not found.contains((wanted - 1) << 30).any()
    assert found.area == pytest.approx(len(wanted) * sky.cell_area(14))


def test_tables_of_a_lake(tmp_path):
    """Both checks read the tables, use the band of the random points, and say what is missing in a small area."""
    cells, rng = CELLS[:4], np.random.default_rng(2)
    pixels = depths.pixels_of(cells)
    depth = depths.publish_depth(tmp_path, depths.columns_of(pixels), depths.columns_of(pixels[:9], "lsst_r"))
    points = random_points.draw_points(cells.tolist(), 10.0, 1, depths.depth_map(pixels))
    rows = RANDOMS.build({**points, "band": np.full(len(points["id"]), "euclid_vis", object)})
    index = (np.repeat(cells, 500) << 42) + rng.integers(0, 1 << 42, 2000)
    ra, dec = sky.positions_of_indices(index)
    columns = {
        "id": np.arange(2000), "ra": ra, "dec": dec, "_healpix_29": index, "kind": np.zeros(2000, np.int8),
        "z_true": rng.uniform(0.2, 1.6, 2000), "z_obs": rng.uniform(0.2, 1.6, 2000), "mag_r01": np.full(2000, 20.0),
        "log_halo_mass": np.full(2000, 12.5), "kappa": np.zeros(2000),
    }  # fmt: skip
    versions = Version("galaxies", columns, cells), depth, publish_randoms(tmp_path, cells, rows)
    found = by_name(angular_power.measure(*versions))
    assert found["randoms"].verdict in (PASS, UNDECIDED)
    assert abs(found["randoms"].value - 1.0) < 5.0 * found["randoms"].error
    assert {row.verdict for name, row in found.items() if name != "randoms"} == {NOT_APPLICABLE}
    (row,) = redshift_multipoles.measure(*versions).rows
    assert "2000 of both are required" in row.note
    newer = depths.publish_depth(tmp_path, depths.columns_of(pixels[:9]))
    stale = publish_randoms(tmp_path, cells, rows, depth=depth.key)
    for check in (angular_power, redshift_multipoles):
        assert check.measure(*versions[:2], stale).rows[0].note != OUTDATED
        (row,) = check.measure(versions[0], newer, stale).rows
        assert (row.verdict, row.note) == (NOT_APPLICABLE, OUTDATED)


def test_density_of_random_points():
    """Sample: 5,000 points; significance 6e-7 (5 standard errors)."""
    pixels = depths.pixels_of(CELLS[:3])
    points = random_points.draw_points(CELLS[:3].tolist(), 10.0, 1, depths.depth_map(pixels))
    (row,) = angular_power._density_row(len(points["id"]), 10.0, SurveyMask("euclid_vis", pixels))
    assert abs(row.value - 1.0) < 5.0 * row.error
    (row,) = angular_power._density_row(len(points["id"]), 11.0, SurveyMask("euclid_vis", pixels))
    assert row.verdict == FAIL


def test_spectra_are_those_of_ccl():
    """The matter power of truesky was given to CCL, so that only the projections are compared."""
    z, _ = two_point_references.lens_sample()
    columns = {"z_true": z, "log_halo_mass": np.full(len(z), 12.5)}
    tracers = angular_power._tracers(columns, np.ones(len(z), bool), two_point_references.LENSES, FIDUCIAL)
    source = np.asarray(FIDUCIAL.comoving_distance(np.array([two_point_references.SOURCE]))), np.ones(1)
    ell = two_point_references.ELL
    for name, found in (
        ("galaxy_power", theory.galaxy_power(FIDUCIAL, ell, tracers)),
        ("galaxy_convergence_power", theory.galaxy_convergence_power(FIDUCIAL, ell, tracers, *source)),
    ):
        np.testing.assert_allclose(found, two_point_references.read_values(name), rtol=0.01, err_msg=name)


@given(st.floats(0.1, 1.0), st.floats(0.05, 0.5))
@settings(max_examples=10, deadline=None)
def test_shells_end_at_the_limits_of_the_sample(low, width):
    """Galaxies of constant density and bias fill all shells: the first and the last have no smaller weight."""
    chi = np.linspace(*(float(FIDUCIAL.comoving_distance(z)) for z in (low, low + width)), 4001)[1:-1]
    columns = {"z_true": FIDUCIAL.redshift(chi), "log_halo_mass": np.full(len(chi), 12.5)}
    tracers = angular_power._tracers(columns, np.ones(len(chi), bool), (low, low + width), FIDUCIAL)
    halos = angular_power.matching.masses(FIDUCIAL)
    bias = halos.interpolate_pairs(halos.bias, columns["z_true"], columns["log_halo_mass"])
    share = tracers.weight / np.interp(tracers.chi, chi, bias) * (chi[-1] - chi[0])
    np.testing.assert_allclose(share, 1.0, atol=0.02)
