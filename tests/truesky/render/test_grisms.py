"""Configuration files of grisms: grismconf reads them, and they have the units of the rendered spectra."""

import grismconf
import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields, spectroscopic
from tests.truesky.render.channels import spectral_lines
from tests.truesky.render.channels.spectral_lines import Lines
from tests.truesky.render.spectroscopic import TIME, strip
from truesky.commands import __main__ as truesky
from truesky.render import grisms
from truesky.render.camera.detectors import detector
from truesky.render.channels import registry

MISSION = resolve()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("grisms") / "new"
    words = ["export", "grisms", "--out", str(path), "--detectors", "DET22", "DET31"]
    assert truesky.main(words) == 0
    return path


def test_every_grism_has_a_configuration_with_its_traces_and_sensitivities(folder):
    found = sorted(path.stem for path in folder.glob("*.conf"))
    assert found == [f"{grism}_{name}" for grism in ("BGS000", "RGS000", "RGS180") for name in ("DET22", "DET31")]
    for name in ("RGS180_DET31", "BGS000_DET22"):
        read, seen = grismconf.Config(str(folder / f"{name}.conf")), detector("nisp", name[-5:], MISSION)
        aim = grisms.nominal_aim(name[:6], name[-5:], MISSION)
        still = MISSION.with_overrides({"nisp.grism_wheel_error": (0.0, "deg")})
        traces = registry.CHANNELS["NISP-S"].dispersion.traces(aim.exposure, seen, still, 0)
        for trace in traces:
            order, t = f"{trace.order:+d}" if trace.order else "0", np.linspace(0.0, 1.0, 5)
            x, y = trace.offsets(300.0, 1700.0, read.DISPL(order, 300.0, 1700.0, t))
            np.testing.assert_allclose(read.DISPX(order, 300.0, 1700.0, t), x, rtol=0.0, atol=1e-6)
            np.testing.assert_allclose(read.DISPY(order, 300.0, 1700.0, t), y, rtol=0.0, atol=1e-6)


def test_electrons_of_a_line_are_flux_times_sensitivity(folder):
    """Two galaxies on a strip without overlap of their other orders; background light is subtracted.

    The lines are so bright that the continuum hardly matters: a stamp without lines contains 2 % less of it.
    """
    lines = Lines(np.array([14000.0, 16500.0]), np.array([3e-14, 2e-14]), np.array([0.1, 0.1]))
    path = spectral_lines.trace(strip(), "RGS000", 0.0)
    for i in range(2):
        one = Lines(*(part[i : i + 1] for part in (lines.wavelength, lines.flux, lines.radius)))
        places = spectral_lines.undispersed(path, one.wavelength, np.array([[320.0], [48.0]]))
        shining, dark = (spectral_lines.exposure(one, places, strip(), on).noise_free for on in (True, False))
        counts = float(shining.sum(dtype=float) - dark.sum(dtype=float))
        read = grismconf.Config(str(folder / "RGS000_DET22.conf"))
        wanted = one.flux[0] * float(read.SENS["+1"](one.wavelength[0])) * TIME
        assert counts == pytest.approx(wanted, rel=0.01)


def test_sensitivity_agrees_with_the_zero_point():
    """A source with constant f_nu, summed over wavelength, agrees with the zero point of the exposure."""
    aim = grisms.nominal_aim("RGS000", "DET22", MISSION)
    order = next(one for one in grisms.orders(aim, MISSION, 0) if one.trace.order == 1)
    f_nu = 10.0 ** (-0.4 * (aim.exposure.zero_point + 48.6))
    assert (f_nu * 2.99792458e18 / order.wavelength**2 * order.response).sum() == pytest.approx(1.0, rel=1e-6)
    brighter = grisms.Aim.from_exposure(
        fields.exposure(**{**spectroscopic.exposed(strip()), "zero_point": aim.exposure.zero_point + 1.0}), strip()
    )
    twice = next(one for one in grisms.orders(brighter, MISSION, 0) if one.trace.order == 1)
    np.testing.assert_allclose(twice.response, order.response * 10.0**0.4, rtol=1e-12)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--detectors", "DET99"], "DET99"),
        (["--exposure", "3"], "LAKE and --exposure must be given together, or neither for the nominal grisms"),
        (["nowhere"], "LAKE and --exposure must be given together"),
        (["--bands", "nisp_red"], "--bands and --columns are options of depth only"),
        (["--form", "axe"], "--form axe: grisms can be written as grismconf"),
        (["--name", "a"], "--name requires LAKE"),
    ],
)
def test_errors_are_one_line_and_no_file_is_written(tmp_path, capsys, more, message):
    assert truesky.main(["export", "grisms", *more, "--out", str(tmp_path / "new")]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "new").exists()
