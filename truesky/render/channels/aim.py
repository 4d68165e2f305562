"""A detector of an exposure, as it looks at the sky."""

from __future__ import annotations

from dataclasses import dataclass, replace

from astropy.wcs import WCS

from lake_schema import units
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import astrometry, filter_wheel
from truesky.render.camera.detectors import Detector
from truesky.render.channels import image_types, registry
from truesky.render.channels.channel import Channel
from truesky.render.effects.effect import Effect


@dataclass(frozen=True, slots=True)
class Aim:
    """What looks where, through what.

    exposure : a row of the table `exposures`
    band     : its passband
    effects  : of its channel for its image type, in their order
    """

    exposure: ExposureRow
    detector: Detector
    wcs: WCS
    band: Passband
    channel: Channel
    effects: tuple[Effect, ...]

    @classmethod
    def from_exposure(
        cls,
        exposure: ExposureRow,
        detector: Detector,
        band: Passband | None = None,
        seed: int = 0,
        readout_name: str = "raw",
    ) -> Aim:
        """Of a planned exposure; BadInput where nothing renders it.

        exposure : its row;  detector : of its camera
        band     : None = the embedded one of its name;  seed : of the request
        way      : in which its files are wanted (Channel.read_as)
        """
        kind = exposure.image_type
        channel = registry.find_channel(exposure.channel, kind, f"exposure {exposure.exposure_id}").with_readout(
            readout_name
        )
        # Exposures that differ in their noise alone see alike; no filter is in front of a grism.
        identity = image_types.identity(replace(exposure, realisation=None))
        tilted_detector = (
            filter_wheel.apply_random_tilt(detector, identity, seed) if channel.dispersion is None else detector
        )
        system = astrometry.wcs(tilted_detector, exposure.ra, exposure.dec, exposure.position_angle)
        band = band or passbands.load(exposure.band)
        return cls(exposure, detector, system, band, channel, channel.effects[kind])

    @property
    def sees_sky(self) -> bool:
        """Whether sources shine on the detector."""
        return self.channel.sees_sky(self.exposure.image_type)

    @property
    def electrons_per_microjansky(self) -> float:
        """Expected of a source of one microjansky in the exposure."""
        return electron_rate(self.exposure) * self.exposure.exposure_time_s


def electron_rate(exposure: ExposureRow) -> float:
    """Electrons a second of a source of one microjansky."""
    return float(10.0 ** (0.4 * (exposure.zero_point - units.AB_UJY)))
