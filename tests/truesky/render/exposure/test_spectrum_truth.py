"""Truth of spectra: traces, electrons, what overlaps, how well lines are seen."""

import tracemalloc
from functools import cache

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import units
from tests.truesky import nightly
from tests.truesky.render import fields, infrared, spectroscopic
from tests.truesky.render.drawing import test_arcs
from tests.truesky.render.spectroscopic import strip
from truesky.fluxes import passbands, wavelength_windows
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import galaxies_from_table
from truesky.render.camera import astrometry
from truesky.render.channels.aim import Aim
from truesky.render.exposure import spectrum_truth
from truesky.render.exposure.spectrum_truth import TracePaths
from truesky.render.products import truth_table
from truesky.render.sources import colours, lensed_arcs
from truesky.request.accuracy import DRAFT

BAND = passbands.load("nisp_red")


@cache
def pair():
    """Two stars in one row, 60 px apart, one alone, and one whose second order alone is there."""
    return spectroscopic.rendered([18.0, 18.5, 19.0, 16.0], [260.0, 320.0, 300.0, -1100.0], [24.0, 24.5, 75.0, 50.0])


def rows(found):
    return truth_table.spectra(found).to_pylist()


def test_a_row_for_each_order_with_light_on_the_detector():
    found = rows(pair())
    ids = pair().sources.ids.tolist()
    assert [(row["id"], row["order"]) for row in found] == sorted((row["id"], row["order"]) for row in found)
    assert {row["order"] for row in found if row["id"] in ids[:3]} == {1}
    assert {row["order"] for row in found if row["id"] == ids[3]} == {2}
    assert sum(row["drawn"] for row in found) == pytest.approx(pair().noise_free.sum(dtype=float), rel=1e-5)
    for one in ids:
        drawn = sum(row["drawn"] for row in found if row["id"] == one)
        assert drawn == pytest.approx(float(pair().drawn_electrons[ids.index(one)]), rel=1e-9)
    for row in found:
        assert row["drawn"] <= 1.001 * row["expected"]


def test_the_trace_runs_through_the_light():
    """The row of the light at some columns, and the ends."""
    (row,) = (row for row in rows(pair()) if row["id"] == pair().sources.ids[2])
    image = pair().noise_free.astype(float)
    t = np.linspace(0.2, 0.8, 5)
    x, y = (np.polynomial.polynomial.polyval(t, row[f"trace_{axis}"]) for axis in "xy")
    for column, wanted in zip(np.rint(x).astype(int), y, strict=True):
        light = image[60:92, column - 3 : column + 4].sum(axis=1)
        assert np.average(np.arange(60, 92), weights=light) == pytest.approx(wanted, abs=0.3)
    for axis in "xy":
        assert row[f"{axis}_first"] == row[f"trace_{axis}"][0]
        assert row[f"{axis}_last"] == pytest.approx(sum(row[f"trace_{axis}"]))


def test_who_overlaps_whom():
    found = {(row["id"], row["order"]): row for row in rows(pair())}
    one, other, alone, beside = pair().sources.ids.tolist()
    assert found[one, 1]["contaminants"] == [other]
    assert found[other, 1]["contaminants"] == [one]
    # 60 of some 500 columns are not overlapped.
    assert 0.8 < found[one, 1]["overlapped"] < 0.95
    assert found[alone, 1]["overlapped"] == 0.0
    assert found[beside, 2]["overlapped"] is None
    assert found[beside, 2]["contaminants"] == []


def crowd(seed=3, n=40):
    rng = np.random.default_rng(seed)
    order = rng.choice([0, 1, 1, 2], n)
    along = [np.array([rng.uniform(-300, 600), rng.choice([12.0, 512.0])]) for _ in range(n)]
    across = [np.array([rng.uniform(0, 96), rng.uniform(-20, 20)]) for _ in range(n)]
    return TracePaths(rng.integers(0, 30, n), order, along, across, rng.uniform(1, 4, n), rng.uniform(0, 10, n))


@pytest.mark.parametrize("seed", range(3))
def test_overlaps_are_those_of_every_pair_of_traces(seed):
    """Against all pairs, bin by bin."""
    paths, nx, least = crowd(seed), 640, 3.0
    part, beside = spectrum_truth.find_overlaps(paths, nx, least)
    path, at, row = spectrum_truth._bins(paths, nx)
    for i in range(len(paths.order)):
        bins, covered, others = at[path == i], 0, set()
        for place, own in zip(bins, row[path == i], strict=True):
            near = [
                j
                for j, there in zip(path[at == place], row[at == place], strict=True)
                if paths.source[j] != paths.source[i] and paths.level[j] >= least
                and abs(there - own) < paths.half[i] + paths.half[j]
            ]  # fmt: skip
            covered += bool(near)
            others |= {int(paths.source[j]) for j in near}
        wanted = covered / len(bins) if paths.order[i] == 1 and len(bins) else 0.0
        assert part[i] == pytest.approx(wanted)
        assert set(beside[i].tolist()) == (others if paths.order[i] == 1 else set())


@pytest.mark.parametrize("n", [8000, pytest.param(50_000, marks=pytest.mark.nightly)])
def test_a_crowd_fits_into_memory(n):
    """Every pair is held once, not once a bin: of 5e4 sources there are 7e7 in all bins, of 16 bytes."""
    rng = np.random.default_rng(1)
    along = [np.array([start, 512.0]) for start in rng.uniform(-512, 2040, n)]
    across = [np.array([row, 5.0]) for row in rng.uniform(0, 2040, n)]
    paths = TracePaths(np.arange(n), np.ones(n, np.int64), along, across, np.full(n, 1.5), np.full(n, 10.0))
    tracemalloc.start()
    part, beside = spectrum_truth.find_overlaps(paths, 2040, 1.0)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 6e8 * n / 50_000
    # A trace meets those that lie nearer than two widths, for half of its length on the average.
    wanted = n * 1024 / 2552 * 6.0 / 2040
    assert np.mean([len(some) for some in beside]) == pytest.approx(wanted, rel=0.1)
    assert (part > 0.0).sum() == sum(len(some) > 0 for some in beside)


@nightly.parametrize(("times", "counts"), [(0.5, False), (2.0, True)], (1,))
def test_a_neighbour_counts_that_brings_as_much_to_a_column_as_a_pixel_s_noise(times, counts):
    """To ten pixels of a square of ten as much as the noise of their sum."""
    x, y = [290.0, 320.0], [48.0, 48.5]
    (row,) = (row for row in rows(spectroscopic.rendered([18.0], x[:1], y[:1])) if row["order"] == 1)
    seen = min(row["x_last"], 639.0) - max(row["x_first"], 0.0)
    mag = 18.0 - 2.5 * np.log10(times * pair().scene.pixel_noise / (row["drawn"] / seen))
    found = spectroscopic.rendered([18.0, mag], x, y)
    one, other = found.sources.ids.tolist()
    beside = {row["id"]: row["contaminants"] for row in rows(found) if row["order"] == 1}
    assert beside[one] == ([other] if counts else [])


def test_without_sources_there_are_no_rows():
    found = spectroscopic.rendered(detector=strip())
    assert truth_table.spectra(found).num_rows == 0
    assert truth_table.spectra(spectroscopic.rendered(kind="dark", sky=0.0)) is None


def test_arcs_are_as_wide_as_their_pictures():
    """A galaxy and, five rows away, its image by a lens: four arcs 1.5" from the lens."""
    row, x, y = spectroscopic.exposed(strip()), np.array([300.0]), np.array([48.0])
    found = infrared.tables(strip(), row, 19.0, x, y, {"disk_half_light_radius": 0.1})
    seen = Aim.from_exposure(fields.exposure(**row), strip()).wcs
    place = (float(part[0]) for part in astrometry.sky_of_pixel(seen, x, y + 5.0))
    blobs = [(1.5, 0.0, 1.0), (-1.5, 0.0, 1.0), (0.0, 1.5, 1.0), (0.0, -1.5, 1.0)]
    arcs = test_arcs.lens(int(found[0]["id"][0].as_py()), *place, blobs)
    (picture,) = lensed_arcs.arcs(arcs, found[0]["id"].to_numpy(), np.ones(1)).pictures
    assert picture.half_light == pytest.approx(1.5, abs=0.06)
    both = fields.rendered(row, strip(), found, spectroscopic.MISSION, DRAFT, lenses=arcs)
    beside = {one["id"]: one["contaminants"] for one in rows(both) if one["order"] == 1}
    galaxy, lens = sorted(beside)
    assert beside == {galaxy: [lens], lens: [galaxy]}


def with_line(flux, x=300.0, **options):
    """A galaxy of half-light radius 0.25" with H alpha of a flux at 1.6 um, as bright as its spectrum is."""
    column = dict.fromkeys(colours.GALAXY_COLUMNS, 0.0)
    column |= {
        "kind": 0, "z_obs": 16000.0 / 6564.614 - 1.0, "mag_r01": 24.0, "abs_mag_r01": -20.0, "frac_1": 1.0, "sed_1": 8,
        "flux_halpha": flux, "disk_half_light_radius": 0.25,
    }  # fmt: skip
    table = pa.table({name: [value] for name, value in {**column, "id": 1}.items()})
    library = templates.galaxy_library()
    found = galaxies_from_table(table, library)
    (spectrum,) = wavelength_windows.galaxy_spectra(found, int(BAND.wavelength[0]), len(BAND.wavelength), library)
    mag = units.AB_UJY - 2.5 * np.log10(units.ujy_of_cgs(passbands.ab_flux(BAND, BAND.wavelength, spectrum)))
    return spectroscopic.rendered([mag], [x], [48.0], body=column, **options)


@nightly.parametrize(("x", "there"), [(300.0, True), (630.0, False)], (1,))
def test_a_line_beyond_the_detector_is_not_seen(x, there):
    """At 1.6 um, 40 columns from the undispersed place; half of the order is on the detector."""
    (row,) = (row for row in rows(with_line(2e-16, x)) if row["order"] == 1)
    t = (np.array(row["line_wavelength"]) - row["wavelength_first"]) / (
        row["wavelength_last"] - row["wavelength_first"]
    )
    assert row["x_last"] > 640.0 or there
    column = np.polynomial.polynomial.polyval(t, row["trace_x"])
    assert ((column > -0.5) & (column < 639.5)).all()
    assert (16000.0 in np.rint(row["line_wavelength"])) == there
    assert len(row["line_snr"]) == len(row["line_expected"]) == len(column)


def test_lines_are_of_the_exposure_s_own_zero_point():
    """Twice the zero-point flux doubles the electrons of a source and of its lines."""
    nominal = infrared.exposed(strip(), band="nisp_red")["zero_point"]
    one, two = (
        next(row for row in rows(with_line(2e-16, zero_point=nominal + more)) if row["order"] == 1)
        for more in (0.0, 2.5 * np.log10(2.0))
    )
    assert two["expected"] == pytest.approx(2.0 * one["expected"], rel=1e-6)
    np.testing.assert_allclose(two["line_expected"], 2.0 * np.array(one["line_expected"]), rtol=1e-6)


def test_a_line_has_its_electrons_and_is_seen_as_well_as_is_required():
    """2e-16 erg s-1 cm-2 at 1.6 um: 3.5 times the noise of four exposures; and as many electrons as are drawn of it."""
    seen, without = with_line(2e-16), with_line(0.0)
    (row,) = (row for row in rows(seen) if row["order"] == 1)
    at = int(np.argmin(np.abs(np.array(row["line_wavelength"]) - 16000.0)))
    assert row["line_wavelength"][at] == pytest.approx(16000.0)
    t = (16000.0 - row["wavelength_first"]) / (row["wavelength_last"] - row["wavelength_first"])
    x, y = (round(float(np.polynomial.polynomial.polyval(t, row[f"trace_{axis}"]))) for axis in "xy")
    box = np.s_[y - 12 : y + 13, x - 12 : x + 13]
    image = (seen.noise_free - without.noise_free)[box].astype(float)
    # Some of its light is outside the box.
    assert 0.93 < image.sum() / row["line_expected"][at] < 1.0
    assert 2.0 * row["line_snr"][at] > 3.5
    # Compare with a matched filter on the image of the line, with noise of sky and readout.
    continuum = without.noise_free[box] + seen.scene.pixel_noise**2
    assert row["line_snr"][at] == pytest.approx(np.sqrt((image**2 / (continuum + image)).sum()), rel=0.15)
