"""Print docs/assumed_numbers.md, the assumed numbers of ground cameras by their effect on images.

    python -m scripts.assumed_tables > docs/assumed_numbers.md

The numbers are read from the mission database, and their effects from docs/assumed_numbers.csv, which
scripts/rank_assumed_numbers.py has measured.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from lake_schema.mission.configuration import MissionConfiguration, resolve
from scripts.rank_assumed_numbers import read_ranking

# Settings that choose a model or a plan of calibrations. No measurement could replace them.
_CHOICES = (
    "exposure_time_flat", "flat.signal", "header.offset", "header.rotation", "psf.profile", "psf.refraction",
    "psf.wavefront_scale", "sky_model",
)  # fmt: skip
_HEAD = """# Assumed numbers of ground cameras

Written by `python -m scripts.assumed_tables > docs/assumed_numbers.md`; do not edit.

The mission database says for each number whether it is published, quoted, derived from published numbers or assumed.
`truesky mission list "ext.*"` prints all of them with their sources. This page lists the assumed numbers of the ground
cameras, sorted by their effect on an image.

The effect is measured. A field of stars is drawn on 256 x 256 pixels in the middle of the camera, once with the numbers
of the database, and once with one number changed by a plausible error. The random numbers are the same. Cosmic rays,
defects and dust are measured on 1024 x 1024 pixels.

- **noise**: rms change of a pixel, divided by the noise of a pixel of the sky. A pixel counts with at most ten times
  its noise. The overscan of each amplifier is subtracted first.
- **level**: mean change of a pixel, divided by the same noise.
- **flux**: change of a star of 18 mag in an aperture of 3 arcsec, in mmag.

The edges of the small square are edges of the detector, so that numbers of edges have a larger effect here than on a
whole detector. Zero means that the number does not act by default, such as the exponent of a Moffat profile if the PSF
has another one, that the overscan removes its effect, or that the field has no such feature. Crosstalk between
detectors, and errors of the pointing, are not measured: these numbers come last.
"""
_CHOICE_TEXT = """These numbers are settings: they choose a model, or plan calibrations. No measurement could replace
them. The table shows how much the other setting changes an image.
"""


def text() -> str:
    """Return the text of docs/assumed_numbers.md."""
    ranking = sorted(read_ranking(), key=_order)
    choices = [row for row in ranking if _is_choice(row)]
    numbers = [row for row in ranking if not _is_choice(row)]
    lines = [*_HEAD.splitlines(), "", "## How many", "", *_counts(resolve())]
    lines += ["", "## Numbers", "", *_table(numbers), "", "## Settings", "", *_CHOICE_TEXT.splitlines(), ""]
    return "\n".join([*lines, *_table(choices)]) + "\n"


def _order(row: Mapping[str, str]) -> tuple[bool, float, str]:
    return not row["image"], -float(row["noise"] or 0.0), row["parameter"]


def _is_choice(row: Mapping[str, str]) -> bool:
    return row["parameter"].endswith(_CHOICES)


def _counts(mission: MissionConfiguration) -> Iterator[str]:
    """Yield the lines of a table with the number of parameters per camera and confidence."""
    used = Counter((p.key.split(".")[1], p.confidence) for p in mission.parameters if p.key.startswith("ext."))
    confidences = ("published", "quoted", "derived", "assumed")
    yield f"| camera | {' | '.join(confidences)} |"
    yield "|---" * (len(confidences) + 1) + "|"
    for camera in sorted({camera for camera, _ in used}):
        yield f"| {camera} | {' | '.join(str(used[camera, confidence]) for confidence in confidences)} |"


def _table(ranking: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """Yield the lines of a table with the assumed numbers and their effects."""
    yield "| number | value | changed to | unit | image | noise | level | flux |"
    yield "|---" * 8 + "|"
    for row in ranking:
        name, *entries = row.values()
        yield f"| `{name}` | {' | '.join(entries)} |"


if __name__ == "__main__":
    print(text(), end="")
