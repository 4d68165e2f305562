"""Test the job that makes the table `observed`, on small tables of two neighbouring cells."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema import ids, sky, units
from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from lake_schema.tables.survey.depth import DEPTH
from lake_schema.tables.survey.depth import ORDER as DEPTH_ORDER
from tests import requests
from tests.truesky.emulator import samples
from tests.universe import rows_of
from truesky.emulator import build_observed, observation
from truesky.emulator.model import read_model
from truesky.emulator.observation import Conditions, Sources
from truesky.emulator.train import SIZE_COLUMNS, galaxy_radius
from truesky.randomness.per_source import PerSourceGenerator
from truesky.request.from_toml import from_table
from truesky.survey_maps.depth_lookup import read_depth_map

BANDS = ("euclid_vis", "euclid_j")
# A side of this cell of order 5 is common with that of the next cell.
CELL = 1607


def asked(models, **changes):
    import tomllib

    request = from_table(tomllib.loads(requests.text(requests.shallow(27.0, 26.0), requests.FIELD.format(0.1))))
    return replace(request, model=tuple(map(str, models)), **changes)


def places(n, seed):
    """Return positions about a point of the edge of the cell, in the order of their index."""
    rng = np.random.default_rng(seed)
    lon, lat = np.moveaxis(np.asarray(sky.cell_corners(5, np.array([CELL])))[0], -1, 0)
    middle = 0.5 * (lon[0] + lon[1]), 0.5 * (lat[0] + lat[1])
    ra, dec = (sky.wrap_angle(middle[0] + rng.uniform(-0.04, 0.04, n)), middle[1] + rng.uniform(-0.04, 0.04, n))
    index = sky.healpix_29(ra, dec)
    order = np.argsort(index)
    return ra[order], dec[order], index[order]


def publish_catalogue(lake, table, kind, n, seed):
    """Publish a catalogue with its fluxes in both bands."""
    ra, dec, index = places(n, seed)
    cells = np.unique(index >> 48).tolist()
    flux_table = fluxes("galaxy" if kind == 0 else "star", BANDS)
    magnitude = {band: 27.0 - np.random.default_rng(seed + i).exponential(1.5, n) for i, band in enumerate(BANDS, 1)}

    def place(cell):
        here = np.flatnonzero(index >> 48 == cell)
        columns = {"_healpix_29": index[here], "ra": ra[here], "dec": dec[here]}
        return here, columns | {"id": ids.source_id(kind, cell << 6, here)}

    def sources(root, facts):
        here, columns = place(facts["cell"])
        rows = rows_of(table, here.size, 1)
        extra = {"kind": np.zeros(here.size, np.int8)} if kind == 0 else {}
        return Output(table.build({name: rows[name] for name in table.names} | columns | extra))

    def beside(root, facts):
        here, columns = place(facts["cell"])
        light = {f"f_nu_{band}": units.f_nu_of_mag(magnitude[band][here]) for band in BANDS}
        return Output(flux_table.build({**columns, **light, "integrated": np.zeros(here.size, bool)}))

    tasks = tuple(Task(layout.cell_file(5, cell), {"cell": cell}) for cell in cells)
    facts = {"seed": 1, "universe": None}
    publish.make_version(lake, Plan(table, facts, tasks), sources)
    publish.make_version(lake, Plan(flux_table, {"input": read.version(lake, table.name).key}, tasks), beside)
    return cells


def publish_depth(lake, cells, bands=BANDS, depth=26.2):
    """Publish a depth in all pixels about the sources, but in the second band only in half of every other pixel."""

    def rows(root, facts):
        ra, dec, _ = places(4000, 1)
        pixels = np.unique(sky.cell_at(ra, dec, DEPTH_ORDER))
        pixels = pixels[pixels >> 2 * (DEPTH_ORDER - 5) == facts["cell"]]
        pixel = np.concatenate([pixels[:: i + 1] for i in range(len(bands))])
        band = np.repeat(bands, [len(pixels[:: i + 1]) for i in range(len(bands))])
        order = np.lexsort((band, pixel))
        columns = {name: np.zeros(len(pixel)) for name in DEPTH.names}
        columns |= {"camera": np.full(len(pixel), "vis"), "exposures": np.ones(len(pixel), np.int16)}
        columns |= {"covered": np.where(band == "euclid_j", 0.5, 1.0)}
        columns |= {"depth_point": np.full(len(pixel), depth), "psf_area": np.full(len(pixel), 0.125)}
        columns |= {"pixel": pixel, "band": band, "_healpix_29": pixel << 2 * (29 - DEPTH_ORDER)}
        columns |= {"mask": np.zeros(len(pixel), np.int16), "origin": np.zeros(len(pixel), np.int8)}
        return Output(DEPTH.build({name: values[order] for name, values in columns.items()}))

    tasks = tuple(Task(layout.cell_file(5, cell), {"cell": cell}) for cell in cells)
    plan = read.version(lake, "exposures").key
    publish.make_version(lake, Plan(DEPTH, {"depth": depth, "bands": list(bands), "exposures": plan}, tasks), rows)


def publish_plan(lake, cameras=("vis", "vis"), bands=BANDS):
    exposures = rows_of(EXPOSURES, 2).to_pydict()
    exposures |= {"camera": list(cameras), "band": list(bands), "image_type": ["science"] * 2}
    publish.make_version(
        lake, Plan(EXPOSURES, {"cameras": list(cameras), "bands": list(bands)}, (Task("all.parquet", {}),)),
        lambda root, facts: Output(EXPOSURES.build(exposures)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    root = tmp_path_factory.mktemp("lake")
    cells = publish_catalogue(root, GALAXIES, 0, 4000, 1)
    publish_catalogue(root, STARS, 5, 300, 2)
    publish_plan(root)
    publish_depth(root, cells)
    return root


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return [samples.write(folder / f"{band}.parquet", band=band, seed=seed) for seed, band in enumerate(BANDS)]


@pytest.fixture(autouse=True)
def any_universe(monkeypatch):
    """The catalogues here belong to no universe."""
    monkeypatch.setattr(build_observed.universe, "check_catalogues", lambda catalogues, request: None)


@pytest.fixture(scope="module")
def made(lake, models):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_observed.universe, "check_catalogues", lambda catalogues, request: None)
        (step,) = build_observed.steps(lake, asked(models))
        publish.make_version(lake, step.plan, step.run_task)
    return read.version(lake, "observed")


def test_each_source_in_the_fields_of_view_has_one_row(lake, made):
    rows = made.rows()
    source_ids = rows["id"].to_numpy()
    assert len(np.unique(source_ids)) == len(source_ids)
    galaxies, stars = (read.version(lake, name).rows(["id"])["id"].to_numpy() for name in ("galaxies", "stars"))
    assert np.isin(galaxies, source_ids).mean() > 0.999
    assert 0.3 < np.isin(stars, source_ids).mean() <= 1.0
    assert len(made.partitions) == 2
    for partition in made.partitions:
        index = made.rows(["_healpix_29"], [partition])["_healpix_29"].to_numpy()
        first, last = sky.cell_range(*layout.cell_of_file(partition))
        assert (np.diff(index) >= 0).all()
        assert (index >= first).all()
        assert (index < last).all()


def test_bands_without_exposure_are_missing(made):
    rows = made.rows()
    assert rows["detected_euclid_vis"].null_count == 0
    assert 0 < rows["detected_euclid_j"].null_count < len(rows)
    assert rows["mag_auto_euclid_vis"].null_count == (len(rows) - rows["detected_euclid_vis"].to_numpy().sum())
    assert not np.asarray(rows["extrapolated_euclid_vis"]).any()


def test_sources_are_covered_with_the_covered_fraction_of_their_pixel(lake, made):
    """sample: about 2000 galaxies in half covered pixels; significance: 4 sigma"""
    rows, place = made.rows(), read_depth_map(read.version(lake, "depth"), "euclid_j", ())
    in_band = place.rows_at(rows["ra"].to_numpy(), rows["dec"].to_numpy()) >= 0
    is_covered = np.asarray(rows["detected_euclid_j"].is_valid())
    assert 1000 < in_band.sum() < 3000
    assert is_covered[in_band].mean() == pytest.approx(0.5, abs=4.0 * np.sqrt(0.25 / in_band.sum()) + 0.01)


def test_the_rows_are_those_of_all_sources_drawn_at_once(lake, models, made):
    """A source has the measurements, and neighbours on both sides of the edge, that it has without partitions."""
    opened = [read_model(path) for path in models]
    galaxies, stars = (read.version(lake, name).rows(["id", "ra", "dec"]) for name in ("galaxies", "stars"))
    light = [read.version(lake, name).rows() for name in ("galaxy_fluxes", "star_fluxes")]
    ids_, ra, dec = (np.concatenate([galaxies[name], stars[name]]) for name in ("id", "ra", "dec"))
    sizes = read.version(lake, "galaxies").rows(list(SIZE_COLUMNS))
    radius = galaxy_radius({name: sizes[name].to_numpy() for name in SIZE_COLUMNS})
    radius = np.concatenate([radius, np.zeros(len(stars))])
    flux = {band: np.concatenate([rows[f"f_nu_{band}"] for rows in light]) for band in BANDS}
    magnitude = {band: units.mag_of_f_nu(values.astype(float)) for band, values in flux.items()}
    conditions, chance = {}, PerSourceGenerator(ids_, asked(models).seed, "emulator.coverage").random()
    for model in opened:
        place = read_depth_map(read.version(lake, "depth"), model.band, ("depth_point", "psf_area", "covered"))
        row = place.rows_at(ra, dec)
        middle = [np.mean(model.facts["conditions"][name]) for name in ("depth", "psf_area")]
        values = [np.where(row >= 0, place.columns[name][row].astype(float), default)
                  for name, default in zip(("depth_point", "psf_area"), middle, strict=True)]  # fmt: skip
        is_covered = (row >= 0) & (chance < place.columns["covered"][row])
        conditions[model.band] = Conditions(is_covered, *values)
    sources = Sources(ids_, ra, dec, radius, magnitude)
    expected = observation.observe(sources, conditions, opened, asked(models).seed)
    rows, order = made.rows().sort_by("id"), np.argsort(ids_)
    order = order[np.isin(ids_[order], rows["id"].to_numpy())]
    assert rows["id"].to_numpy() == pytest.approx(ids_[order], abs=0)
    for name in ("detected_euclid_vis", "detected_euclid_j", "blended_euclid_vis", "flags_euclid_j"):
        assert rows[name].to_pylist() == expected[name][order].tolist(), name
    given = np.ma.filled(expected["mag_auto_euclid_vis"][order].astype(float), np.nan)
    assert rows["mag_auto_euclid_vis"].to_numpy() == pytest.approx(given, abs=1e-3, nan_ok=True)
    assert rows["ra"].to_numpy() == pytest.approx(expected["ra"][order], abs=1e-9)


def test_a_file_of_a_model_that_is_replaced_during_the_job_is_refused(lake, tmp_path):
    path = samples.write(tmp_path / "m.parquet")
    (step,) = build_observed.steps(lake, asked([path]))
    samples.write(path, seed=9)
    with pytest.raises(BadInput, match=r"m\.parquet: it was replaced during the job"):
        step.run_task(lake, {**step.plan.facts, **step.plan.tasks[0].facts})


def test_a_model_that_changes_during_the_run_is_refused(lake, models, made):
    facts = {**made.manifest["facts"], "part": made.partitions[0], "models": ["0" * 64] * 2}
    with pytest.raises(BadInput, match="it was replaced during the job"):
        build_observed.observe_partition(tuple(map(str, models)), lake, facts)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"model": ()}, "--model is required"),
        ({"band": "euclid_h"}, "no fluxes in euclid_h"),
        ({"camera": "nisp"}, "is one of camera nisp, but the plan has vis"),
        ({"conditions": {**samples.FACTS["conditions"], "depth": [23.0, 24.0]}}, "100 % are outside"),
        ({"limit": 20.0}, "mag brighter than"),
    ],
)
def test_bad_input_is_named_in_one_line(lake, tmp_path, change, problem):
    limit, facts = change.get("limit"), {k: v for k, v in change.items() if k not in ("limit", "model")}
    request = asked([samples.write(tmp_path / "m.parquet", **facts)] if "model" not in change else [])
    if limit:
        request = replace(request, universe=replace(request.universe, galaxy_limit=limit))
    with pytest.raises(BadInput, match=problem) as caught:
        build_observed.steps(lake, request)
    assert len(str(caught.value).splitlines()) == 1


def test_models_that_do_not_fit_together_are_refused(lake, models, tmp_path):
    with pytest.raises(BadInput, match="given twice"):
        build_observed.steps(lake, asked([models[0], models[0]]))
    other = {**samples.FACTS["settings"], "threshold": 3.0}
    path = samples.write(tmp_path / "m.parquet", band="euclid_j", settings=other)
    with pytest.raises(BadInput, match="other settings of the detection than the first model: threshold 3"):
        build_observed.steps(lake, asked([models[0], path]))


def test_depths_outside_the_range_are_flagged_on_request(lake, tmp_path):
    path = samples.write(tmp_path / "m.parquet", conditions={**samples.FACTS["conditions"], "depth": [23.0, 24.0]})
    (step,) = build_observed.steps(lake, asked([path], extrapolate=True))
    rows = step.run_task(lake, {**step.plan.facts, **step.plan.tasks[0].facts}).rows
    assert np.asarray(rows["extrapolated_euclid_vis"]).all()


def test_a_lake_without_depth_names_the_command(lake, models, tmp_path):
    root = tmp_path / "lake"
    publish_catalogue(root, GALAXIES, 0, 50, 1)
    publish_catalogue(root, STARS, 5, 50, 2)
    with pytest.raises(BadInput, match="no table exposures"):
        build_observed.steps(root, asked(models))
    publish_plan(root)
    with pytest.raises(BadInput, match="run truesky depth REQUEST"):
        build_observed.steps(root, asked(models))


def test_two_cameras_in_the_band_of_a_model_are_refused(models, tmp_path):
    publish_catalogue(tmp_path, GALAXIES, 0, 50, 1)
    publish_catalogue(tmp_path, STARS, 5, 50, 2)
    publish_plan(tmp_path, ("vis", "nisp"), ("euclid_vis", "euclid_vis"))
    with pytest.raises(BadInput, match="the plan observes euclid_vis with the cameras nisp and vis"):
        build_observed.steps(tmp_path, asked(models[:1]))


def test_tables_of_an_older_plan_or_catalogue_are_refused(models, tmp_path):
    cells = publish_catalogue(tmp_path, GALAXIES, 0, 50, 1)
    publish_catalogue(tmp_path, STARS, 5, 50, 2)
    publish_plan(tmp_path, ("nisp", "vis"))
    publish_depth(tmp_path, cells)
    publish_plan(tmp_path)
    with pytest.raises(BadInput, match="depth was made from another plan: run truesky depth"):
        build_observed.steps(tmp_path, asked(models))
    old = read.version(tmp_path, "star_fluxes")
    publish.make_version(
        tmp_path,
        Plan(fluxes("star", BANDS), {"input": "0" * 16}, tuple(Task(name, {"part": name}) for name in old.partitions)),
        lambda root, facts: Output(old.rows(partitions=[facts["part"]])),
    )
    with pytest.raises(BadInput, match="star_fluxes was computed from another version of stars: run truesky fluxes"):
        build_observed.steps(tmp_path, asked(models))
