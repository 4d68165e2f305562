"""Up the ramp: an infrared detector is read without being emptied, and its charge is averaged in groups of reads.

A ramp has n_g groups of r reads with d dropped frames between two groups, r n_g + d (n_g - 1) frames after the reset.
The charge after frame k is N_k; a group is the mean of its r values, and what is measured of a pixel are the
n = n_g - 1 differences D_i of neighbouring groups.  Where f electrons a frame are expected and each frame's count is
Poisson, a photon of the j-th frame of a group weighs (r - j + 1) / r in that group's mean, so that

    mean D_i          = f (r + d)
    var D_i       a   = f (r + d) (1 + alpha),      alpha = (1 - r^2) / (3 r (r + d))
    cov D_i D_i+1 b   = f (r^2 - 1) / (6 r),        all others 0
    var G_1       v   = f (r + 1) (2 r + 1) / (6 r), cov G_1 D_1 = b

A first-order moving average has these moments: with c0, c1 = (sqrt(a + 2 b) +- sqrt(a - 2 b)) / 2,

    D_i = mean + c1 e_i + c0 e_i-1,    G_1 = f (r + 1) / 2 + c1 e_0 + sqrt(v - c1^2) e,

e standard normal: n + 2 numbers instead of a count a frame (c0^2 > v: e_0 must have the smaller coefficient in G_1).
Poisson's third moments are put into the sum T of the differences.  With h_k the weight of a photon of frame k in D_i,
H = sum_i h and g = sum_i h^2 - H^2 / n, T and the sum of squares SS = sum (D - mean D)^2 have the joint cumulants
K3 f = f sum H^3 and C = f sum H g; SS has the variance V_G of normal deviates and f C4 = f sum g^2 more.  With
V_S = V_G + f C4 and z = T / sqrt(V_T)

    T -> T sqrt(1 - C^2 V_G / (V_T V_S^2)) + C / V_S (SS - E SS) + K3 f (z^2 - 1) / (6 V_T)

    V_T = n a + 2 (n - 1) b,    E SS = n a - V_T / n
    V_G = 2 (n a^2 + 2 (n - 1) b^2 - 2 / n ((n - 2) (a + 2 b)^2 + 2 (a + b)^2) + V_T^2 / n^2)

keeps the variance of T; of the covariance C it gives V_G / V_S, which falls below 0.9 where a pixel has fewer than some
ten electrons and its noise is that of its reads.

Where a pixel is not linear in its counts (a cosmic ray, saturation, so much charge that the non-linearity of its noise
shows) every frame is drawn.  Full well and non-linearity act on the charge of a frame, before groups are averaged.

apply, EFFECT   expected light -> charge of the groups
Mode, mode_of, mode_for   how a ramp is read;  elapsed : how long it takes
planes          a frame with room for what a ramp wants to know besides light
full_signal     what is measured of a pixel that is full at the end

Ref : Kubik et al. 2016, PASP 128, 104504 (groups, alpha); the moments above are those of sums of independent counts
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

# Electrons at a ramp's end above which the noise of a pixel is not linear in its charge, and every frame is drawn:
# there 2 b N, the change of the noise, is 0.4 %.
LINEAR_BELOW = 3000.0
# By what part a frame's time may differ from the mission's, so that a ramp takes an exposure time.
FRAME_TOLERANCE = 0.02
# Of a number of drops: exposure times that differ by less are the same.
_DROPS_TOLERANCE = 1e-6
# Groups, reads or drops of a ramp.
_MAX_COUNT = 1000


@dataclass(frozen=True, slots=True)
class Mode:
    """How a ramp is read: MACC(groups, reads, drops).

    groups : averaged groups, at least 2;  reads : frames in a group;  drops : frames between two groups
    """

    groups: int
    reads: int
    drops: int

    def __post_init__(self) -> None:
        for name, lowest in (("groups", 2), ("reads", 1), ("drops", 0)):
            if not lowest <= getattr(self, name) <= _MAX_COUNT:
                raise OutOfRange(f"{name} of a ramp", getattr(self, name), lowest, _MAX_COUNT)
        if self.frames > MAX_FRAMES:
            raise BadInput(f"{self}: {self.frames} frames are more than {MAX_FRAMES}")

    def __str__(self) -> str:
        return f"MACC({self.groups},{self.reads},{self.drops})"

    @property
    def differences(self) -> int:
        """Of neighbouring groups."""
        return self.groups - 1

    @property
    def frames(self) -> int:
        """From the reset to the last read."""
        return ramps.frame_count(self.groups, self.reads, self.drops)

    @property
    def integration_frames(self) -> int:
        """Frames between the first group and the last: the exposure time of the signal."""
        return self.differences * (self.reads + self.drops)

    @property
    def alpha(self) -> float:
        """Of the variance of a difference, (1 + alpha) times its mean count."""
        return (1.0 - self.reads**2) / (3.0 * self.reads * (self.reads + self.drops))

    def weights(self) -> Float:
        """float64[differences, frames]: what an electron that comes in a frame adds to each difference of groups."""
        frame = np.arange(self.frames)
        first = np.arange(self.groups)[:, None] * (self.reads + self.drops)
        # Reads of a group that see it: those from its own frame on.
        in_group = np.clip(first + self.reads - frame[None, :], 0, self.reads) / self.reads
        return np.diff(in_group, axis=0)

    def third_moments(self) -> tuple[float, float, float]:
        """(K3, C / f, C4) of the module's head."""
        h = self.weights()
        total = h.sum(axis=0)
        g = (h**2).sum(axis=0) - total**2 / self.differences
        return float((total**3).sum()), float((total * g).sum()), float((g**2).sum())


def mode_of_scene(scene: Scene) -> Mode:
    """That of the scene's ramp, with as many drops as its exposure time wants; errors as of `mode_for`."""
    return find_mode(scene.ramp, scene.exposure_time_s, scene.section, scene.mission)


def find_mode(kind: str, seconds: float, section: str, mission: MissionConfiguration) -> Mode:
    """How an exposure of a length is read: the mission's mode, with as many drops as it takes.

    kind    : "photometric" or "spectroscopic";  seconds : exposure time
    section : of the camera, "nisp";  mission : the mission database
    Errors  : BadInput where the reads alone take longer, the frames are too many, or no number of drops takes about as
              long
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
        raise BadInput(f"exposure time {seconds:g} s: {nominal} takes {best_drops:.4g} drops, more than {_MAX_COUNT}")
    mode = Mode(groups, reads, round(best_drops))
    if abs(seconds / (frame_s * mode.integration_frames) - 1.0) > FRAME_TOLERANCE:
        raise BadInput(
            f"exposure time {seconds:g} s: {mode} takes {frame_s * mode.integration_frames:.4g} s, which differs by "
            f"more than {FRAME_TOLERANCE:.0%}"
        )
    return mode


def duration(kind: str, seconds: float, section: str, mission: MissionConfiguration) -> float:
    """Seconds from the reset to the last read of an exposure of a length; errors as of `mode_for`.

    kind, seconds, section, mission : of `mode_for`
    """
    mode = find_mode(kind, seconds, section, mission)
    return seconds * mode.frames / mode.integration_frames


def frame_time(scene: Scene) -> float:
    """Seconds from frame to frame: the mission's, where the exposure time is a multiple of it, else near it."""
    return scene.exposure_time_s / mode_of_scene(scene).integration_frames


def with_planes(frame: Frame, count: int) -> Frame:
    """A new float32[count, ny, nx] of `apply`: what the frame has, and zeros."""
    out = np.empty((count, *frame.shape[-2:]), np.float32)
    planes = frame.reshape(-1, *frame.shape[-2:])
    out[: len(planes)], out[len(planes) :] = planes, 0.0
    return out


def signal_at_full_well(scene: Scene, charge_b: float = 0.0, signal_b: float = 0.0) -> float:
    """Electrons that are measured in the integration time of a pixel that is full at the ramp's end.

    of_charge, of_signal : b of N (1 - b N), what is seen of N electrons in a frame, and of those of the signal, 1/e-
    """
    mode, full = mode_of_scene(scene), scene.value("full_well", "electron")
    signal = full * (1.0 - charge_b * full) * mode.integration_frames / mode.frames
    # Of more than 1 / 2 b is seen what is seen of these.
    signal = min(signal, 0.5 / signal_b) if signal_b > 0.0 else signal
    return signal * (1.0 - signal_b * signal)


def full_pixels(frame: Frame, mode: Mode, full_well: float) -> Bool:
    """[ny, nx] pixels of a frame of `apply` that are expected to be full at the ramp's end."""
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
    """Expected light -> charge of the groups, float32[groups, ny, nx] e-.

    frame        : [ny, nx] e- expected in the mode's integration time; or [3, ny, nx], with the charge that cosmic rays
                   leave in a pixel, e-, and the moment of it as a fraction of the ramp, 0 <= moment < 1; or
                   [4, ny, nx], with b of N (1 - b N), what is seen of N electrons, 1/e-
    full_well    : e- that a pixel holds, no more
    Error        : all of it in single precision, 6e-8
    linear_below : e- at the ramp's end up to which the linear law is used; 0 = every frame of every pixel is drawn
    mode, rng    : how the ramp is read; random numbers
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
    e, group = np.empty(groups + 1), np.empty(groups)
    size = len(light)
    # Mean of k^2 over the reads of each group: the non-linearity of a mean ramp.
    squares = np.empty(groups)
    for i in range(groups):
        squares[i] = 0.0
        for j in range(reads):
            squares[i] += float(i * (reads + drops) + j + 1) ** 2 / reads
    for p in range(size):
        f = max(light[p], 0.0) / ((groups - 1) * (reads + drops))
        hit = hit_charge[p] if len(hit_charge) > 0 else 0.0
        b = coefficient[p] if len(coefficient) > 0 else 0.0
        end = f * frames
        if hit != 0.0 or end > linear_below or end + 10.0 * math.sqrt(end) > full_well:
            hit_frame = int(hit_time[p] * frames) if len(hit_charge) > 0 else 0
            _draw_frames(f, hit, hit_frame, shape, full_well, b, keys[1], p, group)
        else:
            for i in range(groups + 1):
                e[i] = pixel_random.normal(pixel_random.pixel_bits(keys[0], p + i * size))
            _draw_groups(f, shape, cumulants, e, group)
            for i in range(groups):
                group[i] -= b * f * f * squares[i]
        for i in range(groups):
            out[i, p] = group[i]


@jit
def _draw_groups(f: float, shape: Any, cumulants: Any, e: Any, group: Any) -> None:
    """Groups of a pixel from groups + 1 normal deviates e: the linear law of the module's head."""
    groups, reads, drops = shape
    n = groups - 1
    r = float(reads)
    a = f * ((r + drops) + (1.0 - r * r) / (3.0 * r))
    b = f * (r * r - 1.0) / (6.0 * r)
    v = f * (r + 1.0) * (2.0 * r + 1.0) / (6.0 * r)
    high, low = math.sqrt(a + 2.0 * b), math.sqrt(max(a - 2.0 * b, 0.0))
    # Of two numbers whose product is b the smaller by a division: high - low cancels where b is small.
    c0 = 0.5 * (high + low)
    c1 = b / c0 if c0 > 0.0 else 0.0
    total, square = 0.0, 0.0
    for i in range(n):
        group[i + 1] = c1 * e[i + 1] + c0 * e[i]
        total += group[i + 1]
    for i in range(n):
        square += (group[i + 1] - total / n) ** 2
    k3, k_mixed, c4 = cumulants
    shift = 0.0
    v_t = n * a + 2.0 * (n - 1) * b
    if v_t > 0.0:
        shift = k3 * f * (total * total / v_t - 1.0) / (6.0 * v_t)
        if n > 1:
            ends = (n - 2) * (a + 2.0 * b) ** 2 + 2.0 * (a + b) ** 2
            v_g = 2.0 * (n * a * a + 2.0 * (n - 1) * b * b - 2.0 / n * ends + v_t * v_t / (n * n))
            v_s = v_g + f * c4
            mixed = k_mixed * f
            fraction = mixed / v_t * (v_g / v_s) * (mixed / v_s)
            # sqrt(1 - part) - 1, without the difference.
            shift += total * (-fraction / (1.0 + math.sqrt(1.0 - fraction)))
            shift += mixed / v_s * (square - (n * a - v_t / n))
    group[0] = 0.5 * f * (r + 1.0) + c1 * e[0] + math.sqrt(max(v - c1 * c1, 0.0)) * e[groups]
    for i in range(n):
        group[i + 1] += group[i] + f * (r + drops) + shift / n


@jit
def _draw_frames(
    f: float, hit: float, hit_frame: int, shape: Any, full_well: float, b: float, key: Any, pixel: int, group: Any
) -> None:
    """Groups of a pixel, a count a frame."""
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
