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
from lake_schema.ramps import MOST_FRAMES
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import poisson
from truesky.render.effects.effect import Effect, nothing
from truesky.render.effects.scene import Frame, Scene

# Electrons at a ramp's end above which the noise of a pixel is not linear in its charge, and every frame is drawn:
# there 2 b N, the change of the noise, is 0.4 %.
LINEAR_BELOW = 3000.0
# By what part a frame's time may differ from the mission's, so that a ramp takes an exposure time.
FRAME_TOLERANCE = 0.02
# Of a number of drops: exposure times that differ by less are the same.
_SAME = 1e-6
# Groups, reads or drops of a ramp.
_MOST = 1000


@dataclass(frozen=True, slots=True)
class Mode:
    """How a ramp is read: MACC(groups, reads, drops).

    groups : averaged groups, at least 2;  reads : frames in a group;  drops : frames between two groups
    """

    groups: int
    reads: int
    drops: int

    def __post_init__(self) -> None:
        for name, least in (("groups", 2), ("reads", 1), ("drops", 0)):
            if not least <= getattr(self, name) <= _MOST:
                raise OutOfRange(f"{name} of a ramp", getattr(self, name), least, _MOST)
        if self.frames > MOST_FRAMES:
            raise BadInput(f"{self}: {self.frames} frames are more than {MOST_FRAMES}")

    def __str__(self) -> str:
        return f"MACC({self.groups},{self.reads},{self.drops})"

    @property
    def differences(self) -> int:
        """Of neighbouring groups."""
        return self.groups - 1

    @property
    def frames(self) -> int:
        """From the reset to the last read."""
        return ramps.frames(self.groups, self.reads, self.drops)

    @property
    def integrated(self) -> int:
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


def mode_of(scene: Scene) -> Mode:
    """That of the scene's ramp, with as many drops as its exposure time wants; errors as of `mode_for`."""
    return mode_for(scene.ramp, scene.exposure_time_s, scene.section, scene.mission)


def mode_for(kind: str, seconds: float, section: str, mission: MissionConfiguration) -> Mode:
    """How an exposure of a length is read: the mission's mode, with as many drops as it takes.

    kind    : "photometric" or "spectroscopic";  seconds : exposure time
    section : of the camera, "nisp";  mission : the mission database
    Errors  : BadInput where the reads alone take longer, the frames are too many, or no number of drops takes about as
              long
    """
    key = f"{section}.macc.{kind}"
    groups, reads, drops = (int(mission.value(f"{key}.{part}")) for part in ("groups", "reads", "drops"))
    nominal, time = Mode(groups, reads, drops), mission.value(f"{section}.frame_time", "s")
    wanted = seconds / (time * nominal.differences) - reads
    if abs(wanted - drops) < _SAME:
        return nominal
    if round(wanted) < 0:
        least = time * nominal.differences * reads
        raise BadInput(f"exposure time {seconds:g} s: {nominal} takes {least:.4g} s without any drops")
    if round(wanted) > _MOST:
        raise BadInput(f"exposure time {seconds:g} s: {nominal} takes {wanted:.4g} drops, more than {_MOST}")
    found = Mode(groups, reads, round(wanted))
    if abs(seconds / (time * found.integrated) - 1.0) > FRAME_TOLERANCE:
        raise BadInput(
            f"exposure time {seconds:g} s: {found} takes {time * found.integrated:.4g} s, which differs by more than "
            f"{FRAME_TOLERANCE:.0%}"
        )
    return found


def elapsed(kind: str, seconds: float, section: str, mission: MissionConfiguration) -> float:
    """Seconds from the reset to the last read of an exposure of a length; errors as of `mode_for`.

    kind, seconds, section, mission : of `mode_for`
    """
    mode = mode_for(kind, seconds, section, mission)
    return seconds * mode.frames / mode.integrated


def frame_time(scene: Scene) -> float:
    """Seconds from frame to frame: the mission's, where the exposure time is a multiple of it, else near it."""
    return scene.exposure_time_s / mode_of(scene).integrated


def planes(frame: Frame, count: int) -> Frame:
    """A new float32[count, ny, nx] of `apply`: what the frame has, and zeros."""
    out = np.empty((count, *frame.shape[-2:]), np.float32)
    given = frame.reshape(-1, *frame.shape[-2:])
    out[: len(given)], out[len(given) :] = given, 0.0
    return out


def full_signal(scene: Scene, of_charge: float = 0.0, of_signal: float = 0.0) -> float:
    """Electrons that are measured in the integration time of a pixel that is full at the ramp's end.

    of_charge, of_signal : b of N (1 - b N), what is seen of N electrons in a frame, and of those of the signal, 1/e-
    """
    mode, full = mode_of(scene), scene.value("full_well", "electron")
    signal = full * (1.0 - of_charge * full) * mode.integrated / mode.frames
    # Of more than 1 / 2 b is seen what is seen of these.
    signal = min(signal, 0.5 / of_signal) if of_signal > 0.0 else signal
    return signal * (1.0 - of_signal * signal)


def full(frame: Frame, mode: Mode, full_well: float) -> Bool:
    """[ny, nx] pixels of a frame of `apply` that are expected to be full at the ramp's end."""
    light, charge = (frame[0], frame[1]) if frame.ndim == 3 else (frame, 0.0)
    return np.asarray(light * (mode.frames / mode.integrated) + charge >= full_well)


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
    inputs = [np.ascontiguousarray(part, dtype=np.float32).reshape(-1) for part in planes]
    expected, hit, when, bend = inputs + [np.zeros(0, np.float32)] * (4 - len(inputs))
    _accumulate(
        expected,
        hit,
        when,
        bend,
        out.reshape(mode.groups, -1),
        (mode.groups, mode.reads, mode.drops),
        mode.third_moments(),
        (full_well, linear_below),
        (pixel_random.key(rng), pixel_random.key(rng)),
    )
    return out


@jit
def _accumulate(
    light: Any, charge: Any, moment: Any, bend: Any, out: Any, shape: Any, cumulants: Any, limits: Any, keys: Any
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
        hit = charge[p] if len(charge) > 0 else 0.0
        b = bend[p] if len(bend) > 0 else 0.0
        end = f * frames
        if hit != 0.0 or end > linear_below or end + 10.0 * math.sqrt(end) > full_well:
            when = int(moment[p] * frames) if len(charge) > 0 else 0
            _every_frame(f, hit, when, shape, full_well, b, keys[1], p, group)
        else:
            for i in range(groups + 1):
                e[i] = pixel_random.normal(pixel_random.word(keys[0], p + i * size))
            _vector(f, shape, cumulants, e, group)
            for i in range(groups):
                group[i] -= b * f * f * squares[i]
        for i in range(groups):
            out[i, p] = group[i]


@jit
def _vector(f: float, shape: Any, cumulants: Any, e: Any, group: Any) -> None:
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
            part = mixed / v_t * (v_g / v_s) * (mixed / v_s)
            # sqrt(1 - part) - 1, without the difference.
            shift += total * (-part / (1.0 + math.sqrt(1.0 - part)))
            shift += mixed / v_s * (square - (n * a - v_t / n))
    group[0] = 0.5 * f * (r + 1.0) + c1 * e[0] + math.sqrt(max(v - c1 * c1, 0.0)) * e[groups]
    for i in range(n):
        group[i + 1] += group[i] + f * (r + drops) + shift / n


@jit
def _every_frame(
    f: float, hit: float, when: int, shape: Any, full_well: float, bend: float, key: Any, pixel: int, group: Any
) -> None:
    """Groups of a pixel, a count a frame."""
    groups, reads, drops = shape
    frames = groups * reads + (groups - 1) * drops
    none = math.exp(-f) if f < poisson._SUMMED_BELOW else 0.0
    held = 0.0
    for i in range(groups):
        group[i] = 0.0
    for k in range(frames):
        held += poisson.counted(f, none, pixel_random.word(key, pixel * frames + k))
        if k == when:
            held += hit
        held = min(held, full_well)
        i = k // (reads + drops)
        if k - i * (reads + drops) < reads:
            group[i] += held * (1.0 - bend * held) / reads


def _parameters(scene: Scene) -> tuple[Mode, float]:
    return mode_of(scene), scene.value("full_well", "electron")


EFFECT = Effect("ramp", apply, _parameters, poisson.EFFECT.contribution, optional=False, cost=8e-2, repeated=nothing)
