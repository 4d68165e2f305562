"""Draw a window (a rectangle of a detector's pixels) without the rest of the detector, with its noise if requested."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import BadInput
from truesky.randomness import rng
from truesky.render.camera.windows import DetectorPart, Window
from truesky.render.channels import readout
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamps, wings
from truesky.render.drawing.stamps import Tally
from truesky.render.effects.effect import Decision, Effect, apply_all
from truesky.render.effects.readout import adc
from truesky.render.effects.scene import Lights, Scene
from truesky.render.exposure import limits, rendered_detector, scene_factory
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.visible_sources import Light, visible_light
from truesky.render.products import truth_table
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources

# Effects that change each pixel alone, or together with its neighbours. All others depend on the place of a pixel on
# the detector, such as charge transfer, or on light and charge outside the window, such as ghosts and crosstalk.
LOCAL_EFFECTS = frozenset({
    "adc", "background", "brighter_fatter", "cosmic_rays", "dark_current", "dark_map",
    "group_noise", "hot_pixels", "ipc", "macc", "nonlinearity", "pixel_response", "poisson", "ramp", "ramp_cosmic_rays",
    "ramp_nonlinearity", "read_noise", "reset_level", "signal_adc", "signal_nonlinearity",
})  # fmt: skip
# Effects that divide a detector into the pixels of its amplifiers. A window is read by one amplifier.
_SPLITTING = frozenset({"quadrants", "amplifiers"})


@dataclass(frozen=True, slots=True)
class WindowImage:
    """Simulated image of a window.

    Attributes
    ----------
    aim : Aim
        Exposure and detector, with the window.
    electrons : float64 array, shape (ny, nx)
        Expected electrons of the sources, without sky and noise; 0 in rows that the detector does not read.
    raw : int array, shape (ny, nx), or None
        Pixels with sky and noise, ADU; None without noise.
    scene : Scene
        Properties of the exposure on which effects depend.
    psf : Psf
        PSF of the detector, for positions that count from the first pixel of the window.
    sources : Sources
        The drawn sources, whose positions count from the first pixel of the window.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    drawn_electrons : float64 array, shape (n,)
        Electrons of each source's stamp on the window.
    decisions : tuple of Decision
        For each detector effect, whether it was applied.
    """

    aim: Aim
    electrons: Float
    raw: Array | None
    scene: Scene
    psf: Psf
    sources: Sources
    sizes: Int
    drawn_electrons: Float
    decisions: tuple[Decision, ...]


def draw_window(
    aim: Aim,
    rows: Rows,
    variant: Variant,
    seed: int,
    noise_seed: int | None = None,
    effects: Collection[str] | None = None,
    with_noise: bool = True,
    psf: Psf | None = None,
) -> WindowImage:
    """Draw a window of a direct image.

    Parameters
    ----------
    aim : Aim
        Exposure and detector, with the window that is drawn.
    rows : Rows
        Catalogue rows that may have light on the window.
    variant : Variant
        Mission database, accuracy, and the effects that the request switches on or off.
    seed : int
        Seed of the request.
    noise_seed : int, optional
        Seed of the random numbers that differ between exposures. By default `seed`.
    effects : collection of str, optional
        Names of the effects of `LOCAL_EFFECTS` to apply to the raw image, besides those that cannot be left out. By
        default those that are noticeable.
    with_noise : bool, optional
        False to compute only the expected electrons.
    psf : Psf, optional
        PSF of the detector, if `visible_sources.exposure_psf` has computed it before.

    Returns
    -------
    WindowImage
        The image and its truth. Its expected electrons differ by less than 1/320 of the noise of a pixel from the image
        of the whole detector.

    Raises
    ------
    BadInput
        If the exposure is slitless or has no light of the sky, or if an effect is unknown.
    """
    window = aim.window
    if window is None or aim.channel.dispersion is not None or not aim.sees_sky:
        raise BadInput(f"exposure {aim.exposure.exposure_id}: windows are drawn in direct images of the sky only")
    # Light beyond stamps is interpolated between blocks of pixels. They begin at the first pixel of the detector.
    outer = window.align(wings.BLOCK)
    scene = scene_factory.from_aim(aim, variant)
    if aim.channel.transfer_effect is not None:
        # Whether this effect is noticeable depends on the brightest source on the detector, which the window may lack.
        scene = replace(scene, forced={aim.channel.transfer_effect.name: True, **scene.forced})
    light = visible_light(replace(aim, window=outer), rows, scene, seed, psf)
    limits.refuse_too_large(replace(aim, window=outer), light)
    assert light.psf is not None
    electrons, drawn_electrons = _draw(light, outer, window)
    sources = light.sources
    sources = replace(
        sources, column=sources.column + outer.column - window.column, row=sources.row + outer.row - window.row
    )
    is_listed = drawn_electrons > 0.0
    first, end = (int(np.clip(at - window.row, 0, window.ny)) for at in light.scene.unread_rows)
    electrons[first:end] = 0.0
    scene = replace(light.scene, window=window, amplifier=amplifier_at(aim, light.scene, window))
    raw, decisions = None, light.decisions
    if with_noise:
        raw, noise_decisions = _add_noise(aim, scene, electrons, (seed, noise_seed), effects)
        raw[first:end] = 0
        decisions += noise_decisions
    drawn_psf = light.psf
    if drawn_psf.planes is not None:
        drawn_psf = replace(drawn_psf, planes=replace(drawn_psf.planes, origin=(window.column, window.row)))
    return WindowImage(
        aim, electrons, raw, scene, drawn_psf, sources.take(is_listed), light.sizes[is_listed],
        drawn_electrons[is_listed], decisions,
    )  # fmt: skip


def truth(drawn: WindowImage) -> pa.Table:
    """Return the rows of the table `rendered_truth` for a window. Positions count from its first pixel."""
    place = drawn.aim.exposure, drawn.aim.detector.name
    return truth_table.rows_of_sources(*place, drawn.sources, drawn.sizes, drawn.drawn_electrons, drawn.psf)


def _draw(light: Light, outer: Window, window: Window) -> tuple[Float, Float]:
    """Return the expected electrons [ny, nx] in a window, and the electrons of each source's stamp."""
    assert light.psf is not None
    drawn_electrons = np.zeros(len(light.sources))
    frame = stamps.draw(
        light.sources, light.sizes, light.psf, outer.nx, outer.ny, None, light.neglected, Tally(drawn_electrons)
    )
    first_column, first_row = window.column - outer.column, window.row - outer.row
    inside = frame[first_row : first_row + window.ny, first_column : first_column + window.nx]
    return np.ascontiguousarray(inside), drawn_electrons


def _add_noise(
    aim: Aim, scene: Scene, electrons: Float, seeds: tuple[int, int | None], effects: Collection[str] | None
) -> tuple[Array, tuple[Decision, ...]]:
    """Return the raw pixels [ny, nx] of a window in ADU, and the decision about each of its effects."""
    window = aim.drawn
    check_effects(aim, effects)
    local = _local_effects(aim)
    scene = replace(scene, forced=_switches(local, effects, scene), lights=Lights())
    scene = scene_factory.with_peak_electrons(scene, electrons)
    scene = scene_factory.with_non_source_light(scene, aim.channel, local)

    def stream(effect: Effect) -> np.random.Generator:
        identity = rendered_detector.random_identity(effect, aim.exposure, aim.detector.name, *seeds)
        if effect.fixed:
            return rng.stream(*identity)
        return rng.stream(*identity, "window", window.column, window.row, window.nx, window.ny)

    part = DetectorPart(window, aim.detector.nx, aim.detector.ny)
    local = tuple(_on_part(effect, part) if effect.fixed else effect for effect in local)
    final, decisions = apply_all(electrons, local, scene, stream)
    numbers = final if final.ndim == 2 else final[0]
    return adc.to_file_type(numbers, scene), decisions


def _on_part(effect: Effect, part: DetectorPart) -> Effect:
    """Return an effect that gives a window the fixed pattern of the same pixels of the detector."""

    def parameters(scene: Scene) -> tuple[Any, ...]:
        return effect.parameters(replace(scene, window=None))

    return replace(effect, apply=partial(effect.apply, part=part), parameters=parameters)


def _switches(local: tuple[Effect, ...], effects: Collection[str] | None, scene: Scene) -> dict[str, bool]:
    """Return which effects are switched on (True) or off (False), by name; others are applied if noticeable."""
    if effects is None:
        return dict(scene.forced)
    return {effect.name: effect.name in effects for effect in local if effect.optional}


def check_effects(aim: Aim, effects: Collection[str] | None) -> None:
    """Raise BadInput if an effect cannot be applied to a window. The message lists the effects that can.

    `effects` are the names that the user gave, or None.
    """
    names = [effect.name for effect in _local_effects(aim) if effect.optional]
    if unknown := sorted(set(effects or ()) - set(names)):
        raise BadInput(f"effects: {unknown[0]!r} cannot be applied to a window; allowed here: {', '.join(names)}")


def _local_effects(aim: Aim) -> tuple[Effect, ...]:
    return tuple(effect for effect in aim.effects if effect.name in LOCAL_EFFECTS)


def amplifier_at(aim: Aim, scene: Scene, window: Window) -> int:
    """Find the amplifier that reads the middle of a window.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    scene : Scene
        Properties of the exposure.
    window : Window
        The window.

    Returns
    -------
    int
        Number of the amplifier, from 0; 0 if the detector has only one. If none reads the middle, the number is that of
        the nearer half of a VIS detector, or 0 for a ground camera.
    """
    if not _SPLITTING & {effect.name for effect in aim.effects}:
        return 0
    column, row = (int(place) for place in window.middle)
    return readout.amplifier_of_pixel(column, row, replace(scene, window=None))
