"""Join eight figures of an HTML report of `truesky validate` in one picture, for docs/pilot.md.

    python -m scripts.report_pictures REPORT [FILE]

REPORT is the HTML file. The figures show VIS images, NISP-P images and galaxies. FILE is the JPEG to write, by default
docs/pilot_validation.jpg.
"""

from __future__ import annotations

import base64
import io
import re
import sys
from collections.abc import Sequence
from html import unescape
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
# Beginnings of the captions of the figures, in the order of the picture, which has two figures per row.
CAPTIONS = (
    "VIS: positions", "VIS: magnitudes", "VIS: noise", "VIS: sources that are found",
    "NISP-P: positions", "NISP-P: magnitudes", "galaxies: counts", "galaxies: how they cluster",
)  # fmt: skip
# Width of a figure in the picture, pixels.
_WIDE = 760
# Gap between two rows of figures, pixels.
_GAP = 14
_FIGURE = re.compile(r"<img alt='[^']*' src='data:image/png;base64,([^']+)'><figcaption>(.*?)</figcaption>", re.DOTALL)


def figures(report: str) -> dict[str, Image.Image]:
    """Return the figures that are embedded as PNG in the HTML text of a report, as RGB images by caption."""
    matches = _FIGURE.findall(report)
    return {unescape(text): Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB") for data, text in matches}


def side_by_side(pictures: Sequence[Image.Image]) -> Image.Image:
    """Return one image with the figures in rows of two, each scaled to a width of 760 pixels."""
    scaled = [
        picture.resize((_WIDE, round(picture.height * _WIDE / picture.width)), Image.Resampling.LANCZOS)
        for picture in pictures
    ]
    rows = [scaled[i : i + 2] for i in range(0, len(scaled), 2)]
    heights = [max(picture.height for picture in row) + _GAP for row in rows]
    out, top = Image.new("RGB", (2 * _WIDE, sum(heights)), "white"), 0
    for row, height in zip(rows, heights, strict=True):
        for i, picture in enumerate(row):
            out.paste(picture, (i * _WIDE, top + (height - picture.height) // 2))
        top += height
    return out


def main(argv: Sequence[str]) -> int:
    """Run the command with the arguments REPORT [FILE], and return its exit status.

    The status is 0 on success, and 2 if REPORT is not a file or lacks one of the figures.
    """
    if not argv or not Path(argv[0]).is_file():
        print(f"{' '.join(argv) or 'report_pictures'}: not a report of truesky validate", file=sys.stderr)
        return 2
    report_figures = figures(Path(argv[0]).read_text(encoding="utf-8"))
    chosen = [
        next((report_figures[text] for text in report_figures if text.startswith(name)), None) for name in CAPTIONS
    ]
    pictures = [picture for picture in chosen if picture is not None]
    if len(pictures) < len(CAPTIONS):
        lacking = ", ".join(name for name, picture in zip(CAPTIONS, chosen, strict=True) if picture is None)
        print(f"{argv[0]}: the report has no figure {lacking}", file=sys.stderr)
        return 2
    target = Path(argv[1]) if len(argv) > 1 else ROOT / "docs" / "pilot_validation.jpg"
    side_by_side(pictures).save(target, quality=82, optimize=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
