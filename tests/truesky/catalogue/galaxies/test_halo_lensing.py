"""Halos in the lensing of galaxies: position, strength and reproducibility."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from tests.truesky.catalogue.conftest import SEED, SMALL
from truesky.catalogue.galaxies import galaxies, halo_lensing, lensing
from truesky.catalogue.galaxies.halo_lensing import Neighbourhood
from truesky.catalogue.halos import lens_halos, projected_nfw
from truesky.catalogue.halos.halo_catalogue import LightCone
from truesky.catalogue.halos.population import CellCache
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import sources
from truesky.request.schema import Universe

CELL = 303_117
CHI, FROM, TO = (float(FIDUCIAL.comoving_distance(z)) for z in (1.0, 0.2, 0.6))
ARCMIN = np.radians(1 / 60)


@pytest.fixture(scope="module")
def near(universe, cells):
    return halo_lensing.lens_of_cell(universe.lens, cells, CELL)


@pytest.fixture(scope="module")
def behind(rng_of_module):
    """Return positions and distances of sources in one cell."""
    _, ra, dec = sky.random_in_cell(GENERATION_ORDER, CELL, 4000, rng_of_module)
    return ra, dec, rng_of_module.uniform(300, 3500, 4000)


@pytest.fixture(scope="module")
def rng_of_module():
    return np.random.default_rng(5)


def lone(box, ra, dec, chi=800.0, amplitude=3e-9, size=2 * ARCMIN):
    """Return the lensing of one halo without other matter."""
    chosen = lens_halos.settings()
    halo = np.array([0, 0, chi, amplitude, size, max(size, 10 * ARCMIN), max(size, 25 * ARCMIN), 6.0])[:, None]
    empty = replace(box, maps=tuple(np.zeros_like(one) for one in box.maps))
    frame = halo_lensing._frames(np.array([ra]), np.array([dec]))[0]
    planes = np.append(0.0, 1.0 / FIDUCIAL.comoving_distance(np.array(chosen.planes))[::-1])
    smooth = halo_lensing._smooth_lensing(chosen, halo, planes)
    return Neighbourhood(empty, chosen, frame, halo, planes, smooth, None, np.inf)


@pytest.mark.parametrize(("ra", "dec"), [(40.0, 20.0), (0.0, -1.0), (359.9999, 60.0), (123.0, 89.5), (10.0, -89.9)])
def test_shear_is_tangential_and_sources_are_pushed_away(universe, ra, dec):
    """Signs as in the table: gamma1 < 0 east and west of a mass, gamma2 < 0 north-east of it, at any position."""
    halo, angle = lone(universe.lens, ra, dec), np.arange(16) * np.pi / 8
    east, north = 5 * ARCMIN * np.sin(angle), 5 * ARCMIN * np.cos(angle)
    places = lensing.displace(np.full(16, ra), np.full(16, dec), east, north)
    found = halo_lensing.columns(halo, *places, np.full(16, CHI))
    # The direction back to the halo, from each source's own north.
    frame = halo_lensing._frames(*places)
    x, y = (-(frame[:, axis] * halo.frame[2]).sum(-1) for axis in range(2))
    phi = np.arctan2(y, x)
    tangential = -(found["gamma1"] * np.cos(2 * phi) + found["gamma2"] * np.sin(2 * phi))
    across = found["gamma2"] * np.cos(2 * phi) - found["gamma1"] * np.sin(2 * phi)
    assert tangential == pytest.approx(np.full(16, tangential[0]), rel=1e-2)
    assert tangential[0] > 1e-4
    assert across == pytest.approx(np.zeros(16), abs=1e-2 * tangential[0])
    away = sky.separation(found["ra"], found["dec"], ra, dec) * 60 - 5
    assert away == pytest.approx(np.full(16, away[0]), rel=1e-2)
    assert away[0] > 1e-3


def test_convergence_and_shear_are_those_at_the_image(universe, rng):
    """theta = beta + alpha(theta) with convergence and shear at theta: one Newton step close to a rich cluster."""
    halo = lone(universe.lens, 40.0, 20.0, amplitude=3e-8)
    angle, radius = 2 * np.pi * rng.random(300), ARCMIN * rng.uniform(0.7, 10, 300)
    beta = lensing.displace(np.full(300, 40.0), np.full(300, 20.0), radius * np.sin(angle), radius * np.cos(angle))
    found = halo_lensing.columns(halo, *beta, np.full(300, CHI))
    theta = found["ra"], found["dec"]
    once = replace(halo, settings=replace(halo.settings, repeat_threshold=np.inf))
    there = halo_lensing.lensing_at_images(once, *theta, np.full(300, CHI))
    again = lensing.displace(*theta, *-there[3:])
    wrong = 3600 * sky.separation(*again, *beta)
    moved = 3600 * sky.separation(*theta, *beta)
    well = sources.determinant(*there[:3]) > 0.3
    assert well.sum() > 200
    assert np.median(moved[well]) > 2
    assert wrong[well].max() < 0.03 * moved[well].max()
    for name, value in zip(("kappa", "gamma1", "gamma2"), there, strict=False):
        assert found[name][well] == pytest.approx(value[well], rel=0.05, abs=0.003)
    # A single evaluation where the box shows them is not enough.
    first = halo_lensing.columns(once, *beta, np.full(300, CHI))
    assert np.abs(first["kappa"] - there[0])[well].max() > 0.02


def test_a_galaxy_behind_a_centre_is_finite_or_set_apart(universe):
    """However massive and near the halo is."""
    for amplitude, size in ((3e-9, ARCMIN), (1e-6, 50 * ARCMIN)):
        halo = lone(universe.lens, 40.0, 20.0, 140.0, amplitude, size)
        found = halo_lensing.columns(halo, np.array([40.0, 40.00001]), np.array([20.0, 20.0]), np.full(2, CHI))
        assert all(np.isfinite(value).all() for value in found.values())


def test_the_lens_equation_holds(near, behind):
    """theta - alpha(theta) = beta within 0.5" for 99 % of the sources of a cell, which move by up to 30"."""
    ra, dec, chi = behind
    found = halo_lensing.lensing_at_images(near, ra, dec, chi)
    once = replace(near, settings=replace(near.settings, repeat_threshold=np.inf))
    theta = lensing.displace(ra, dec, *found[3:])
    back = lensing.displace(*theta, *-halo_lensing.lensing_at_images(once, *theta, chi)[3:])
    assert np.percentile(3600 * sky.separation(*back, ra, dec), 99) < 0.5
    assert np.percentile(3600 * sky.separation(*theta, ra, dec), 99) > 5.0


def test_lensing_of_a_source_does_not_depend_on_other_sources(near, behind):
    whole = halo_lensing.lensing_at_images(near, *behind)
    assert np.abs(whole[0]).max() > 0.05
    rng = np.random.default_rng(1)
    for rows in (np.arange(0, 4000, 2), rng.permutation(4000)[:1000], np.array([17])):
        part = halo_lensing.lensing_at_images(near, *(values[rows] for values in behind))
        assert part.tobytes() == np.ascontiguousarray(whole[:, rows]).tobytes()


@pytest.mark.parametrize(
    "changed",
    [
        # Both keys change by default, and one of them at a time in nightly runs.
        {"galaxy_limit": 23.0, "z_max": 1.0},
        pytest.param({"galaxy_limit": 20.0}, marks=pytest.mark.nightly),
        pytest.param({"z_max": 3.0}, marks=pytest.mark.nightly),
    ],
)
def test_lensing_does_not_depend_on_the_limit_of_a_request(universe, near, changed):
    """The same halos, and so the same lensing of the same galaxies, bit by bit."""
    other = galaxies.halos_and_galaxies(SEED, Universe(**SMALL, **changed))
    found = halo_lensing.lens_of_cell(universe.lens, CellCache(other), CELL)
    assert near.halos.shape[1] > 5000
    assert found.halos.tobytes() == near.halos.tobytes()
    assert found.smooth.table.tobytes() == near.smooth.table.tobytes()
    assert found.matter.table.tobytes() == near.matter.table.tobytes()


def test_matter_lenses_only_with_the_structure_that_halos_follow(universe, near):
    """Without structure below the cells, and with halos of the user, only halos and the box lens."""
    index = sky.healpix_29([217.0], [33.0])
    users = LightCone(index, np.array([1000.0]), np.array([13.0]), np.zeros(1))
    without = galaxies.halos_and_galaxies(SEED, Universe(**SMALL, structure_below_cells=False))
    for population in (without, replace(universe.population, light_cone=users)):
        assert halo_lensing.lens_of_cell(universe.lens, CellCache(population), CELL).matter is None
    assert near.matter.table[0, ..., 0].std() > 0.01


def test_halos_but_the_strongest_deflect_less_than_assumed(universe, cells, near):
    """The limit is for all halos but the strongest one, and for the matter around them: four cells, 2,000 sources."""
    rng, largest = np.random.default_rng(8), 0.0
    for cell in range(CELL, CELL + 4):
        around = halo_lensing.lens_of_cell(universe.lens, cells, cell)
        _, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, 2000, rng)
        strongest = around.halos[:, [np.argmax(around.halos[3] / around.halos[4])]]
        smooth = halo_lensing._smooth_lensing(around.settings, strongest, around.planes)
        alone = replace(around, halos=strongest, smooth=smooth, matter=None)
        chi = np.full(2000, 4000.0)
        others = np.subtract(*(halo_lensing.lensing_at_images(one, ra, dec, chi)[3:] for one in (around, alone)))
        largest = max(largest, float(np.hypot(*others).max()))
    assert 0 < largest < 0.8 * halo_lensing._OTHER_DEFLECTION


def test_halos_of_the_catalogue_are_those_that_lens(universe, cells):
    """Every halo of the table above the threshold lenses exactly once, with its position and mass."""
    rows = galaxies.halo_table(CELL, universe.population, cells)
    chosen = lens_halos.settings()
    complete = universe.population.halos.mass_limit(np.array([CHI]))[0] < chosen.lowest
    heavy = (rows["log_mass"].to_numpy() >= chosen.lowest) & (rows["z_true"].to_numpy() < 1.0)
    own = lens_halos.draw(universe.population, chosen.lowest, CHI, GENERATION_ORDER, CELL)
    assert complete
    assert 300 < heavy.sum() <= own.id.size + 3
    wide = np.isin(rows["id"].to_numpy()[heavy], own.id)
    # Halos that span arc minutes are drawn by larger cells.
    assert wide.mean() > 0.98
    assert np.isin(own.id[own.chi < 0.999 * CHI], rows["id"].to_numpy()).all()


def test_no_halo_is_missed_that_reaches_a_cell(universe, near, monkeypatch):
    """The halos are the same if cells are drawn to twice the distance."""
    chosen = lens_halos.settings()
    every = halo_lensing._cells_with_halos

    def farther(settings, cell, centre, radius):
        return every(replace(settings, wide=1.5 * chosen.wide, reach=1.5 * chosen.reach), cell, centre, radius)

    monkeypatch.setattr(halo_lensing, "_cells_with_halos", farther)
    found = halo_lensing.lens_of_cell(universe.lens, CellCache(universe.population), CELL)
    # Light is bent by less than the strip, with very few exceptions at its border.
    assert found.halos.shape[1] == pytest.approx(near.halos.shape[1], rel=1e-3)


def test_the_smooth_part_of_halos_is_that_of_a_direct_sum(universe, cells, near, behind, monkeypatch):
    chosen = lens_halos.settings()
    monkeypatch.setattr(lens_halos, "settings", lambda: replace(chosen, close=1000.0))
    direct = halo_lensing.lens_of_cell(universe.lens, CellCache(universe.population), CELL)
    once = [
        replace(one, matter=None, settings=replace(one.settings, repeat_threshold=np.inf)) for one in (near, direct)
    ]
    split, whole = (halo_lensing.lensing_at_images(one, *behind) for one in once)
    assert not direct.smooth.table.any()
    assert np.all(np.std(split - whole, axis=1)[:3] < 0.01 * np.std(whole, axis=1)[:3])
    assert 3600 * np.degrees(np.abs(split - whole)[3:].max()) < 0.5


def test_the_table_of_galaxies_has_the_lensing_of_halos(universe, cells, dust, monkeypatch):
    rows = galaxies.draw(CELL, universe, cells, dust).sort_by("id")
    monkeypatch.setattr(halo_lensing, "lens_of_cell", lambda lens, cells, cell: lens)
    bare = galaxies.draw(CELL, universe, cells, dust).sort_by("id")
    changed = {name for name in rows.column_names if not rows[name].equals(bare[name])}
    assert changed - {"a_v"} == {"ra", "dec", "_healpix_29", "kappa", "gamma1", "gamma2"}
    far = pa.compute.greater(rows["z_true"], 1.0)
    assert np.std(rows.filter(far)["kappa"]) > 1.5 * np.std(bare.filter(far)["kappa"])


def test_no_cell_misses_a_monster(universe):
    """A halo of 10^15.5 Msun/h at z = 0.05: its lensing spans degrees, and ends where its mass is compensated."""
    ra, dec = 217.0, 33.0
    index, chi = sky.healpix_29([ra], [dec]), FIDUCIAL.comoving_distance(np.array([0.05]))
    cone = LightCone(index, chi, np.array([15.5]), np.zeros(1))
    cells = CellCache(replace(universe.population, light_cone=cone))
    seen = {}
    for away in (0.0, 1.0, 2.0, 4.0, 4.5, 5.5, 8.0):
        cell = int(sky.cell_at([ra], [dec - away], GENERATION_ORDER)[0])
        near = halo_lensing.lens_of_cell(universe.lens, cells, cell)
        assert near.halos.shape[1] == (away < 5)
        lon, lat = (np.array([value]) for value in sky.cell_centre(GENERATION_ORDER, cell))
        found = halo_lensing.lensing_at_images(near, lon, lat, np.array([CHI]))
        assert np.isfinite(found).all()
        seen[away] = np.hypot(*found[1:3, 0])
    assert seen[1.0] > seen[2.0] > seen[4.0] > seen[5.5] == 0
    assert seen[1.0] > 5e-3


def test_what_is_right_behind_a_cluster_is_set_apart(universe):
    """A galaxy exactly behind the centre of a halo of 10^15 Msun/h at z = 0.3 belongs in the quarantine."""
    index, chi = sky.healpix_29([217.0], [33.0]), FIDUCIAL.comoving_distance(np.array([0.3]))
    cells = CellCache(replace(universe.population, light_cone=LightCone(index, chi, np.array([15.0]), np.zeros(1))))
    empty = replace(universe.lens, maps=tuple(np.zeros_like(one) for one in universe.lens.maps))
    cell = int(index[0] >> 2 * (29 - GENERATION_ORDER))
    near = halo_lensing.lens_of_cell(empty, cells, cell)
    ra, dec = sky.positions_of_indices(index)
    for north in (0.0, 1e-6, 5.0):
        found = halo_lensing.columns(near, ra, dec + north / 60, np.full(1, CHI))
        kappa, gamma1, gamma2 = (found[name] for name in ("kappa", "gamma1", "gamma2"))
        assert np.isfinite([*found.values()]).all()
        assert lensing.is_near_caustic(kappa, gamma1, gamma2, lensing.settings().caustic)[0] == (north < 1)
        assert all(-1 <= value < 100 for value in (kappa[0], gamma1[0], gamma2[0]))


def profile(theta, halo):
    """Return the tangential shear at theta (rad) around halos (8, n) without other matter, cut at R_200m."""
    _, _, chi, amplitude, size, _, _, c = halo
    out = np.empty(theta.size)
    for i, x in enumerate(theta / size):
        surface, whole = 0.0, projected_nfw.total(c[i])
        inside = 1.0
        if x < 1:
            surface, mass = projected_nfw.profile(c[i] * x, c[i])
            inside = mass / whole
        out[i] = inside / theta[i] ** 2 - c[i] ** 2 * surface / (2 * whole * size[i] ** 2)
    return amplitude * (1 - chi / CHI) * out


def stacked(universe, places, least, number):
    """Return (tangential shear, cross shear, shear of halos alone) by ring, and the halos, for sources at z = 1."""
    edges, kept = np.array([0.5, 1.0, 2.0, 4.0]), []
    rng, drawn = np.random.default_rng(3), CellCache(universe.population)
    for place in places:
        near = halo_lensing.lens_of_cell(universe.lens, drawn, place)
        halos, _ = halo_lensing._cached_lenses(
            near.settings, near.box, drawn, GENERATION_ORDER, place, near.settings.lowest
        )
        nearby = (halos[3] > FROM) & (halos[3] < TO) & (halos[9] > least)
        _, ra, dec = sky.random_in_cell(GENERATION_ORDER, place, number, rng)
        found = halo_lensing.columns(near, ra, dec, np.full(number, CHI))
        frame = halo_lensing._frames(found["ra"], found["dec"])
        for i in np.flatnonzero(nearby):
            x, y = (-(frame[:, axis] * halos[:3, i]).sum(-1) for axis in range(2))
            rows = np.flatnonzero((np.hypot(x, y) < edges[-1] * ARCMIN) & (frame[:, 2] @ halos[:3, i] > 0))
            theta, phi = np.hypot(x, y)[rows], np.arctan2(y, x)[rows]
            gamma1, gamma2 = found["gamma1"][rows], found["gamma2"][rows]
            tangential = -(gamma1 * np.cos(2 * phi) + gamma2 * np.sin(2 * phi))
            across = gamma2 * np.cos(2 * phi) - gamma1 * np.sin(2 * phi)
            expected = profile(theta, np.repeat(halos[1:9, i : i + 1], theta.size, 1))
            kept.append(np.stack([theta / ARCMIN, tangential, across, expected]))
    theta, *values = np.concatenate(kept, 1)
    ring = np.digitize(theta, edges) - 1
    inside = ring >= 0
    return (*(np.bincount(ring[inside], value[inside]) for value in values), len(kept))


@pytest.mark.nightly
def test_stacked_shear_about_massive_halos(universe):
    """Observed sources around observed halos show the halo profile and no cross shear; the sky is small."""
    first = CELL // 16 * 16
    tangential, across, expected, number = stacked(universe, range(first, first + 16), 13.3, 10_000)
    assert number > 30
    assert (tangential / expected)[:2] == pytest.approx(np.ones(2), abs=0.15)
    # Beyond 2' the matter about a halo is seen, too.
    assert 0.7 < tangential[2] / expected[2] < 1.5
    assert across / expected == pytest.approx(np.zeros(3), abs=0.10)
