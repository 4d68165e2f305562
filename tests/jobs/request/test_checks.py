"""What nothing renders is refused by the check and by the first job; it may be planned."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from jobs.catalogue import build_galaxies, build_stars
from jobs.render.channels import registry
from jobs.request import __main__, checks, observations
from jobs.request.from_toml import parse
from lake_schema.errors import BadInput
from lake_schema.tables.exposures import RENDERED

REQUESTS = Path(__file__).resolve().parents[3] / "requests"
# Euclid's three channels, and calibrations of NISP.
SURVEY = REQUESTS / "sc8_pilot.toml"


def test_what_is_said_to_be_rendered_has_effects():
    assert {name: set(kinds) for name, kinds in RENDERED.items()} == {
        name: set(channel.effects) for name, channel in registry.CHANNELS.items()
    }


@pytest.mark.parametrize("channel", observations.CHANNELS)
def test_what_is_rendered_can_be_asked_for(channel):
    asked = {*observations._SKY_TYPES, *observations._CALIBRATIONS[channel]}
    assert set(RENDERED.get(channel, ())) <= asked <= set(observations.IMAGE_TYPES)


@pytest.mark.parametrize("path", sorted(REQUESTS.glob("*.toml")), ids=lambda path: path.stem)
def test_the_check_refuses_what_can_only_be_planned(path, capsys):
    only_planned = path.stem.startswith("sc8")
    assert __main__.main(["check", str(path)]) == (2 if only_planned else 0)
    said = capsys.readouterr()
    if only_planned:
        wanted = r"request: observation\[\d\].channels: no simulator renders NISP-P \w+ yet: it can be planned alone\n"
        assert re.fullmatch(wanted, said.err)
    assert __main__.main(["check", str(path), "--plan"]) == 0
    assert capsys.readouterr().out.startswith(f"{path.stem}: good: ")


@pytest.mark.parametrize("job", [build_galaxies, build_stars])
def test_the_first_job_refuses_it_too(job, tmp_path):
    with pytest.raises(BadInput, match=r"^observation\[\d\]\.channels: no simulator renders NISP-P science yet"):
        job.steps(tmp_path, parse(SURVEY))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("channels", "kind"), [(("EXT",), "dark"), (("VIS", "NISP-S"), "flat")])
def test_an_image_type_that_nothing_renders_is_refused(channels, kind):
    request = parse(SURVEY)
    block = replace(request.observations[0], channels=channels, image_type=kind)
    wanted = f"^observation\\[0\\].channels: no simulator renders {channels[-1]} {kind} yet: it can be planned alone$"
    with pytest.raises(BadInput, match=wanted):
        checks.check_rendered(replace(request, observations=(block,)))


@pytest.mark.parametrize("words", [[], ["check"], ["check", "a", "--plans"], ["check", "a", "b"], ["a", "b", "--plan"]])
def test_other_words_show_the_usage(words, capsys):
    assert __main__.main(words) == 2
    assert capsys.readouterr().err == "usage: python -m jobs.request check FILE [--plan]\n"
