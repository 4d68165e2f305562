"""Every kind of image that VIS takes: planned from the example request, rendered on a small frame, written, read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lake_schema.fits import images
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import calibrated, fields
from tests.truesky.render.fields import exposure, fluxes, galaxies, stars
from truesky.randomness import rng
from truesky.render.camera import astrometry, detectors
from truesky.render.channels import vis
from truesky.render.effects.effect import apply_all
from truesky.render.effects.light import calibration_lamp
from truesky.render.effects.scene import Scene
from truesky.render.exposure import rendered_detector, scene_factory
from truesky.render.plan_exposures import plan
from truesky.render.planning import variants
from truesky.render.products import fits_files, read_back
from truesky.request.from_toml import parse

EXAMPLE = Path(__file__).parents[4] / "requests" / "vis_calibration.toml"
# Same size as in other tests, so that they share the planes of the PSF.
SIDE = 256


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """Return the request, the mission and one exposure of each kind, by (image type, seconds, lamp)."""
    request = parse(EXAMPLE)
    mission, exposures, tasks = plan(tmp_path_factory.mktemp("none"), request)
    assert len(tasks) == len(exposures) == 3 + 20 + 3 + 24 + 3 + 4 + 4 + 2 + 1 + 1 + 1
    rows = {}
    for row in exposures.to_pylist():
        rows.setdefault((row["image_type"], round(row["exposure_time_s"]), row["lamp"]), row)
    return request, mission, rows


def written(planned, row, folder, forced=None, magnitude=20.0):
    """Render a galaxy and a star in the lower half of a detector; return the result and the header of its file."""
    request, mission, _ = planned
    mission = variants.variant(row["settings"], mission, request.accuracy, {}).mission
    detector = replace(detectors.detector("vis", "3-4", mission), nx=SIDE, ny=SIDE, injection_rows=0)
    system = astrometry.wcs(detector, row["ra"], row["dec"], row["position_angle"])
    where = [astrometry.sky_of_pixel(system, [x], [30.0]) for x in (30.0, 90.0)]
    flux = 10 ** (0.4 * (23.9 - magnitude))
    body, point = galaxies(*where[0]), stars(*where[1])
    tables = body, fluxes(body, "euclid_vis", flux), point, fluxes(point, "euclid_vis", flux)
    one = fields.rendered(row, detector, tables, mission, request.accuracy, request.seed, forced, request.truth)
    rows, writers = fits_files.products(one, request.truth, request.compression == "rice")
    for path, write in writers.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write(folder / path)
    read = read_back.frame(folder / rows["path"][0].as_py())
    np.testing.assert_array_equal(read.data, one.science)
    for content, path in zip(rows["content"].to_pylist()[1:], rows["path"].to_pylist()[1:], strict=True):
        (image,) = images.read_images(folder / path)
        np.testing.assert_array_equal(image.data, one.maps[content])
    return one, {keyword: value for keyword, value, _ in read.cards}


def test_the_example_asks_for_every_kind(planned):
    assert set(planned[2]) == {
        ("science", 561, None), ("science", 90, None), ("flat", 10, 1), ("bias", 0, None), ("dark", 1000, None),
        *(("flat", 10, lamp) for lamp in range(1, 7)), ("charge_injection", 0, None), ("self_calibration", 561, None),
        # Exposure times of 5000 cycles of six phases.
        *(("trap_pumping", seconds, None) for seconds in (60, 180, 600, 1800)), ("defocus", 561, None),
        ("bleeding", 561, None), ("stray_light", 561, None), ("white_dwarf", 561, None),
    }  # fmt: skip
    assert set(vis.EFFECTS) == {kind for kind, *_ in planned[2]} | {"deep"}


@nightly.parametrize(
    ("key", "least", "most"),
    [
        # Limits of the median of the frame, in electrons above the bias.
        (("science", 561, None), 100, 200),
        pytest.param(("science", 90, None), 14, 40, marks=pytest.mark.nightly),
        # This kind equals a science frame. A daily test renders it through the jobs.
        pytest.param(("self_calibration", 561, None), 100, 200, marks=pytest.mark.nightly),
        (("bias", 0, None), -4, 4),
        (("dark", 1000, None), -4, 4),
        (("flat", 10, 3), 18_000, 21_000),
        (("charge_injection", 0, None), -4, 4),
        (("trap_pumping", 600, None), 13_500, 16_500),
        (("defocus", 561, None), 100, 200),
        # The wings of five stars of 12 mag fill the small frame.
        (("bleeding", 561, None), 200, 600),
        (("white_dwarf", 561, None), 100, 200),
    ],
    (0, 3, 5, 7),
)
def test_each_is_rendered_and_read(planned, tmp_path, key, least, most):
    row = planned[2][key]
    one, header = written(planned, row, tmp_path)
    assert (header["IMAGETYP"], round(header["EXPTIME"]), header.get("LAMP")) == key
    own = variants.variant(row["settings"], planned[1], planned[0].accuracy, {}).mission
    assert header["MISSION"] == own.fingerprint
    level = np.median(calibrated.adu_to_electrons(one.science, one.scene))
    assert least < level < most
    looks = vis.CHANNEL.sees_sky(key[0])
    # Sources of the catalogue, and calibration stars.
    assert len(one.sources) == 2 * looks + 5 * (key[0] in ("bleeding", "white_dwarf"))
    names = {d.name for d in one.decisions if d.applied}
    assert ("readout_trail" in {d.name for d in one.decisions}) == (key[0] == "flat")
    assert ("cosmic_rays" in names) == (header["EXPTIME"] > 0)
    # The header contains the key of the random numbers of each applied effect.
    effects = {e.name: e for e in vis.EFFECTS[key[0]]}
    for number, decision in enumerate(one.decisions, start=1):
        assert header[f"EFFECT{number}"].startswith(f"{decision.name}: {'on' if decision.applied else 'off'}")
        told = header.get(f"EFKEY{number}")
        assert (told is not None) == (decision.applied and decision.name in effects)
        if told is not None:
            mine = np.random.Philox(key=np.array([int(told[:16], 16), int(told[16:], 16)], np.uint64))
            identity = rendered_detector.random_identity(
                effects[decision.name], exposure(**row), "3-4", planned[0].seed
            )
            again = rng.stream(*identity)
            assert np.random.Generator(mine).random() == again.random()


def test_sky_and_stars_are_in_a_flat(planned, tmp_path):
    """The shutter is open: a bright star is exposed and leaves a trail during readout, as does the zodiacal light."""
    row = planned[2]["flat", 10, 1]
    quiet = dict.fromkeys(("cosmic_rays", "readout_cosmic_rays", "poisson", "read_noise", "hot_pixels"), False)
    one, _ = written(planned, row, tmp_path, quiet, magnitude=15.0)
    still, _ = written(planned, row, tmp_path, quiet | {"readout_trail": False}, magnitude=15.0)
    dark, _ = written(planned, {**row, "sky": 0.0}, tmp_path, quiet, magnitude=15.0)
    gain, mission = planned[1].value("vis.gain"), planned[1]
    assert one.science[30, 90].astype(float) - one.science[30, 120] > 1e4 / gain
    trail = (one.science.astype(float) - still.science)[:, 85:96].sum(axis=1) * gain
    # The lower half is read downwards: rows 31 to 127 pass the star in row 30, and collect its light.
    share = mission.value("vis.readout_time") / (4132 / 2 + mission.value("vis.fpa.parallel_overscan")) / 10.0
    light = one.noise_free[:50, 85:96].sum()
    # The tolerance allows for the trail of zodiacal light over up to 128 rows, and for the slope of the amplifier.
    zodiacal = 11 * 128 * share * row["sky"] * 10.0
    assert trail[45:60].mean() == pytest.approx(share * light, rel=0.1, abs=zodiacal)
    assert abs(trail[:10].mean()) < 0.02 * share * light + zodiacal
    assert abs(trail[160:].mean()) < 0.02 * share * light + zodiacal
    assert np.median(one.science.astype(float) - dark.science) * gain == pytest.approx(row["sky"] * 10.0, abs=gain)


def test_lamps_shine_from_their_own_side(planned, tmp_path):
    """Lamps are 60 deg apart. Gradients over the frame of the second and fourth lamp are compared with the first."""
    _, mission, rows = planned
    quiet = dict.fromkeys(("cosmic_rays", "readout_cosmic_rays", "poisson", "pixel_response", "bias_drift"), False)
    slopes = {}
    for lamp in (1, 2, 4):
        # All lamps give the same signal, whatever the response of the band is.
        seen = calibration_lamp.efficiency_of_scene(Scene(mission, "vis", 10.0, 0.0, 0.0), lamp)
        level = mission.value("vis.flat.signal", "electron") / seen
        equal = {key: (mission.value(key), mission.parameter(key).unit) for key in ("vis.gain", "vis.bias")}
        as_bright = resolve(overrides={"vis.flat.signal": (level, "electron"), **equal})
        one, header = written((planned[0], as_bright, rows), rows["flat", 10, lamp], tmp_path, quiet, magnitude=25.0)
        assert header["LAMP"] == lamp
        frame, half = one.science.astype(float), SIDE // 2
        slopes[lamp] = np.array([np.diff([f[:, :half].mean(), f[:, half:].mean()])[0] for f in (frame, frame.T)])
    everything = detectors.detectors("vis", mission)
    reach = [max(abs(getattr(d, a)) for d in everything) + d_n * 0.05 for a, d_n in (("x", 4096), ("y", 4136))]
    # Difference (ADU) between the middles of the halves. The detector is mounted upside down.
    steepest = -mission.value("vis.flat.signal") * mission.value("vis.flat.gradient") / mission.value("vis.gain")
    gx, gy = (steepest * half * 0.1 / r for r in reach)
    for lamp, wanted in ((2, (-0.5 * gx, 3**0.5 / 2 * gy)), (4, (-2.0 * gx, 0.0))):
        # The tolerance covers the read noise of four halves, and the response, which is 2 % below 1 at this level.
        np.testing.assert_allclose(slopes[lamp] - slopes[1], wanted, atol=0.12)


@pytest.mark.parametrize("kind", ["science", "flat", "charge_injection"])
def test_forcing_one_effect_leaves_the_numbers_of_all_others(planned, kind):
    """Each effect gets a separate, unused random generator, whichever other effects are switched on or off.

    An effect that depends on the pattern of another effect gets a generator with the same numbers.
    """
    row = next(row for (name, *_), row in planned[2].items() if name == kind)
    _, mission, _ = planned
    detector = replace(detectors.detector("vis", "3-4", mission), nx=32, ny=32, injection_rows=0)
    scene = scene_factory.from_exposure(exposure(**row), detector, mission, planned[0].accuracy)

    def keys(forced):
        found = {}

        def watched(effect):
            def apply(frame, *parameters, rng, **out):
                state = rng.bit_generator.state
                found[effect.name] = (*state["state"]["key"].tolist(), *state["state"]["counter"].tolist())
                return effect.apply(frame, *parameters, rng=rng, **out)

            return replace(effect, apply=apply)

        def stream(effect):
            return rng.stream(*rendered_detector.random_identity(effect, exposure(**row), "3-4", 1))

        apply_all(
            np.full((32, 32), 50.0), [watched(e) for e in vis.EFFECTS[kind]], replace(scene, forced=forced), stream
        )
        return found

    everything = {e.name: True for e in vis.EFFECTS[kind]}
    all_on = keys(everything)
    assert set(all_on) == set(everything)
    follows = {e.name: e.random_stream for e in vis.EFFECTS[kind] if e.random_stream}
    assert follows == ({"readout_trail": "pixel_response"} if kind == "flat" else {})
    assert {name: all_on[other] for name, other in follows.items()}.items() <= all_on.items()
    assert len(set(all_on.values())) == len(all_on) - len(follows)
    for effect in vis.EFFECTS[kind]:
        if effect.optional:
            without = keys({**everything, effect.name: False})
            assert without == {name: key for name, key in all_on.items() if name != effect.name}
