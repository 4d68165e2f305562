"""Intrinsic alignments have the requested strength, point to matter, and change nothing else."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from truesky.catalogue.galaxies import alignments, galaxies, lensing
from truesky.catalogue.halos import population
from truesky.catalogue.matter import density_box, lightcone

CELL = 303_117


@pytest.fixture(scope="module")
def own(universe):
    return universe.alignments


def ellipticity(rows):
    """Return the light-weighted ellipticity of bulge and disc, with the position angle from east to north."""
    bulge, disc, share, angle = (
        rows[name].to_numpy().astype(float)
        for name in ("bulge_axis_ratio", "disk_axis_ratio", "bulge_fraction", "position_angle")
    )
    size = share * (1 - bulge) / (1 + bulge) + (1 - share) * (1 - disc) / (1 + disc)
    return size * np.exp(2j * np.radians(90.0 - angle))


@given(size=st.floats(0.0, 0.08), angle=st.floats(-3.1, 3.1))
def test_the_drawn_mean_equals_the_requested_mean(own, size, angle):
    """A uniform sequence of numbers has no noise, so the law is tested directly."""
    n = 2000
    uniform, mean, red = (np.arange(n) + 0.5) / n, np.full(n, size * np.exp(1j * angle)), np.ones(n, bool)
    position = alignments.position_angles(own, uniform, mean, red)
    drawn = own.numbers.ellipticity_red * np.mean(np.exp(2j * np.radians(90.0 - position)))
    assert drawn == pytest.approx(mean[0], abs=1e-5)
    assert np.all((position >= 0) & (position < 180))


def test_directions_are_uniform_without_a_mean_or_alignments(own, rng):
    uniform, none, red = rng.random(100), np.zeros(100, complex), np.ones(100, bool)
    for numbers in (own, None):
        assert np.array_equal(alignments.position_angles(numbers, uniform, none, red), 180.0 * uniform)


def test_the_tide_is_that_of_the_linear_density(box):
    """For density variance s^2, <T_xx^2> = 4 s^2 / 45 and <T_xy^2> = s^2 / 15, except for the corners of a cube."""
    xx, yy, *mixed = density_box.tides(box)
    modes, _ = density_box._linear_modes(box.model, box.smoothed[0])
    density = density_box._to_real(modes, box.n)
    for one in (xx, yy, xx + yy):
        assert np.mean(one.astype(float) ** 2) == pytest.approx(4 / 45 * density.var(), rel=0.12)
    for one in mixed:
        assert np.mean(one.astype(float) ** 2) == pytest.approx(density.var() / 15, rel=0.12)


def test_galaxies_point_to_matter(universe, own, rng):
    """In every replica, the density is higher along the major axis of galaxies than across it."""
    box, turned = universe.population.halos.box, universe.population.halos.replicas
    index, ra, dec = sky.random_in_cell(0, 5, 40_000, rng)
    chi = rng.uniform(100, 3000, index.size)
    e = alignments.central_ellipticity(own, ra, dec, chi, np.full(chi.size, -22.0), np.ones(chi.size, bool))
    assert np.sqrt(np.mean(np.abs(e) ** 2)) == pytest.approx(0.02, abs=0.01)
    angle, step = 0.5 * np.angle(e), 8.0 / chi
    sides = []
    for turn in (0.0, np.pi / 2):
        beside = np.zeros(chi.size)
        for way in (1, -1):
            east, north = way * step * np.cos(angle + turn), way * step * np.sin(angle + turn)
            lon, lat = np.radians(lensing.displace(ra, dec, east, north))
            direction = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], 1)
            cell, _ = lightcone.box_cells(box, turned, direction, chi)
            beside += box.smoothed[0].ravel()[cell]
        sides.append(beside)
    assert np.mean(sides[0] - sides[1]) > 0.1 * np.std(sides[0])


def test_blue_galaxies_do_not_follow_and_amplitudes_multiply(universe, own, rng):
    _, ra, dec = sky.random_in_cell(0, 5, 100, rng)
    chi, m_r, red = np.full(100, 1500.0), np.full(100, -22.0), np.ones(100, bool)
    once = alignments.central_ellipticity(own, ra, dec, chi, m_r, red)
    twice = alignments.central_ellipticity(replace(own, strength=2.0), ra, dec, chi, m_r, red)
    assert twice == pytest.approx(2 * once, abs=1e-15)
    assert alignments.central_ellipticity(own, ra, dec, chi, m_r - 2.5 / 1.2, red) == pytest.approx(
        10 * once, abs=1e-12
    )
    assert not alignments.central_ellipticity(own, ra, dec, chi, m_r, ~red).any()
    assert alignments.model(own.box, own.replicas, 0.0) is None


def test_satellites_point_to_their_central(own):
    """Tested north-east of the central galaxy, beyond the pole, and across the first meridian."""
    ra, dec = np.array([10.1, 0.01, 200.0]), np.array([60.05, 0.0, -89.9])
    to = sky.healpix_29(np.array([10.0, 359.99, 200.0]), np.array([60.0, 0.0, -89.8]))
    towards, apart = alignments.direction_to_cells(ra, dec, to)
    assert np.degrees(apart) == pytest.approx([np.hypot(0.05, 0.05), 0.02, 0.1], rel=2e-3)
    assert np.degrees(towards) % 180 == pytest.approx([45.0, 0.0, 90.0], abs=0.2)
    mean = alignments.satellite_ellipticity(own, towards, np.array([0.1, 0.5, 4.0]), np.ones(3, bool))
    assert np.abs(mean) == pytest.approx([0.024, 0.02, 0.0], abs=1e-9)


def drawn_and_wanted(universe, cells, dust, monkeypatch, places):
    """Return (drawn / requested alignment, its error) of red galaxies in cells, with alignments twice as strong."""
    strong, wanted, inner = replace(universe.alignments, strength=2.0), [], galaxies._mean_ellipticities

    def recorded(own, members, drawn):
        mean = inner(own, members, drawn)
        wanted.append((members.id[drawn.row], mean))
        return mean

    monkeypatch.setattr(galaxies, "_mean_ellipticities", recorded)
    aligned = replace(universe, alignments=strong, lens=lensing.Shear(), distant=())
    rows = pa.concat_tables([galaxies.draw(cell, aligned, cells, dust) for cell in places])
    own, mean = (np.concatenate(part) for part in zip(*wanted, strict=True))
    order, by_id = np.argsort(own), np.argsort(rows["id"].to_numpy())
    e, mean = ellipticity(rows)[by_id], mean[order]
    weight = np.abs(mean) ** 2
    used = (weight > 0) & (np.abs(mean) < 0.4 * strong.numbers.ellipticity_red)
    ratio = np.sum((e * np.conj(mean))[used]) / weight[used].sum()
    return ratio, np.sqrt(np.mean(np.abs(e[used]) ** 2) / 2 / weight[used].sum())


def test_strength_in_the_catalogue_is_as_requested(universe, cells, dust, monkeypatch):
    ratio, error = drawn_and_wanted(universe, cells, dust, monkeypatch, range(CELL, CELL + 4))
    assert error < 0.12
    assert ratio == pytest.approx(1.0, abs=3 * error)


@pytest.mark.nightly
def test_strength_in_a_large_catalogue_is_as_requested(universe, dust, monkeypatch):
    first = CELL // 64 * 64
    cells = population.CellCache(universe.population)
    ratio, error = drawn_and_wanted(universe, cells, dust, monkeypatch, range(first, first + 128))
    assert error < 0.03
    assert ratio == pytest.approx(1.0, abs=0.10)


def test_only_position_angles_are_aligned(universe, cells, dust):
    aligned, alone = (
        galaxies.draw(CELL, replace(universe, alignments=own), cells, dust) for own in (universe.alignments, None)
    )
    assert [n for n in aligned.column_names if not aligned[n].equals(alone[n])] == ["position_angle"]
    changed = aligned["position_angle"].to_numpy() != alone["position_angle"].to_numpy()
    assert 0.02 < changed.mean() < 0.5
