"""Make FITS cards with the parameters of calibration exposures, such as injected charge, defocus or the calibrator."""

from __future__ import annotations

from lake_schema.fits.images import Card
from lake_schema.tables.exposures import ExposureRow
from truesky.render.effects.scene import Scene
from truesky.render.exposure import standard_stars

# Image types in which the electronics inject charge into the detector.
_INJECTED = ("charge_injection", "trap_pumping")


def cards(exposure: ExposureRow, scene: Scene) -> tuple[Card, ...]:
    """Return the cards with the parameters of a calibration exposure, or () for image types without parameters.

    The number of the lamp and the name of the calibrator have cards elsewhere (`headers`).
    """
    kind = exposure.image_type
    type_cards: tuple[Card, ...] = ()
    if kind in _INJECTED:
        type_cards += (
            ("INJLEVEL", scene.value("injection.level", "electron"), "[electron] injected charge per pixel"),
            ("INJON", int(scene.value("injection.on", "pix")), "[pix] injected rows per block"),
            ("INJOFF", int(scene.value("injection.off", "pix")), "[pix] rows not injected before each block"),
        )
    if kind == "trap_pumping":
        type_cards += (
            ("NSHUFFLE", int(scene.value("pumping.shuffles", "")), "number of trap-pumping cycles"),
            ("PHASETIM", scene.value("pumping.phase_time", "s"), "[s] time under an electrode in each cycle"),
        )
    if kind == "defocus":
        type_cards += (("DEFOCUS", scene.value("psf.defocus", "nm"), "[nm] rms defocus, Noll's fourth Zernike term"),)
    if exposure.target:
        magnitude, band = standard_stars.brightness(exposure, scene.mission)
        type_cards += (
            ("TARGMAG", magnitude, "[mag] AB magnitude of the calibration source"),
            ("TARGBAND", band, "band of TARGMAG"),
        )
    if kind == "stray_light":
        angle = scene.mission.value("survey.stray_light.distance", "deg")
        type_cards += (("TARGDIST", angle, "[deg] offset of the source from boresight in y"),)
    return type_cards
