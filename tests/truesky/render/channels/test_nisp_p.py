"""NISP-P: content of a file, values of its pixels, and extreme settings."""

from functools import cache

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.mission.configuration import resolve
from tests.truesky.render import infrared
from tests.truesky.render.fields import small
from truesky.fluxes import passbands
from truesky.render.effects.charge import ramp
from truesky.render.effects.charge.persistence import PersistenceModel
from truesky.render.effects.readout import macc, ramp_noise
from truesky.render.products import fits_files, read_back

QUIET = dict.fromkeys(("ramp_cosmic_rays", "drift", "group_noise", "output_gain", "dark_map", "pixel_response"), False)
MACC = "nisp.macc.photometric"


def mode(groups, reads, drops, **more):
    numbers = {"groups": groups, "reads": reads, "drops": drops}
    own = resolve(overrides={**{f"{MACC}.{key}": (value, "") for key, value in numbers.items()}, **more})
    return own, (groups - 1) * (reads + drops) * own.value("nisp.frame_time", "s")


@cache
def one():
    return infrared.rendered(
        [18.0, 21.0], [30.2, 70.7], [40.6, 20.1], truth=("cosmic_rays", "persistence", "saturation", "sky", "ramp")
    )


def test_the_file(tmp_path):
    """Signal and quality have a border of reference pixels, which are 0; the world coordinates include the border."""
    found = one()
    _, writers = fits_files.products(found, ("ramp", "sky"))
    (science,) = (path for path in writers if path.endswith("science.fits"))
    writers[science](tmp_path / "science.fits")
    read = images.read_images(tmp_path / "science.fits")
    assert [(unit.name, unit.data.shape, unit.data.dtype) for unit in read[1:]] == [
        ("DET22.SCI", (104, 104), np.uint16),
        ("DET22.CHI2", (104, 104), np.uint8),
    ]
    header, own = ({key: value for key, value, _ in unit.cards} for unit in read[:2])
    assert (header["READMODE"], header["NG"], header["NR"], header["ND"]) == ("MACC", 4, 16, 4)
    assert (header["FRTIME"], header["EXPTIME"]) == (pytest.approx(1.454), pytest.approx(87.24))
    assert header["ELAPTIME"] == pytest.approx(76 * 1.454)
    # Noise that the readout adds to the signal, and noise of one read.
    assert (header["RDNOISE"], header["FRNOISE"]) == (pytest.approx(7.0, abs=0.2), 13.0)
    assert header["RDNDRAWN"] == header["RDNOISE"]
    # The signal has the keywords of the readout; the quality has no noise.
    signal, quality = ({key: value for key, value, _ in unit.cards} for unit in read[1:])
    assert {key: signal[key] for key in ("GAIN", "RDNOISE", "SATURATE", "EXPTIME")} == {
        key: header[key] for key in ("GAIN", "RDNOISE", "SATURATE", "EXPTIME")
    }
    assert (signal["BUNIT"], signal["DATASEC"], signal["CCDSEC"]) == ("adu", "[5:100,5:100]", "[1:96,1:96]")
    assert quality["DATASEC"] == signal["DATASEC"]
    assert not {"BIASSEC", "RDNOISE"} & set(quality)
    assert own["CRPIX1"] == pytest.approx(header["CRPIX1"] + 4)
    signal, flag = (unit.data for unit in read[1:])
    border = np.ones(signal.shape, bool)
    border[4:-4, 4:-4] = False
    assert (signal[border] == 0).all()
    assert (flag[border] == 0).all()
    assert set(np.unique(flag)) == {0, 1}
    np.testing.assert_array_equal(read_back.frame(tmp_path / "science.fits").data, found.science)
    back = read_back.electrons(tmp_path / "science.fits").data
    assert np.median(back) == pytest.approx(infrared.SKY * 87.24, abs=5.0)
    assert ("QUALFLAG", 1) in {card[:2] for card in read[2].cards}
    groups, sky = (
        write(tmp_path / "map.fits") or images.read_images(tmp_path / "map.fits")[0]
        for content in ("ramp", "sky")
        for path, write in writers.items()
        if path.endswith(f"{content}.fits")
    )
    assert groups.data.shape == (4, 96, 96)
    # The groups have the keywords of the signal, but no border. The third axis counts groups.
    of_groups = {key: value for key, value, _ in groups.cards}
    for key in ("GAIN", "BIAS", "FRNOISE", "NG", "NR", "ND", "FRTIME", "ELAPTIME"):
        assert of_groups[key] == header[key]
    assert "REFPIX" not in of_groups
    assert {"GAIN", "NG", "CTYPE3"} & {key for key, *_ in sky.cards} == set()
    # A reader has to select two axes, because astropy supports distortions of two axes only.
    place = WCS(fits.Header(groups.cards), naxis=2)
    assert WCS(fits.Header([card for card in groups.cards if "_ORDER" not in card[0]])).naxis == 3
    sky_place = WCS(fits.Header(sky.cards))
    np.testing.assert_array_equal(place.all_pix2world([[5.0, 60.0]], 0), sky_place.all_pix2world([[5.0, 60.0]], 0))
    # The charge of a pixel grows above the level of its reset.
    assert (np.diff(np.median(found.maps["ramp"].astype(float), axis=(1, 2))) > 5.0).all()


@pytest.mark.parametrize(("kind", "noise"), [("photometric", 7.0), ("spectroscopic", 9.0)])
def test_the_signal_is_as_noisy_as_was_measured(kind, noise):
    """The signal in the dark has the measured noise, e- (Kubik et al. 2025, NISP detectors on ground)."""
    own, rng = resolve(), np.random.default_rng(1)
    shape = ramp.Mode(*(int(own.value(f"nisp.macc.{kind}.{part}")) for part in ("groups", "reads", "drops")))
    rate, read_noise = own.value("nisp.dark_current"), own.value("nisp.read_noise", "electron")
    dark = np.full((256, 1024), rate * shape.integration_frames * own.value("nisp.frame_time", "s"), np.float32)
    groups = ramp_noise.apply(ramp.apply(dark, shape, 1e8, rng=rng), read_noise, shape.reads, rng)
    groups = ramp_noise.apply_drift(groups, own.value(f"nisp.drift_{kind}", "electron"), rng)
    signal, _ = macc.apply(groups, shape, read_noise, rng)
    assert signal.std() == pytest.approx(noise, rel=0.03)


def test_detectors_are_no_worse_than_is_required():
    """Check the fraction of bad pixels, the persistence, and the passbands against quantum efficiency and cutoff."""
    own = resolve()
    assert own.value("nisp.dead_pixels") + own.value("nisp.hot_pixels") <= own.value("nisp.bad_pixels")
    for name in ("euclid_y", "euclid_j", "euclid_h"):
        band = passbands.load(name)
        assert band.response.max() < own.value("nisp.quantum_efficiency")
        assert band.wavelength[band.response > 0.01].max() < own.value("nisp.cutoff", "Angstrom")
    traps = PersistenceModel.from_scene(infrared.rendered().scene)
    left = traps.released_charge(np.array([0.0, 8e4]), traps.reference, traps.nominal_length)[1]
    assert 0.5 < left / 8e4 / own.value("nisp.persistence.fraction") < 1.0


def test_reference_pixels_may_have_a_level():
    own = resolve(overrides={"nisp.reference_level": (1000.0, "adu")})
    found = infrared.rendered(mission=own).readout.extensions[0].data
    assert set(np.unique(found[:4])) == {1000}


def test_a_pixel_is_sky_dark_and_noise():
    """The mean and the width of the signal, in electrons, agree with sky, dark current and noise."""
    detector = small("nisp", "DET22", 256)
    found = infrared.rendered(
        detector=detector, forced={"ramp_cosmic_rays": False, "dark_map": False, "pixel_response": False}
    )
    signal = infrared.electrons(found)
    # The estimator is low by half an electron, and rounding to ADU adds to the width.
    assert signal.mean() == pytest.approx(87.24, abs=1.0)
    # Photons in the last group have less weight, so the variance of the estimator is slightly above Poisson noise.
    assert signal.std() == pytest.approx(np.hypot(found.scene.pixel_noise, 1.92 * 12**-0.5), rel=0.08)
    assert found.scene.pixel_noise == pytest.approx(np.hypot(6.9, np.sqrt(87.24 + 1.75)), rel=0.01)


def test_stars_are_as_bright_as_the_catalogue_says():
    """Without noise in the ramp, signals above dark pixels agree with the drawn light within 0.01 mag."""
    mags, x, y = [17.0, 17.5, 18.0, 18.5], [24.3, 72.1, 23.8, 71.6], [24.9, 25.2, 71.4, 72.2]
    drawn = infrared.rendered(mags, x, y, forced={**QUIET, "ramp_nonlinearity": False}, sky=0.0)
    # The estimator assumes the noise of reads. Without it, the signal of all faint pixels is low by an electron.
    signal = infrared.electrons(drawn)
    signal -= np.median(signal)
    for column, row in zip(x, y, strict=True):
        box = np.s_[int(row) - 10 : int(row) + 11, int(column) - 10 : int(column) + 11]
        light = float(drawn.noise_free[box].sum())
        assert signal[box].sum() / light == pytest.approx(1.0, abs=0.009 + 4 * light**-0.5)


def test_charge_stays_through_inter_pixel_capacitance():
    """With capacitance, the signal of a star has the same sum and a lower peak."""
    forced = {**QUIET, "ramp_nonlinearity": False}
    bright = [
        infrared.electrons(infrared.rendered([18.0], [48.0], [48.0], forced={**forced, "ipc": on}, sky=0.0))
        for on in (False, True)
    ]
    assert bright[1].sum() == pytest.approx(bright[0].sum(), rel=2e-3)
    assert bright[1].max() == pytest.approx(bright[0].max() * (1 - 4 * 0.0069), rel=0.02)


def test_dark():
    """The number of drops between groups follows from the exposure time of 600 s."""
    found = infrared.rendered(kind="dark", seconds=600.0, sky=0.0, forced={"ramp_cosmic_rays": False})
    header = dict((key, value) for key, value, _ in found.readout.cards)
    assert (header["NG"], header["NR"], header["ND"]) == (4, 16, 122)
    assert header["FRTIME"] == pytest.approx(1.454, rel=0.01)
    assert np.median(infrared.electrons(found)) == pytest.approx(0.02 * 600.0, abs=2.0)


def test_flats():
    """A flat is bright if the band contains the wavelength of the LED."""
    for lamp, band, bright in ((2, "euclid_y", True), (5, "euclid_h", True), (1, "euclid_h", False)):
        found = infrared.rendered(kind="flat", lamp=lamp, band=band, sky=0.0)
        assert (np.median(infrared.electrons(found)) > 1e4) == bright


def test_both_orders_of_non_linearity():
    """The ramp loses more than the signal, because its charge counts over 76 frames instead of 60."""
    light, found = 100.0 * 1.3, {}
    linear = infrared.electrons(infrared.rendered(sky=light, forced={**QUIET, "ramp_nonlinearity": False})).mean()
    for choice in (0.0, 1.0):
        own = resolve(overrides={"nisp.nonlinearity_of_signal": (choice, "")})
        dim = infrared.rendered(sky=light, mission=own, forced=QUIET)
        assert {d.name for d in dim.decisions if d.applied and "nonlinearity" in d.name} == {
            ("ramp_nonlinearity", "signal_nonlinearity")[int(choice)]
        }
        found[choice] = 1.0 - infrared.electrons(dim).mean() / linear
    assert found[1.0] == pytest.approx(6e-7 * linear, rel=0.05)
    assert found[0.0] / found[1.0] == pytest.approx(0.68 / 0.52, rel=0.05)


@pytest.mark.parametrize("numbers", [(2, 1, 0), (15, 16, 11), (100, 1, 0)], ids=str)
def test_any_ramp(numbers):
    own, seconds = mode(*numbers)
    found = infrared.rendered([20.0], [48.0], [48.0], mission=own, seconds=seconds, truth=("cosmic_rays",))
    names = [extension.name for extension in found.readout.extensions]
    assert names == ["DET22.SCI"] + ["DET22.CHI2"] * (numbers[0] > 2)
    # Two groups give no quality, as the header states.
    cards = {key: (value, text) for key, value, text in found.readout.cards}
    assert ("no quality" in cards["QUALLIM"][1]) == (numbers[0] == 2)
    # Few good pixels are flagged, whatever the number of groups is.
    hits = found.maps["cosmic_rays"] > 0
    if numbers[0] > 2:
        assert found.readout.extensions[1].data[4:-4, 4:-4][~hits].mean() < 0.02
    assert np.median(infrared.electrons(found)) == pytest.approx(seconds * 1.02, abs=6.0 + 0.03 * seconds)


def test_without_read_noise():
    silent = {key: (0.0, "electron") for key in ("nisp.read_noise", "nisp.drift_photometric")}
    found = infrared.rendered([20.0], [48.0], [48.0], mission=resolve(overrides=silent))
    assert np.median(infrared.electrons(found)) == pytest.approx(87.24, abs=4.0)


def test_all_pixels_full():
    found = infrared.rendered(sky=1e5, truth=("saturation",))
    assert (found.maps["saturation"] == 1).all()
    # A constant ramp has no signal, and nothing shows that its pixel is full.
    assert abs(np.median(infrared.electrons(found))) < 2.0
    assert found.readout.extensions[1].data[4:-4, 4:-4].mean() < 0.02


def test_a_pixel_that_sees_nothing():
    blind = resolve(overrides={"nisp.dead_pixels": (0.0, ""), "nisp.prnu": (0.0, ""), "nisp.dark_columns": (40.0, "")})
    found = infrared.rendered(sky=50.0, mission=blind, forced={"ramp_cosmic_rays": False, "dark_map": False})
    signal = infrared.electrons(found)
    # Dark columns detect no light from some row on, except what capacitance couples from their neighbours.
    dark = signal < 0.1 * 50.0 * 87.24
    assert 0.02 < dark.mean() < 0.5
    assert np.median(signal[~dark]) == pytest.approx(50.0 * 87.24, rel=0.02)


def test_an_exposure_that_is_too_short_is_refused():
    wanted = r"exposure time 20 s: MACC\(4,16,4\) takes 69.79 s without any drops"
    with pytest.raises(BadInput, match=wanted):
        infrared.rendered(seconds=20.0)


def test_nothing_shines():
    found = infrared.rendered(sky=0.0)
    assert len(found.sources) == 0
    assert (found.noise_free == 0.0).all()


def test_cosmic_rays_are_flagged():
    """There are 2.6 hits per second and cm2, as in the mission. The ramps of most hit pixels do not fit."""
    found = infrared.rendered(detector=small("nisp", "DET22", 512), truth=("cosmic_rays",))
    hits, flag = found.maps["cosmic_rays"], found.readout.extensions[1].data[4:-4, 4:-4]
    expected = 2.6 * (512 * 18e-4) ** 2 * 110.5
    assert expected < (hits > 0).sum() < 3.0 * expected
    assert flag[hits > 1000].mean() > 0.9
    assert flag[hits == 0].mean() < 0.02
