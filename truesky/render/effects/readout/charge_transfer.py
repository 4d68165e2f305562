"""Charge transfer inefficiency: traps in the silicon capture and release charge while it is shifted to the output.

Charge moves down the columns into the serial register (parallel), and along the register to the amplifier (serial).
For detectors with known traps, `PARALLEL` and `SERIAL` follow the charge of the traps. For cameras of which only the
loss per transfer is known, `PARALLEL_LOSS` and `SERIAL_LOSS` defer this fraction of each packet.
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

# Highest fraction of a packet that a transfer may lose. All detectors in use lose less.
_MAX_LOSS = 1e-3
# Number of trap species in the mission database.
_SPECIES = 3
# Number of traps on the longest path at the end of the mission: one in each of 2066 pixels.
_END_OF_LIFE = 2066.0
# At the end of the mission, changes of a source at the far end: relative flux, position in pixels, and ellipticity.
_FLUX, _SHIFT, _SHAPE = 0.05, 0.036, 0.01
# Error of these changes at the end of the mission as a fraction, exponent of the damage that it grows with, and method:
# trap levels, one sweep, Heun's method, and four steps of Heun's method. Tests measure the errors with arCTIc as the
# reference, and with small steps as the reference for trap levels.
_SWEEPS = (
    (0.75, 1, Sweeps(1, 1, 9)),
    (0.016, 2, Sweeps(1, 1)),
    (0.0017, 2, Sweeps(1, 2)),
    (0.0008, 2, Sweeps(4, 2)),
)


def apply_parallel(
    frame: Frame, silicon: Traps, sweeps: Sweeps, rows: int, rng: np.random.Generator | None = None
) -> Frame:
    """Shift charge down the columns, over traps.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each quadrant in readout order.
    silicon : Traps
        Traps along the columns.
    sweeps : Sweeps
        Method to follow the charge.
    rows : int
        Number of rows that are pixels; the others are overscan.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape of `frame`
        Electrons in the packets after the transfer.
    """
    return traps.shift_charge(frame, silicon, sweeps, -2, min(rows, frame.shape[-2]))[0]


def apply_serial(
    frame: Frame, silicon: Traps, sweeps: Sweeps, columns: int, rng: np.random.Generator | None = None
) -> Frame:
    """Shift charge along the serial register, over traps.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each quadrant in readout order.
    silicon : Traps
        Traps of the serial register.
    sweeps : Sweeps
        Method to follow the charge.
    columns : int
        Number of columns that are pixels of the register; the others are overscan.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape of `frame`
        Electrons in the packets after the transfer.
    """
    return traps.shift_charge(frame, silicon, sweeps, -1, min(columns, frame.shape[-1]))[0]


def choose_sweeps(accuracy: Accuracy, traps_passed: float) -> Sweeps:
    """Choose the fastest method whose error in sources is accepted, for a number of traps on the longest path.

    The loss grows with the number of traps, and so does the error: it is of the next order in the number of traps.
    """
    return _best_sweeps(accuracy, traps_passed)[1]


def source_errors(scene: Scene, name: str) -> dict[str, float]:
    """Return the errors that the chosen method leaves in a source at the far end, or {} for other effects' names.

    The keys are names of accuracies: "flux" (fraction), "shape" (reduced shear) and "position" (pixels).
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
    """Return the error as a fraction of the damage at the end of the mission, and the method."""
    damage = traps_passed / _END_OF_LIFE
    allowed = min(accuracy.flux / _FLUX, accuracy.position / _SHIFT, accuracy.shape / _SHAPE)
    candidates = [(error * damage**power, sweeps) for error, power, sweeps in _SWEEPS]
    return next((candidate for candidate in candidates if candidate[0] <= allowed), candidates[-1])


def silicon_traps(scene: Scene, direction: str) -> Traps:
    """Return the traps of a direction, "parallel" or "serial".

    Densities are those at the end of the mission times the damage since launch.
    """
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
    """Defer a fraction of each packet to the next one, at each transfer down the columns.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each amplifier in readout order.
    loss : float
        Fraction of a packet that each transfer leaves to the next packet, 0 to 1e-3.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape of `frame`
        Electrons after the transfer. Charge left behind the last packets is not read.

    Raises
    ------
    OutOfRange
        If `loss` is outside its limits.

    Notes
    -----
    Charge that is deferred more than twice is added to the second packet behind. The error is 2e-8 of a packet.
    """
    return _defer_charge(frame, loss, along=False)


def apply_serial_loss(frame: Frame, loss: float, rng: np.random.Generator | None = None) -> Frame:
    """Defer a fraction of each packet to the next one, at each transfer along the register.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each amplifier in readout order.
    loss : float
        Same as in `apply_parallel_loss`.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape of `frame`
        Electrons after the transfer.

    Raises
    ------
    OutOfRange
        If `loss` is outside its limits.
    """
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
    """Fill `out` with the charge of each packet.

    `staying`, `to_next` and `to_second` are the fractions that remain in a packet and that join the next two.
    """
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
    """Electrons that the brightest packet leaves behind on the longest path."""
    if scene.layout is None:
        return 0.0
    layout = scene.layout
    transfers = layout.height if direction == "parallel" else layout.prescan + layout.width
    packet = min(scene.brightest_electrons, scene.value("full_well", "electron"))
    return transfers * _transfer_loss(scene, direction) * packet


def _register_columns(scene: Scene) -> int:
    return scene.nx // 2 + int(scene.value("fpa.prescan", "pix"))


def _max_loss(scene: Scene, direction: str, transfers: int) -> float:
    """Electrons that the brightest packet loses on the longest path if all traps that it reaches are empty.

    The value is reduced if sources change by less than the accepted errors: the ratio then gives the margin.
    """
    lost, excess = _loss_and_excess(scene, direction, transfers)
    return lost if excess > 1.0 else min(lost, excess * NOTICEABLE * scene.pixel_noise)


def _systematic_loss(scene: Scene, direction: str, transfers: int) -> float:
    """Loss in a mean of frames: the whole loss, or 0 if sources change by less than the accepted errors."""
    lost, excess = _loss_and_excess(scene, direction, transfers)
    return lost if excess > 1.0 else 0.0


def _loss_and_excess(scene: Scene, direction: str, transfers: int) -> tuple[float, float]:
    """Lost electrons, and the change of sources relative to the accepted errors."""
    silicon = silicon_traps(scene, direction)
    traps_passed = transfers * sum(silicon.density)
    return traps_passed * float(silicon.volume(scene.brightest_electrons)), _accuracy_excess(
        scene.accuracy, traps_passed
    )


def _accuracy_excess(accuracy: Accuracy, traps_passed: float) -> float:
    """Change of a source by traps relative to the accepted errors, which are at most those of a draft.

    A quicklook therefore omits no effect that a draft includes.
    """
    flux, shift, shape = (
        min(accuracy.flux, DRAFT.flux), min(accuracy.position, DRAFT.position), min(accuracy.shape, DRAFT.shape)
    )  # fmt: skip
    return traps_passed / _END_OF_LIFE * max(_FLUX / flux, _SHIFT / shift, _SHAPE / shape)


def _scene_before_readout(scene: Scene) -> Scene:
    """Scene at the start of the readout: no cosmic ray has hit the pixels if the exposure time is 0."""
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
