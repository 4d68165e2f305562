"""The one knob: how wrong a user allows a product to be.  What it buys in speed is looked up, never chosen by name."""

from __future__ import annotations

from dataclasses import dataclass, fields

from lake_schema.errors import BadInput, OutOfRange


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Largest errors that are allowed.

    flux       : fraction of a source's flux
    shape      : of a reduced-shear component
    position   : pixels
    background : of a pixel's noise
    """

    flux: float
    shape: float
    position: float
    background: float

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not 1e-12 <= value <= 1.0:
                raise OutOfRange(f"accuracy.{item.name}", value, 1e-12, 1.0)


DRAFT = Accuracy(flux=5e-3, shape=1e-3, position=1e-3, background=0.1)
SURVEY = Accuracy(flux=1e-3, shape=1e-4, position=1e-4, background=0.02)
REFERENCE = Accuracy(flux=1e-4, shape=1e-5, position=1e-5, background=0.002)


def preset(name: str) -> Accuracy:
    """The accuracy that a preset's name stands for."""
    presets = {"draft": DRAFT, "survey": SURVEY, "reference": REFERENCE}
    if name not in presets:
        raise BadInput(f"accuracy = {name!r} is not one of {', '.join(presets)}")
    return presets[name]
