"""Up-the-ramp readout: an infrared detector is read many times during an exposure without being reset.

A ramp is this series of reads, and each read of the detector is a frame. Successive frames are averaged in groups.

A ramp has n_g groups of r reads, with d dropped frames between two groups: r n_g + d (n_g - 1) frames after the reset.
The signal of a pixel is measured from the n = n_g - 1 differences D_i of successive groups. A group G_i is the mean
charge of its r reads. The number of electrons that arrive in each frame has a Poisson distribution with the mean f. An
electron that arrives in the j-th frame of a group has the weight (r - j + 1) / r in that group. The moments, three of
which are called a, b and v, are therefore::

    mean D_i            = f (r + d)
    var D_i         = a = f (r + d) (1 + alpha),      alpha = (1 - r^2) / (3 r (r + d))
    cov(D_i, D_i+1) = b = f (r^2 - 1) / (6 r),        all other covariances of differences are 0
    var G_1         = v = f (r + 1) (2 r + 1) / (6 r),    cov(G_1, D_1) = b

Drawing a count for every frame is slow. A first-order moving average has the same moments. It consists of independent
standard normal deviates e_0, e_1, ..., e_n and e::

    D_i = f (r + d) + c1 e_i + c0 e_i-1,                c0 = (sqrt(a + 2 b) + sqrt(a - 2 b)) / 2
    G_1 = f (r + 1) / 2 + c1 e_0 + sqrt(v - c1^2) e,    c1 = (sqrt(a + 2 b) - sqrt(a - 2 b)) / 2

It needs n + 2 random numbers. (e_0 must have the smaller coefficient in G_1, because c0^2 > v.)

The third moments of the Poisson distribution are added to T, the sum of the differences minus its mean n f (r + d).
Below, the D_i are also without their means. Let h_ik be the weight of an electron of frame k in D_i, H_k = sum_i h_ik
and g_k = sum_i h_ik^2 - H_k^2 / n. The sum of squares is SS = sum_i (D_i - T / n)^2, and its expectation is E SS. The
third cumulant of T is K3 f with K3 = sum_k H_k^3. The covariance of T and SS is C = f sum_k H_k g_k. The variance of T
is V_T. The variance of SS is V_S = V_G + f C4 with C4 = sum_k g_k^2, where V_G is the variance for normal deviates. The
transformation::

    T -> T sqrt(1 - C^2 V_G / (V_T V_S^2)) + C / V_S (SS - E SS) + K3 f (z^2 - 1) / (6 V_T),    z = T / sqrt(V_T)

    V_T = n a + 2 (n - 1) b,    E SS = n a - V_T / n
    V_G = 2 (n a^2 + 2 (n - 1) b^2 - 2 / n ((n - 2) (a + 2 b)^2 + 2 (a + b)^2) + V_T^2 / n^2)

preserves the variance of T. It reproduces the fraction V_G / V_S of the covariance C. The fraction is below 0.9 only
for pixels with fewer than about ten electrons, in which read noise dominates.

For most pixels the moving average is used. The count of every frame is drawn for pixels in which the charge is not
proportional to the counts. These are pixels with a cosmic ray, near full well, or with enough charge for the
nonlinearity to change the noise. Full well and nonlinearity act on the charge of each frame, not on averaged groups.

References
----------
Kubik et al. 2016, PASP 128, 104504 (groups, alpha). All other moments follow from independent counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema import ramps
from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.ramps import MAX_FRAMES
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import poisson
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Pixels with more electrons than this at the end of a ramp, with a cosmic ray or near full well get a random count of
# electrons for every frame (read of the detector), which is slow. All other pixels get random groups of averaged
# frames. At this number N the nonlinearity, with which N electrons are read as N (1 - b N), changes the noise by
# 2 b N = 0.4 %.
LINEAR_BELOW = 3000.0
# Largest relative difference between the frame time (time between two reads of the detector) that gives the requested
# exposure time and the frame time in the mission database. `find_mode` raises BadInput if more is needed.
FRAME_TOLERANCE = 0.02
# The number of dropped frames between two groups that gives an exposure time exactly is not always an integer. If it
# differs from the number in the mission database by less than this constant, the number in the database is used.
_DROPS_TOLERANCE = 1e-6
# Largest number of groups of a ramp, of reads per group and of dropped frames between two groups. `Mode` raises
# OutOfRange above it.
_MAX_COUNT = 1000


@dataclass(frozen=True, slots=True)
class Mode:
    """Readout mode of a ramp (a series of reads without reset): MACC(groups, reads, drops), "multi-accumulation".

    Attributes
    ----------
    groups : int
        Number of groups of averaged reads, 2 to 1000.
    reads : int
        Number of frames (reads of the detector) per group, 1 to 1000.
    drops : int
        Number of unused frames between two groups, 0 to 1000.

    Raises
    ------
    OutOfRange
        If a number is outside its limits.
    BadInput
        If the ramp has more than `MAX_FRAMES` = 4000 frames from the reset to the last read.
    """

    groups: int
    reads: int
    drops: int

    def __post_init__(self) -> None:
        for name, lowest in (("groups", 2), ("reads", 1), ("drops", 0)):
            if not lowest <= getattr(self, name) <= _MAX_COUNT:
                raise OutOfRange(f"{name} of a ramp", getattr(self, name), lowest, _MAX_COUNT)
        if self.frames > MAX_FRAMES:
            raise BadInput(f"{self} has {self.frames} frames, more than {MAX_FRAMES}")

    def __str__(self) -> str:
        return f"MACC({self.groups},{self.reads},{self.drops})"

    @property
    def differences(self) -> int:
        """Number of differences between successive groups of averaged reads: one less than the number of groups."""
        return self.groups - 1

    @property
    def frames(self) -> int:
        """Number of frames (reads of the detector, used or dropped) from the reset to the last read."""
        return ramps.frame_count(self.groups, self.reads, self.drops)

    @property
    def integration_frames(self) -> int:
        """Number of frames from the first read of the first group to the first read of the last group.

        The measured signal of a pixel is the charge that arrives in these frames.
        """
        return self.differences * (self.reads + self.drops)

    @property
    def alpha(self) -> float:
        """Variance of the difference between two successive groups of reads, divided by the mean difference, minus 1.

        A group is the mean of its reads, in electrons. Only shot noise is included. The value is 0 for one read per
        group, otherwise negative.
        """
        return (1.0 - self.reads**2) / (3.0 * self.reads * (self.reads + self.drops))

    def weights(self) -> Float:
        """Return by how much one electron increases each difference of successive groups, by the frame of its arrival.

        A group is the mean of several reads. The result is float64[differences, frames] in electrons, 0 to 1. Frames
        (reads of the detector, used or dropped) are counted from the reset.
        """
        frame = np.arange(self.frames)
        first = np.arange(self.groups)[:, None] * (self.reads + self.drops)
        # An electron is present in the read of the frame in which it arrives, and in all later reads.
        in_group = np.clip(first + self.reads - frame[None, :], 0, self.reads) / self.reads
        return np.diff(in_group, axis=0)

    def third_moments(self) -> tuple[float, float, float]:
        """Return three constants of the readout mode, with which groups of reads get the skewness of Poisson counts.

        Let h_ik be the amount by which an electron that arrives in frame k increases the difference i of the n
        differences of successive groups. With H_k = sum_i h_ik and g_k = sum_i h_ik^2 - H_k^2 / n, the constants are
        the sums over k of H_k^3, H_k g_k and g_k^2. The module docstring explains their use.
        """
        h = self.weights()
        total = h.sum(axis=0)
        g = (h**2).sum(axis=0) - total**2 / self.differences
        return float((total**3).sum()), float((total * g).sum()), float((g**2).sum())


def mode_of_scene(scene: Scene) -> Mode:
    """Return the readout mode (numbers of groups, reads and dropped frames) for the exposure time of a scene.

    BadInput is raised if no mode fits the exposure time, see `find_mode`.
    """
    return find_mode(scene.ramp, scene.exposure_time_s, scene.section, scene.mission)


def find_mode(kind: str, seconds: float, section: str, mission: MissionConfiguration) -> Mode:
    """Return the readout mode of a ramp for an exposure time.

    It has the groups and reads of the mode in the mission database, and the number of dropped frames that fits best.

    Parameters
    ----------
    kind : {"photometric", "spectroscopic"}
        Name of the ramp in the mission database.
    seconds : float
        Exposure time in seconds.
    section : str
        Prefix of the camera's parameters in the mission database, such as "nisp".
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Mode
        Numbers of groups, reads per group and dropped frames between groups.

    Raises
    ------
    BadInput
        If the exposure time is too short even without dropped frames, or too long for the allowed number of frames.
        Also if it needs a frame time that differs from the mission's by more than `FRAME_TOLERANCE` = 2 %.
    """
    key = f"{section}.macc.{kind}"
    groups, reads, drops = (int(mission.value(f"{key}.{name}")) for name in ("groups", "reads", "drops"))
    nominal, frame_s = Mode(groups, reads, drops), mission.value(f"{section}.frame_time", "s")
    best_drops = seconds / (frame_s * nominal.differences) - reads
    if abs(best_drops - drops) < _DROPS_TOLERANCE:
        return nominal
    if round(best_drops) < 0:
        shortest = frame_s * nominal.differences * reads
        raise BadInput(f"exposure time {seconds:g} s: {nominal} takes {shortest:.4g} s without any drops")
    if round(best_drops) > _MAX_COUNT:
        raise BadInput(f"exposure time {seconds:g} s: {nominal} needs {best_drops:.4g} drops, more than {_MAX_COUNT}")
    mode = Mode(groups, reads, round(best_drops))
    if abs(seconds / (frame_s * mode.integration_frames) - 1.0) > FRAME_TOLERANCE:
        raise BadInput(
            f"exposure time {seconds:g} s: {mode} takes {frame_s * mode.integration_frames:.4g} s, which differs by "
            f"more than {FRAME_TOLERANCE:.0%}"
        )
    return mode


def duration(kind: str, seconds: float, section: str, mission: MissionConfiguration) -> float:
    """Return the time from the reset of the detector to the last read of an exposure.

    Parameters
    ----------
    kind : {"photometric", "spectroscopic"}
        Name of the ramp (readout mode) in the mission database.
    seconds : float
        Exposure time in seconds.
    section : str
        Prefix of the camera's parameters in the mission database, such as "nisp".
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Time in seconds. It is longer than the exposure time, which begins with the first group of reads.

    Raises
    ------
    BadInput
        If no readout mode fits the exposure time, see `find_mode`.
    """
    mode = find_mode(kind, seconds, section, mission)
    return seconds * mode.frames / mode.integration_frames


def frame_time(scene: Scene) -> float:
    """Return the time between two frames of a ramp in seconds, adjusted to the exposure time of the scene.

    It differs by up to `FRAME_TOLERANCE` = 2 % from the frame time in the mission database.
    """
    return scene.exposure_time_s / mode_of_scene(scene).integration_frames


def with_planes(frame: Frame, count: int) -> Frame:
    """Copy an array of pixels, and add planes of zeros until it has a given number of planes.

    Parameters
    ----------
    frame : float array, shape (ny, nx) or (n, ny, nx)
        One plane, or n planes. n must not exceed `count`, which is not checked.
    count : int
        Number of planes of the result.

    Returns
    -------
    float32 array, shape (count, ny, nx)
        The planes of `frame`, followed by planes of zeros.
    """
    out = np.empty((count, *frame.shape[-2:]), np.float32)
    planes = frame.reshape(-1, *frame.shape[-2:])
    out[: len(planes)], out[len(planes) :] = planes, 0.0
    return out


def signal_at_full_well(scene: Scene, charge_b: float = 0.0, signal_b: float = 0.0) -> float:
    """Return the signal that is measured in a pixel that reaches full well exactly at the end of the ramp.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure: readout mode and full well.
    charge_b, signal_b : float
        Coefficients b in 1/electron of the nonlinearity, with which N electrons are read as N (1 - b N). `charge_b` is
        for the charge of each read, `signal_b` for the measured signal. With 0 there is no nonlinearity.

    Returns
    -------
    float
        Signal in electrons: the increase of the charge from the first to the last group of averaged reads.
    """
    mode, full = mode_of_scene(scene), scene.value("full_well", "electron")
    signal = full * (1.0 - charge_b * full) * mode.integration_frames / mode.frames
    # The measured signal N (1 - b N) has its maximum at N = 1 / (2 b). Larger N are set to 1 / (2 b).
    signal = min(signal, 0.5 / signal_b) if signal_b > 0.0 else signal
    return signal * (1.0 - signal_b * signal)


def full_pixels(frame: Frame, mode: Mode, full_well: float) -> Bool:
    """Return a mask of the pixels that are expected to reach full well by the end of the ramp.

    Parameters
    ----------
    frame : float array, shape (ny, nx) or (n, ny, nx)
        Electrons expected in the integration time, from the first to the last group of reads. With n planes (2 or
        more), these are in plane 0, and plane 1 contains the charge of cosmic rays in electrons.
    mode : Mode
        Readout mode of the ramp.
    full_well : float
        Full well in electrons.

    Returns
    -------
    bool array, shape (ny, nx)
        True for pixels whose expected charge at the end of the ramp is at least `full_well`.
    """
    light, charge = (frame[0], frame[1]) if frame.ndim == 3 else (frame, 0.0)
    return np.asarray(light * (mode.frames / mode.integration_frames) + charge >= full_well)


def apply(
    frame: Frame,
    mode: Mode,
    full_well: float,
    linear_below: float = LINEAR_BELOW,
    *,
    rng: np.random.Generator,
) -> Frame:
    """Draw the charge of each group of a ramp (averaged reads without reset), with shot noise.

    Parameters
    ----------
    frame : float array, shape (ny, nx), (3, ny, nx) or (4, ny, nx)
        Plane 0: electrons expected in the integration time, from the first to the last group. Planes 1 and 2: charge of
        cosmic rays in electrons, and the time at which it arrives, 0 <= time < 1, in units of the time from the reset
        to the last read. Plane 3: coefficient b in 1/electron of the nonlinearity, with which N electrons are read as
        N (1 - b N).
    mode : Mode
        Readout mode of the ramp.
    full_well : float
        Highest charge of a pixel in electrons, more than 0, below 1e9.
    linear_below : float, optional
        Number of electrons at the end of the ramp. Pixels with at most this number of expected electrons are drawn with
        a fast method that has the correct means and covariances of the groups, unless a cosmic ray hits them or they
        may reach full well. In all others the count of every frame (read of the detector) is drawn; with 0 this is done
        in all pixels with light.
    rng : numpy.random.Generator
        Random generator from which two 64-bit keys are drawn. Each pixel derives its random numbers from the keys and
        its index.

    Returns
    -------
    float32 array, shape (groups, ny, nx)
        Mean charge of the reads of each group in electrons, without read noise.

    Raises
    ------
    OutOfRange
        If `full_well` is outside its limits or NaN.
    """
    if not 0.0 < full_well < 1e9:
        raise OutOfRange("full well", full_well, 0.0, 1e9)
    planes = [*frame] if frame.ndim == 3 else [frame]
    out = np.empty((mode.groups, *planes[0].shape), np.float32)
    inputs = [np.ascontiguousarray(plane, dtype=np.float32).reshape(-1) for plane in planes]
    light, hit_charge, hit_time, coefficient = inputs + [np.zeros(0, np.float32)] * (4 - len(inputs))
    _draw_ramps(
        light,
        hit_charge,
        hit_time,
        coefficient,
        out.reshape(mode.groups, -1),
        (mode.groups, mode.reads, mode.drops),
        mode.third_moments(),
        (full_well, linear_below),
        (pixel_random.draw_key(rng), pixel_random.draw_key(rng)),
    )
    return out


@jit
def _draw_ramps(
    light: Any,
    hit_charge: Any,
    hit_time: Any,
    coefficient: Any,
    out: Any,
    shape: Any,
    cumulants: Any,
    limits: Any,
    keys: Any,
) -> None:
    groups, reads, drops = shape
    full_well, linear_below = limits
    frames = groups * reads + (groups - 1) * drops
    group = np.empty(groups)
    size = len(light)
    # Mean of k^2 over the reads of each group, where k is the number of frames since the reset. For f electrons per
    # frame, the nonlinearity N (1 - b N) reduces a group by b f^2 times this mean.
    squares = np.empty(groups)
    for i in range(groups):
        squares[i] = 0.0
        for j in range(reads):
            squares[i] += float(i * (reads + drops) + j + 1) ** 2 / reads
    # The pixels are processed in blocks, in loops that the compiler can vectorise. Rows have 8 more elements than a
    # block, because rows that are a multiple of 4 KiB apart in memory share their place in the processor's cache.
    block = pixel_random.BLOCK
    normals, bits = np.empty((groups + 1, block + 8)), np.empty(block, np.uint64)
    counts, work, rate = np.empty((groups, block + 8)), np.empty((5, block + 8)), np.empty(block)
    is_linear = np.empty(block, np.bool_)
    for start in range(0, size, block):
        width, linear = min(block, size - start), 0
        for j in range(width):
            rate[j] = max(light[start + j], 0.0) / ((groups - 1) * (reads + drops))
            end = rate[j] * frames
            is_hit = len(hit_charge) > 0 and hit_charge[start + j] != 0.0
            is_linear[j] = not (is_hit or end > linear_below or end + 10.0 * math.sqrt(end) > full_well)
            linear += is_linear[j]
        if linear:
            for i in range(groups + 1):
                pixel_random.fill_normals(normals[i, :width], bits, keys[0], start + i * size)
            _draw_groups(rate[:width], shape, cumulants, normals, work, counts)
            if len(coefficient) > 0:
                for i in range(groups):
                    for j in range(width):
                        counts[i, j] -= coefficient[start + j] * rate[j] * rate[j] * squares[i]
        if linear < width:
            for j in range(width):
                if not is_linear[j]:
                    hit, hit_frame = 0.0, 0
                    if len(hit_charge) > 0:
                        hit, hit_frame = hit_charge[start + j], int(hit_time[start + j] * frames)
                    b = coefficient[start + j] if len(coefficient) > 0 else 0.0
                    _draw_frames(rate[j], hit, hit_frame, shape, full_well, b, keys[1], start + j, group)
                    for i in range(groups):
                        counts[i, j] = group[i]
        for i in range(groups):
            out[i, start : start + width] = counts[i, :width]


@jit
def _draw_groups(rate: Any, shape: Any, cumulants: Any, e: Any, work: Any, counts: Any) -> None:
    """Fill `counts` with the electrons of the groups (averaged reads) of n pixels, from normal deviates `e`.

    Parameters
    ----------
    rate : float array, shape (n,)
        Expected electrons per frame (read of the detector).
    shape : tuple of int
        Number of groups, of reads per group and of dropped frames between groups.
    cumulants : tuple of float
        Result of `Mode.third_moments`, three constants for the skewness of the counts.
    e : float array, shape (groups + 1, n or more)
        Standard normal deviates.
    work : float array, shape (5, n or more)
        Scratch memory.
    counts : float array, shape (groups, n or more)
        Result, changed in place: electrons of each group.

    Notes
    -----
    The method is the moving average that the module docstring describes.
    """
    groups, reads, drops = shape
    n = groups - 1
    r = float(reads)
    unit_a = (r + drops) + (1.0 - r * r) / (3.0 * r)
    unit_b = (r * r - 1.0) / (6.0 * r)
    unit_v = (r + 1.0) * (2.0 * r + 1.0) / (6.0 * r)
    high, low = math.sqrt(unit_a + 2.0 * unit_b), math.sqrt(max(unit_a - 2.0 * unit_b, 0.0))
    # c0 and c1 are the coefficients of the moving average, and b is the covariance of successive differences. The
    # formula c1 = (high - low) / 2 would lose digits for small b. Use c0 c1 = b instead. The names with `unit_` are for
    # one electron per frame. For f electrons, a, b, v and V_T are proportional to f, V_G to f^2, and c0 and c1 to the
    # square root of f.
    unit_c0 = 0.5 * (high + low)
    unit_c1 = unit_b / unit_c0
    unit_first = math.sqrt(max(unit_v - unit_c1 * unit_c1, 0.0))
    k3, k_mixed, c4 = cumulants
    unit_vt = n * unit_a + 2.0 * (n - 1) * unit_b
    ends = (n - 2) * (unit_a + 2.0 * unit_b) ** 2 + 2.0 * (unit_a + unit_b) ** 2
    unit_vg = 2.0 * (n * unit_a**2 + 2.0 * (n - 1) * unit_b**2 - 2.0 / n * ends + unit_vt**2 / (n * n))
    root, mean, square, step, total = work
    for j in range(len(rate)):
        root[j], total[j], square[j] = math.sqrt(rate[j]), 0.0, 0.0
        counts[0, j] = 0.5 * rate[j] * (r + 1.0) + root[j] * (unit_c1 * e[0, j] + unit_first * e[groups, j])
    for i in range(n):
        for j in range(len(rate)):
            counts[i + 1, j] = root[j] * (unit_c1 * e[i + 1, j] + unit_c0 * e[i, j])
            total[j] += counts[i + 1, j]
    for j in range(len(rate)):
        mean[j] = total[j] / n
    for i in range(n):
        for j in range(len(rate)):
            square[j] += (counts[i + 1, j] - mean[j]) ** 2
    for j in range(len(rate)):
        # A pixel without light has no shift. The number 1 avoids a division by zero.
        f = rate[j] if rate[j] > 0.0 else 1.0
        shift = k3 * (total[j] * total[j] / (f * unit_vt) - 1.0) / (6.0 * unit_vt)
        if n > 1:
            v_g, mixed = f * f * unit_vg, k_mixed * f
            v_s = v_g + f * c4
            fraction = k_mixed / unit_vt * (v_g / v_s) * (mixed / v_s)
            # The factor of `total` is sqrt(1 - fraction) - 1, written without cancellation of digits.
            shift += total[j] * (-fraction / (1.0 + math.sqrt(1.0 - fraction)))
            shift += mixed / v_s * (square[j] - f * (n * unit_a - unit_vt / n))
        step[j] = rate[j] * (r + drops) + (shift / n if rate[j] > 0.0 else 0.0)
    for i in range(n):
        for j in range(len(rate)):
            counts[i + 1, j] += counts[i, j] + step[j]


@jit
def _draw_frames(
    f: float, hit: float, hit_frame: int, shape: Any, full_well: float, b: float, key: Any, pixel: int, group: Any
) -> None:
    """Fill `group` with the electrons of the groups (averaged reads) of a pixel, by drawing the count of every frame.

    `f` is the number of expected electrons per frame (read of the detector). `shape` has the number of groups, of reads
    per group and of dropped frames between groups. The charge `hit` of a cosmic ray (electrons) arrives in the frame
    `hit_frame`, counted from the reset. Charge above `full_well` (electrons) is lost. A charge of N electrons is read
    as N (1 - b N), with `b` in 1/electron. Random bits come from `key` and the index `pixel`.
    """
    groups, reads, drops = shape
    frames = groups * reads + (groups - 1) * drops
    p_zero = math.exp(-f) if f < poisson._EXACT_BELOW else 0.0
    charge = 0.0
    for i in range(groups):
        group[i] = 0.0
    for k in range(frames):
        charge += poisson.draw_count(f, p_zero, pixel_random.pixel_bits(key, pixel * frames + k))
        if k == hit_frame:
            charge += hit
        charge = min(charge, full_well)
        i = k // (reads + drops)
        if k - i * (reads + drops) < reads:
            group[i] += charge * (1.0 - b * charge) / reads


def _parameters(scene: Scene) -> tuple[Mode, float]:
    return mode_of_scene(scene), scene.value("full_well", "electron")


EFFECT = Effect(
    "ramp", apply, _parameters, poisson.EFFECT.contribution, optional=False, cost=8e-2, systematic=zero_contribution
)
