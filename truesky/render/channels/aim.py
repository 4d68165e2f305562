"""A detector of an exposure with its world coordinate system, passband, channel and effects."""

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
    """Detector of an exposure, with everything that defines its view of the sky.

    Attributes
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        The detector.
    wcs : WCS
        World coordinate system of the detector.
    band : Passband
        Passband of the exposure.
    channel : Channel
        Channel of the exposure.
    effects : tuple of Effect
        Effects of the channel for the image type, in order.
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
        """Build the aim of a detector for a planned exposure.

        Parameters
        ----------
        exposure : ExposureRow
            Row of the table `exposures`.
        detector : Detector
            Detector of its camera.
        band : Passband, optional
            Passband; by default the embedded one with the name in the row.
        seed : int
            Seed of the request.
        readout_name : str
            Requested format of the files, see `Channel.with_readout`.

        Returns
        -------
        Aim
            The aim.

        Notes
        -----
        `registry.find_channel` raises BadInput if no channel renders the exposure.
        """
        kind = exposure.image_type
        channel = registry.find_channel(exposure.channel, kind, f"exposure {exposure.exposure_id}").with_readout(
            readout_name
        )
        # Exposures that differ only in their noise have the same tilt. A grism is used without a filter.
        identity = image_types.identity(replace(exposure, realisation=None))
        tilted_detector = (
            filter_wheel.apply_random_tilt(detector, identity, seed) if channel.dispersion is None else detector
        )
        system = astrometry.wcs(tilted_detector, exposure.ra, exposure.dec, exposure.position_angle)
        band = band or passbands.load(exposure.band)
        return cls(exposure, detector, system, band, channel, channel.effects[kind])

    @property
    def sees_sky(self) -> bool:
        """True if light of astronomical sources reaches the detector."""
        return self.channel.sees_sky(self.exposure.image_type)

    @property
    def electrons_per_microjansky(self) -> float:
        """Expected electrons in the exposure from a source of one microjansky."""
        return electron_rate(self.exposure) * self.exposure.exposure_time_s


def electron_rate(exposure: ExposureRow) -> float:
    """Electrons per second from a source of one microjansky."""
    return float(10.0 ** (0.4 * (exposure.zero_point - units.AB_UJY)))
