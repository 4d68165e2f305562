"""What headers of calibration frames tell of how they were taken.

cards   of an image type: the parameters that tell its exposures from one another
"""

from __future__ import annotations

from lake_schema.fits.images import Card
from lake_schema.tables.exposures import ExposureRow
from truesky.render.effects.scene import Scene
from truesky.render.exposure import standard_stars

_INJECTED = ("charge_injection", "trap_pumping")


def cards(exposure: ExposureRow, scene: Scene) -> tuple[Card, ...]:
    """Cards of an exposure besides its lamp and its target, () where its type has no parameters; scene : of it."""
    kind = exposure.image_type
    type_cards: tuple[Card, ...] = ()
    if kind in _INJECTED:
        type_cards += (
            ("INJLEVEL", scene.value("injection.level", "electron"), "[electron] injected into a pixel"),
            ("INJON", int(scene.value("injection.on", "pix")), "[pix] rows of a block that is injected"),
            ("INJOFF", int(scene.value("injection.off", "pix")), "[pix] rows before each block"),
        )
    if kind == "trap_pumping":
        type_cards += (
            ("NSHUFFLE", int(scene.value("pumping.shuffles", "")), "cycles of trap pumping"),
            ("PHASETIM", scene.value("pumping.phase_time", "s"), "[s] under an electrode in a cycle"),
        )
    if kind == "defocus":
        type_cards += (("DEFOCUS", scene.value("psf.defocus", "nm"), "[nm] rms of the defocus, Noll's fourth term"),)
    if exposure.target:
        magnitude, band = standard_stars.brightness(exposure, scene.mission)
        type_cards += (
            ("TARGMAG", magnitude, "[mag] AB, of the calibration source"),
            ("TARGBAND", band, "band of TARGMAG"),
        )
    if kind == "stray_light":
        angle = scene.mission.value("survey.stray_light.distance", "deg")
        type_cards += (("TARGDIST", angle, "[deg] of the source from the boresight, along y"),)
    return type_cards
