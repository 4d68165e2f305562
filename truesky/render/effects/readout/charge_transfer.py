"""Charge transfer inefficiency: traps in the silicon capture and release charge while it is shifted to the output.

Charge moves down the columns into the serial register (parallel transfer), and along the register to the amplifier
(serial transfer). For detectors with known traps, the effects `PARALLEL` and `SERIAL` follow the charge in the traps.
For cameras of which only the loss per transfer is known, the effects `PARALLEL_LOSS` and `SERIAL_LOSS` leave this
fraction of each charge packet behind, in the next packet.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from lake_schema.mission.detector_overrides import DetectorPlace
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.readout import traps
from truesky.render.effects.readout.traps import Sweeps, Traps
from truesky.render.effects.scene import Frame, Scene
from truesky.request.accuracy import Accuracy

# Highest allowed fraction of a charge packet that one transfer from pixel to pixel leaves behind. OutOfRange is raised
# above it. All detectors in use have a lower fraction.
_MAX_LOSS = 1e-3
# Number of trap species (with different release times) in the mission database.
_SPECIES = 3
# Number of traps that the charge of the pixel farthest from the amplifier passes at the end of the mission: one in each
# of 2066 pixels.
_END_OF_LIFE = 2066.0
# Relative change of the flux of a source by traps, in the pixel farthest from the amplifier, at the end of the mission.
_FLUX = 0.05
# Change of the position of a source by traps, in the pixel farthest from the amplifier, at the end of the mission, in
# pixels.
_SHIFT = 0.036
# Change of the ellipticity of a source by traps, in the pixel farthest from the amplifier, at the end of the mission.
_SHAPE = 0.01
# Julian year in days.
_DAYS_PER_YEAR = 365.25
# Numerical methods to follow charge over traps, from the fastest to the slowest: nine groups of traps by the charge
# that reaches them, one sweep over all pixels, Heun's method, and four steps of Heun's method. Each row is (error e,
# exponent p, method). Let d be the number of traps divided by that at the end of the mission. The error of a method is
# e d^p times the changes that traps cause in sources at the end of the mission. Tests measure e by comparison with the
# program arCTIc, and for the fastest method by comparison with a calculation in small steps.
_SWEEPS = (
    (0.75, 1, Sweeps(1, 1, 9)),
    (0.016, 2, Sweeps(1, 1)),
    (0.0017, 2, Sweeps(1, 2)),
    (0.0008, 2, Sweeps(4, 2)),
)


def apply_parallel(
    frame: Frame,
    silicon: Traps,
    sweeps: Sweeps,
    rows: int,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Shift charge down the columns to the serial register, over traps that capture and release electrons.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each quadrant, 0 or more. Row 0 is read first.
    silicon : Traps
        Density and release times of the traps along the columns, and the volume of a pixel that charge fills.
    sweeps : Sweeps
        Numerical method to follow the charge.
    rows : int
        Number of rows that are pixels of the detector; the others are overscan. Larger numbers mean all rows.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons of each pixel after the transfer. Charge that is still trapped after the last row is lost.
    """
    return traps.shift_charge(frame, silicon, sweeps, -2, min(rows, frame.shape[-2]), out)[0]


def apply_serial(
    frame: Frame,
    silicon: Traps,
    sweeps: Sweeps,
    columns: int,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Shift charge along the serial register to the amplifier, over traps that capture and release electrons.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each quadrant, 0 or more. Column 0 is read first.
    silicon : Traps
        Density and release times of the traps in the serial register, and the volume of a pixel that charge fills.
    sweeps : Sweeps
        Numerical method to follow the charge.
    columns : int
        Number of columns that start in a pixel of the register; the others are overscan. Larger numbers mean all
        columns.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons of each pixel after the transfer. Charge that is still trapped after the last column is lost.
    """
    return traps.shift_charge(frame, silicon, sweeps, -1, min(columns, frame.shape[-1]), out)[0]


def choose_sweeps(accuracy: Accuracy, traps_passed: float) -> Sweeps:
    """Return the fastest numerical method to follow charge over traps that is accurate enough for all sources.

    `accuracy` has the accepted errors of the flux, position and shape of a source. `traps_passed` counts the traps
    on the longest path to the amplifier. The fastest method has an error proportional to this number; the other methods
    have errors proportional to its square. If no method is accurate enough, the result is the most accurate one.
    """
    return _best_sweeps(accuracy, traps_passed)[1]


def source_errors(scene: Scene, name: str) -> dict[str, float]:
    """Return the errors of a source farthest from the amplifier that the approximate simulation of traps causes.

    The keys are "flux" (relative), "shape" (reduced shear) and "position" (pixels). They are due to the
    numerical method that the accuracy of the scene selects. `name` is the name of a detector effect; the result is {}
    unless it is "parallel_cti" or "serial_cti", the shift of charge over traps in one direction.
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
    """Return the error and the method: the fastest numerical method to follow charge that is accurate enough.

    `accuracy` has the accepted errors of sources, and `traps_passed` is the number of traps on the longest path to the
    amplifier. The error is a fraction of the changes that traps cause in sources at the end of the mission. If no
    method is accurate enough, the most accurate one is returned.
    """
    damage = traps_passed / _END_OF_LIFE
    allowed = min(accuracy.flux / _FLUX, accuracy.position / _SHIFT, accuracy.shape / _SHAPE)
    candidates = [(error * damage**power, sweeps) for error, power, sweeps in _SWEEPS]
    return next((candidate for candidate in candidates if candidate[0] <= allowed), candidates[-1])


def silicon_traps(scene: Scene, direction: str) -> Traps:
    """Return the traps for one direction of transfer, "parallel" or "serial", from the mission database.

    The density is that at the end of the mission times the age of the damage, `age`. For the serial direction, the
    density is also multiplied by the parameter `cti.serial_ratio`.
    """
    damage = age(scene)
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


def age(scene: Scene) -> float:
    """Return the radiation damage at the date of an exposure, divided by the damage at the end of the mission.

    It is the parameter `cti.age` at launch and grows by `cti.age_growth` with time: the number of traps is proportional
    to the dose of protons. If the request sets `cti.age` but not `cti.age_growth`, it does not grow. Before the launch,
    the damage is that at launch.
    """
    place = DetectorPlace(scene.detector.name if scene.detector is not None else "")
    at_launch, growth = scene.value("cti.age", ""), scene.value("cti.age_growth", "1 / yr")
    is_set, grows = (scene.mission.is_overridden(f"{scene.section}.cti.{key}", place) for key in ("age", "age_growth"))
    if is_set and not grows:
        return at_launch
    return at_launch + growth * max(scene.mjd - scene.mission.value("svm.launch", "d"), 0.0) / _DAYS_PER_YEAR


def apply_parallel_loss(
    frame: Frame, loss: float, rng: np.random.Generator | None = None, out: Frame | None = None
) -> Frame:
    """Leave a fraction of each charge packet behind in the next packet, at each transfer down the columns.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each amplifier. Row 0 is read first.
    loss : float
        Fraction of a packet that each transfer leaves to the next packet, 0 to 1e-3.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons after the transfer. Charge left behind the last packet of a column is not read.

    Raises
    ------
    OutOfRange
        If `loss` is outside its limits or NaN.

    Notes
    -----
    As an approximation, charge that falls back by more than two packets is added to the second packet behind. For a
    loss of 1e-6 and a few thousand transfers, the error is 2e-8 of a packet. It grows with the third power of the loss.
    """
    return _defer_charge(frame, loss, along=False, out=out)


def apply_serial_loss(
    frame: Frame, loss: float, rng: np.random.Generator | None = None, out: Frame | None = None
) -> Frame:
    """Leave a fraction of each charge packet behind in the next packet, at each transfer along the serial register.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons of each amplifier. Column 0 is read first.
    loss : float
        Fraction of a packet that each transfer leaves to the next packet, 0 to 1e-3.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons after the transfer. Charge left behind the last packet of a row is not read.

    Raises
    ------
    OutOfRange
        If `loss` is outside its limits or NaN.

    Notes
    -----
    As an approximation, charge that falls back by more than two packets is added to the second packet behind.
    """
    return _defer_charge(frame, loss, along=True, out=out)


def _defer_charge(frame: Frame, loss: float, along: bool, out: Frame | None) -> Frame:
    if not 0.0 <= loss <= _MAX_LOSS:
        raise OutOfRange("charge lost in a transfer", loss, 0.0, _MAX_LOSS)
    transfers = np.arange(1.0, frame.shape[-1 if along else -2] + 1.0)
    staying = (1.0 - loss) ** transfers
    to_next = transfers * loss * staying
    out = copy_frame(frame, out)
    defer_packets = _defer_along_rows if along else _defer_down_columns
    defer_packets(out.reshape(-1, *out.shape[-2:]), staying, to_next, 1.0 - staying - to_next)
    return out


@jit
def _defer_down_columns(frame: Any, staying: Any, to_next: Any, to_second: Any) -> None:
    """Replace the charge of each packet by that after all transfers down the columns, in place.

    `frame` has the axes [amplifier, row, column], in electrons, with the pixel at [0, 0] read first. `staying`,
    `to_next` and `to_second` are the fractions of a packet that remain in it, that join the packet read next, and that
    join the one after it. Their index is the row in which the packet starts.
    """
    for q in range(len(frame)):
        # Start with the last row, because each row depends on rows before it.
        for r in range(frame.shape[1] - 1, -1, -1):
            row = frame[q, r]
            if r == 0:
                for c in range(len(row)):
                    row[c] = row[c] * staying[0]
            elif r == 1:
                first = frame[q, 0]
                for c in range(len(row)):
                    row[c] = row[c] * staying[1] + first[c] * to_next[0]
            else:
                second, first = frame[q, r - 2], frame[q, r - 1]
                for c in range(len(row)):
                    row[c] = row[c] * staying[r] + first[c] * to_next[r - 1] + second[c] * to_second[r - 2]


@jit
def _defer_along_rows(frame: Any, staying: Any, to_next: Any, to_second: Any) -> None:
    """Replace the charge of each packet by that after all transfers along the serial register, in place.

    The arguments have the same meaning as for `_defer_down_columns`, except that the index of the fractions is the
    column in which the packet starts.
    """
    nx = frame.shape[2]
    line = np.empty(nx)
    for q in range(len(frame)):
        for r in range(frame.shape[1]):
            row = frame[q, r]
            line[:] = row
            for c in range(nx):
                row[c] = line[c] * staying[c]
            for c in range(1, nx):
                row[c] += line[c - 1] * to_next[c - 1]
            for c in range(2, nx):
                row[c] += line[c - 2] * to_second[c - 2]


def _transfer_loss(scene: Scene, direction: str) -> float:
    return scene.value(f"cti.{direction}", "")


def _max_deferred(scene: Scene, direction: str) -> float:
    """Return the electrons that the brightest packet leaves behind on the longest path to the amplifier.

    `direction` is "parallel" (down the columns) or "serial" (along the register). The result is 0 for detectors without
    a table of amplifiers in the mission database.
    """
    if scene.layout is None:
        return 0.0
    layout = scene.layout
    transfers = layout.prescan_rows + layout.height if direction == "parallel" else layout.prescan + layout.width
    packet = min(scene.brightest_electrons, scene.full_well)
    return transfers * _transfer_loss(scene, direction) * packet


def _register_columns(scene: Scene) -> int:
    return scene.nx // 2 + int(scene.value("fpa.prescan", "pix"))


def _max_loss(scene: Scene, direction: str, transfers: int) -> float:
    """Return the electrons that the brightest packet loses on the longest path if all traps that it reaches are empty.

    `direction` is "parallel" (down the columns) or "serial", and `transfers` the number of pixels on the longest path.
    If traps change sources by less than the errors that the request accepts, the result is limited to the noticeable
    change of a pixel times (change of sources / accepted error). The effect then counts as too small to be applied.
    """
    lost, excess = _loss_and_excess(scene, direction, transfers)
    return lost if excess > 1.0 else min(lost, excess * scene.noticeable_electrons)


def _systematic_loss(scene: Scene, direction: str, transfers: int) -> float:
    """Return the electrons that the brightest packet loses to traps on the longest path, which repeats in every frame.

    `direction` is "parallel" (down the columns) or "serial", and `transfers` the number of pixels on the longest path.
    The result is 0 if traps change sources by less than the errors that the request accepts.
    """
    lost, excess = _loss_and_excess(scene, direction, transfers)
    return lost if excess > 1.0 else 0.0


def _loss_and_excess(scene: Scene, direction: str, transfers: int) -> tuple[float, float]:
    """Return the electrons that the brightest packet loses to traps, and the change of sources / accepted error.

    `direction` is "parallel" (down the columns) or "serial", and `transfers` the number of pixels on the longest path.
    The second number is the largest of the changes of flux, position and shape, each divided by its accepted error.
    """
    silicon = silicon_traps(scene, direction)
    traps_passed = transfers * sum(silicon.density)
    return traps_passed * float(silicon.volume(scene.brightest_electrons)), _accuracy_excess(
        scene.accuracy, traps_passed
    )


def _accuracy_excess(accuracy: Accuracy, traps_passed: float) -> float:
    """Return the largest change of a source by traps (flux, position or shape) divided by the accepted error.

    `traps_passed` is the number of traps on the longest path to the amplifier, and `accuracy` has the accepted errors.
    """
    return traps_passed / _END_OF_LIFE * max(_FLUX / accuracy.flux, _SHIFT / accuracy.position, _SHAPE / accuracy.shape)


def _scene_before_readout(scene: Scene) -> Scene:
    """Return the scene without cosmic rays if its exposure time is 0, because none hits the pixels before the readout.

    Otherwise the scene is returned unchanged.
    """
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
    in_place=True,
)
SERIAL = Effect(
    "serial_cti",
    apply_serial,
    lambda scene: _parameters(scene, "serial", _register_columns(scene)),
    lambda scene: _max_loss(scene, "serial", _register_columns(scene)),
    cost=0.032,
    systematic=lambda scene: _systematic_loss(scene, "serial", _register_columns(scene)),
    in_place=True,
)
PARALLEL_LOSS = Effect(
    "parallel_loss",
    apply_parallel_loss,
    lambda scene: (_transfer_loss(scene, "parallel"),),
    lambda scene: _max_deferred(scene, "parallel"),
    cost=2e-3,
    in_place=True,
)
SERIAL_LOSS = Effect(
    "serial_loss",
    apply_serial_loss,
    lambda scene: (_transfer_loss(scene, "serial"),),
    lambda scene: _max_deferred(scene, "serial"),
    cost=2e-3,
    in_place=True,
)
