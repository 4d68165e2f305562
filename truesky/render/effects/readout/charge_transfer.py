"""Charge transfer inefficiency: traps in the silicon hold charge back while it is shifted to the output.

PARALLEL    down the columns, row by row, into the serial register
SERIAL      along the register, pixel by pixel, into the amplifier
PARALLEL_LOSS, SERIAL_LOSS   the same of cameras of which no more is known than the part that each transfer loses
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect
from truesky.render.effects.readout import traps
from truesky.render.effects.readout.traps import Sweeps, Traps
from truesky.render.effects.scene import NOTICEABLE, Frame, Scene
from truesky.request.accuracy import DRAFT, Accuracy

# Of a packet in a transfer, more than any detector that is in use.
_MAX_LOSS = 1e-3
# Species of the mission database.
_SPECIES = 3
# Traps passed that stand for the end of the mission: one in each of 2066 pixels.
_END_OF_LIFE = 2066.0
# What they then do to a source at the far end: of its flux, its position (pixels), its ellipticity; and the error of
# that, with the power of the damage that it grows with: from levels of traps, from one sweep, from Heun's rule and from
# four steps of it (as measured against arCTIc by the tests; levels against small steps).
_FLUX, _SHIFT, _SHAPE = 0.05, 0.036, 0.01
_SWEEPS = (
    (0.75, 1, Sweeps(1, 1, 9)),
    (0.016, 2, Sweeps(1, 1)),
    (0.0017, 2, Sweeps(1, 2)),
    (0.0008, 2, Sweeps(4, 2)),
)


def apply_parallel(
    frame: Frame, silicon: Traps, sweeps: Sweeps, rows: int, rng: np.random.Generator | None = None
) -> Frame:
    """quadrants [.., ny, nx] e- in readout order, `rows` of them pixels, the rest overscan.

    frame  : the quadrants;  lattice : traps along the columns
    sweeps : how closely charge is followed;  rng : not used
    """
    return traps.shift_charge(frame, silicon, sweeps, -2, min(rows, frame.shape[-2]))[0]


def apply_serial(
    frame: Frame, silicon: Traps, sweeps: Sweeps, columns: int, rng: np.random.Generator | None = None
) -> Frame:
    """quadrants [.., ny, nx] e- in readout order, `columns` of them register pixels, the rest overscan.

    frame  : the quadrants;  lattice : traps of the serial register
    sweeps : how closely charge is followed;  rng : not used
    """
    return traps.shift_charge(frame, silicon, sweeps, -1, min(columns, frame.shape[-1]))[0]


def choose_sweeps(accuracy: Accuracy, traps_passed: float) -> Sweeps:
    """How closely charge is followed past so many traps: as little as the errors of sources allow.

    Losses grow with the traps, and so does the error: what is left out is the next order in them.
    """
    return _best_sweeps(accuracy, traps_passed)[1]


def source_errors(scene: Scene, name: str) -> dict[str, float]:
    """What following charge no closer than that leaves in a source at the far end; nothing for another effect's name.

    returns : by number of an accuracy: fraction of its flux, reduced shear, pixels
    """
    if name == PARALLEL.name:
        direction, transfers = "parallel", scene.half_rows
    elif name == SERIAL.name:
        direction, transfers = "serial", _register_columns(scene)
    else:
        return {}
    error, _ = _best_sweeps(scene.accuracy, transfers * sum(silicon_traps(scene, direction).density))
    return {"flux": error * _FLUX, "shape": error * _SHAPE, "position": error * _SHIFT}


def _best_sweeps(accuracy: Accuracy, traps_passed: float) -> tuple[float, Sweeps]:
    """(of the damage, what is wrong; how charge is followed)."""
    damage = traps_passed / _END_OF_LIFE
    allowed = min(accuracy.flux / _FLUX, accuracy.position / _SHIFT, accuracy.shape / _SHAPE)
    candidates = [(error * damage**power, sweeps) for error, power, sweeps in _SWEEPS]
    return next((candidate for candidate in candidates if candidate[0] <= allowed), candidates[-1])


def silicon_traps(scene: Scene, direction: str) -> Traps:
    """The traps of a direction, "parallel" or "serial": damage since the launch times those of the mission's end."""
    damage = scene.value("cti.age", "")
    if direction == "serial":
        damage *= scene.value("cti.serial_ratio", "")
    species = range(1, _SPECIES + 1)
    return Traps(
        tuple(damage * scene.value(f"cti.density_{number}", "pix-1") for number in species),
        tuple(scene.value(f"cti.release_{number}", "pix") for number in species),
        scene.value("cti.full_well", "electron"),
        scene.value("cti.notch", "electron"),
        scene.value("cti.well_fill_power", ""),
    )


def apply_parallel_loss(frame: Frame, loss: float, rng: np.random.Generator | None = None) -> Frame:
    """Parts [.., ny, nx] e- in readout order, each transfer of which leaves the part `loss` to the next packet.

    frame : e-, charge that is left in the last packets is not read;  rng : not used
    Error : 2e-8 of a packet: what is left behind more than twice comes with the second one behind it
    """
    return _defer_charge(frame, loss, along=False)


def apply_serial_loss(frame: Frame, loss: float, rng: np.random.Generator | None = None) -> Frame:
    """The same along the register; frame, loss, rng : as of `apply_parallel_loss`."""
    return _defer_charge(frame, loss, along=True)


def _defer_charge(frame: Frame, loss: float, along: bool) -> Frame:
    if not 0.0 <= loss <= _MAX_LOSS:
        raise OutOfRange("charge lost in a transfer", loss, 0.0, _MAX_LOSS)
    transfers = np.arange(1.0, frame.shape[-1 if along else -2] + 1.0)
    staying = (1.0 - loss) ** transfers
    to_next = transfers * loss * staying
    packets = np.ascontiguousarray(frame, dtype=float)
    out = np.empty(packets.shape)
    shape = -1, *packets.shape[-2:]
    _defer_packets(packets.reshape(shape), staying, to_next, 1.0 - staying - to_next, along, out.reshape(shape))
    return out


@jit
def _defer_packets(frame: Any, staying: Any, to_next: Any, to_second: Any, along: bool, out: Any) -> None:
    """Of the packet at each place what stays in it, what comes with the next, and with the second behind it."""
    for q in range(len(frame)):
        for r in range(frame.shape[1]):
            row_in, row_out = frame[q, r], out[q, r]
            for c in range(len(row_in)):
                i = c if along else r
                row_out[c] = row_in[c] * staying[i]
                if i > 0:
                    row_out[c] += (row_in[c - 1] if along else frame[q, r - 1, c]) * to_next[i - 1]
                if i > 1:
                    row_out[c] += (row_in[c - 2] if along else frame[q, r - 2, c]) * to_second[i - 2]


def _transfer_loss(scene: Scene, direction: str) -> float:
    return scene.value(f"cti.{direction}", "")


def _max_deferred(scene: Scene, direction: str) -> float:
    """Electrons that the brightest packet leaves behind on the longest way."""
    if scene.layout is None:
        return 0.0
    layout = scene.layout
    transfers = layout.height if direction == "parallel" else layout.prescan + layout.width
    packet = min(scene.brightest_electrons, scene.value("full_well", "electron"))
    return transfers * _transfer_loss(scene, direction) * packet


def _register_columns(scene: Scene) -> int:
    return scene.nx // 2 + int(scene.value("fpa.prescan", "pix"))


def _max_loss(scene: Scene, direction: str, transfers: int) -> float:
    """Electrons that the brightest packet loses on the longest way, if all traps it reaches are empty.

    Where sources change by less than the accuracy allows, that tells the margin.
    """
    lost, excess = _loss_and_excess(scene, direction, transfers)
    return lost if excess > 1.0 else min(lost, excess * NOTICEABLE * scene.pixel_noise)


def _systematic_loss(scene: Scene, direction: str, transfers: int) -> float:
    """The same of a mean of frames, which keeps all; what the accuracy allows is allowed in the mean, too."""
    lost, excess = _loss_and_excess(scene, direction, transfers)
    return lost if excess > 1.0 else 0.0


def _loss_and_excess(scene: Scene, direction: str, transfers: int) -> tuple[float, float]:
    """Electrons, and what that does to sources over what the accuracy allows."""
    silicon = silicon_traps(scene, direction)
    traps_passed = transfers * sum(silicon.density)
    return traps_passed * float(silicon.volume(scene.brightest_electrons)), _accuracy_excess(
        scene.accuracy, traps_passed
    )


def _accuracy_excess(accuracy: Accuracy, traps_passed: float) -> float:
    """What so many traps do to a source, over what is allowed; a quicklook leaves out nothing that a draft has."""
    flux, shift, shape = (
        min(accuracy.flux, DRAFT.flux), min(accuracy.position, DRAFT.position), min(accuracy.shape, DRAFT.shape)
    )  # fmt: skip
    return traps_passed / _END_OF_LIFE * max(_FLUX / flux, _SHIFT / shift, _SHAPE / shape)


def _scene_before_readout(scene: Scene) -> Scene:
    """What lies in the pixels when they are moved: in no time no track has hit them."""
    return scene if scene.exposure_time_s > 0.0 else replace(scene, track_electrons=0.0)


def _parameters(scene: Scene, direction: str, transfers: int) -> tuple[Traps, Sweeps, int]:
    silicon = silicon_traps(scene, direction)
    return silicon, choose_sweeps(scene.accuracy, transfers * sum(silicon.density)), transfers


PARALLEL = Effect(
    "parallel_cti",
    apply_parallel,
    lambda scene: _parameters(scene, "parallel", scene.half_rows),
    lambda scene: _max_loss(_scene_before_readout(scene), "parallel", scene.half_rows),
    cost=0.044,
    systematic=lambda scene: _systematic_loss(_scene_before_readout(scene), "parallel", scene.half_rows),
)
SERIAL = Effect(
    "serial_cti",
    apply_serial,
    lambda scene: _parameters(scene, "serial", _register_columns(scene)),
    lambda scene: _max_loss(scene, "serial", _register_columns(scene)),
    cost=0.032,
    systematic=lambda scene: _systematic_loss(scene, "serial", _register_columns(scene)),
)
PARALLEL_LOSS = Effect(
    "parallel_loss",
    apply_parallel_loss,
    lambda scene: (_transfer_loss(scene, "parallel"),),
    lambda scene: _max_deferred(scene, "parallel"),
    cost=2e-3,
)
SERIAL_LOSS = Effect(
    "serial_loss",
    apply_serial_loss,
    lambda scene: (_transfer_loss(scene, "serial"),),
    lambda scene: _max_deferred(scene, "serial"),
    cost=2e-3,
)
