"""Define an aim: a detector of an exposure, with its world coordinate system, passband and detector effects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lake_schema import units
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import astrometry, filter_wheel
from truesky.render.camera.detectors import Detector
from truesky.render.camera.windows import Window
from truesky.render.channels import image_types, registry
from truesky.render.channels.channel import Channel
from truesky.render.effects.effect import Effect

if TYPE_CHECKING:
    from astropy.wcs import WCS


@dataclass(frozen=True, slots=True)
class Aim:
    """Detector of an exposure, with everything that defines its view of the sky.

    Attributes
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        The detector.
    wcs : astropy.wcs.WCS
        World coordinate system of the detector's pixels.
    band : Passband
        Passband of the exposure.
    channel : Channel
        Channel (instrument mode) of the exposure.
    effects : tuple of Effect
        Detector effects that the channel defines for the image type, in the order in which they are applied.
    window : Window, optional
        Part of the detector that is drawn; None for the whole detector.
    """

    exposure: ExposureRow
    detector: Detector
    wcs: WCS
    band: Passband
    channel: Channel
    effects: tuple[Effect, ...]
    window: Window | None = None

    @classmethod
    def from_exposure(
        cls,
        exposure: ExposureRow,
        detector: Detector,
        band: Passband | None = None,
        seed: int = 0,
        readout_name: str = "raw",
    ) -> Aim:
        """Collect everything that defines the view of a detector in a planned exposure.

        Parameters
        ----------
        exposure : ExposureRow
            Row of the table `exposures`.
        detector : Detector
            Detector of the camera of the exposure.
        band : Passband, optional
            Passband; None means the passband of truesky under the name in `exposure`.
        seed : int
            Seed of the request, used for the random tilt of the filter.
        readout_name : str
            Format of the image files, such as "raw"; see `Channel.with_readout`.

        Returns
        -------
        Aim
            The detector with its world coordinate system, passband, channel and detector effects in this exposure.

        Notes
        -----
        `registry.find_channel` raises BadInput if truesky cannot render the image type of the exposure.
        """
        kind = exposure.image_type
        channel = registry.find_channel(exposure.channel, kind, f"exposure {exposure.exposure_id}").with_readout(
            readout_name
        )
        # The tilt of the filter is drawn from the identity of the exposure without the number of its repetition, so
        # that repetitions have the same tilt. Exposures through a grism use no filter.
        identity = image_types.identity(replace(exposure, realisation=None))
        tilted_detector = (
            filter_wheel.apply_random_tilt(detector, identity, seed) if channel.dispersion is None else detector
        )
        system = astrometry.wcs(tilted_detector, exposure.ra, exposure.dec, exposure.position_angle)
        band = band or passbands.load(exposure.band)
        return cls(exposure, detector, system, band, channel, channel.effects[kind])

    @property
    def sees_sky(self) -> bool:
        """True if light of astronomical sources reaches the detector; False for example for a dark."""
        return self.channel.sees_sky(self.exposure.image_type)

    @property
    def drawn(self) -> Window:
        """Pixels of the detector that are drawn: the window, or all pixels."""
        return self.window or Window(0, 0, self.detector.nx, self.detector.ny)

    @property
    def centre(self) -> tuple[float, float]:
        """Right ascension and declination of the middle of the drawn pixels, deg."""
        column, row = self.drawn.middle
        ra, dec = astrometry.sky_of_pixel(self.wcs, [column], [row])
        return float(ra[0]), float(dec[0])

    @property
    def half_diagonal(self) -> float:
        """Distance from the middle of the drawn pixels to their corners, arcsec."""
        return 0.5 * self.detector.pixel_scale * float(np.hypot(self.drawn.nx, self.drawn.ny))

    @property
    def electrons_per_microjansky(self) -> float:
        """Expected number of electrons during the exposure from a source with a flux density of one microjansky."""
        return electron_rate(self.exposure) * self.exposure.exposure_time_s


def electron_rate(exposure: ExposureRow) -> float:
    """Return the electrons per second from a source with a flux density of one microjansky.

    They follow from the zero point in the row of the exposure: the AB magnitude that gives one electron per second.
    """
    return float(10.0 ** (0.4 * (exposure.zero_point - units.AB_UJY)))
