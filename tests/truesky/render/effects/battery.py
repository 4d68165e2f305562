"""Calls of every effect on a small frame, with parameters that act and that do nothing, and the properties to test."""

from dataclasses import dataclass

import numpy as np

from lake_schema.mission.configuration import resolve
from truesky.render.camera.amplifiers import Amplifier, Layout
from truesky.render.camera.sections import Section
from truesky.render.channels import ground, nisp_p, nisp_s, vis
from truesky.render.effects.charge.ramp import Mode
from truesky.render.effects.charge.track_charge import THIN, Spread
from truesky.render.effects.light.ghosts import Order, Pupil
from truesky.render.effects.light.ground_ghosts import Annuli
from truesky.render.effects.light.satellite_trails import Blur, Satellites
from truesky.render.effects.readout.trap_pumping import Pumping
from truesky.render.effects.readout.traps import Sweeps, Traps
from truesky.render.effects.scene import Lights, NeighbourCharge

# Every effect of a channel, by its name.
EFFECTS = {
    e.name: e for channel in (vis, nisp_p, nisp_s, ground) for effects in channel.EFFECTS.values() for e in effects
}
LIGHTS = Lights(np.array([3.2, 40.0]), np.array([2.0, -30.0]), np.array([1e8, 1e9]))
END_OF_LIFE = Traps((0.02, 0.03, 0.95), (0.8, 3.5, 20.0), 2e5, 0.0, 0.58)
EMPTY = Traps((0.0,), (1.0,), 2e5, 0.0, 0.58)
TRACKS = np.array(resolve().numbers("env.cosmic_rays.vis_tracks"))
DUST = (1e-2, 3.0, 0.2)
PUMPING = Pumping(2000, 0.5, 0.5, 1.0, 0.034)
PHOTOMETRIC = Mode(4, 16, 4)
PAIRS = np.full((4, 4), 1e-4) - 1e-4 * np.eye(4)


@dataclass(frozen=True)
class Case:
    """Call of an effect.

    Attributes
    ----------
    name : str
        Name of the effect, and a label of the case after a colon.
    on, off : tuple or callable
        Parameters with which the effect acts, and with which it does nothing (None if it always acts). A callable gets
        the shape of the frame.
    planes : bool
        True if frames have the shape (4, ny, nx) instead of (ny, nx).
    linear : bool
        True if apply(a x) = a apply(x).
    zero : bool
        True if a frame of zeros remains zero.
    conserves : bool
        True if the sum is conserved.
    whole : bool
        True if whole electrons stay whole.
    positive : bool
        True if the result is not negative.
    reshapes : bool
        True if the result has another shape.
    dtype : type
        Type of the result.
    """

    name: str
    on: object
    off: object = None
    planes: bool = False
    linear: bool = False
    zero: bool = True
    conserves: bool = False
    whole: bool = False
    positive: bool = True
    reshapes: bool = False
    dtype: type = np.float64

    @property
    def apply(self):
        return EFFECTS[self.name.partition(":")[0]].apply


def bowl(shape):
    ny, nx = shape[-2:]
    return -0.01 * np.linspace(0, 1, nx), 0.02 * np.linspace(-1, 1, ny)


def flat(shape):
    return tuple(np.zeros(n) for n in shape[::-1])


def stretched(strength):
    return lambda shape: (120.0, *(np.arange(float(n)) for n in shape[:-3:-1]), np.array([[0.0, strength], [0.0, 0.0]]))


def remembering(electrons):
    """Persistence in every other column."""
    return lambda shape: (electrons * np.indices(shape)[1] % 2, 0.3)


def tinted(electrons, even=(0.0, 0.0)):
    return lambda shape: (np.full((2, *shape), electrons, np.float32), np.array(even), 0.1, 0.1)


def beside(electrons):
    """A star in the first pixel of another detector."""
    return lambda shape: (NeighbourCharge(np.array([0]), np.array([electrons])), 1e-4)


def halves(shape):
    """Two amplifiers, of the left and the right half."""
    ny, nx = shape
    sections = [Section(x, 0, nx // 2, ny) for x in (0, nx // 2)]
    return Layout(nx, ny, 2, 3, 1, tuple(Amplifier(str(s.x), s, s.x > 0, False) for s in sections))


def columns(shape):
    """Their pieces: registers at both ends."""
    middle = shape[0] // 2
    return (0, middle, False), (middle, shape[0], True)


# `on` and `off` may depend on the frame's shape.
_CASES = (
    Case("background", (120.0,), (0.0,), zero=False, whole=True),
    Case(
        "ghosts",
        ((Order(LIGHTS, 1e-4, (0.0, 5.0), Pupil(6.0, 0.33, ((2.6, 2.4, 16.8, 3.5), (-3.3, 1.3, -39.9, 3.5)), 0.2)),),),
        ((Order(LIGHTS, 0.0, (0.0, 5.0), Pupil(6.0, 0.33, (), 0.0)),),),
        zero=False,
    ),
    Case(
        "filter_ghosts",
        ((Order(LIGHTS, 1e-4, (0.0, -4.0), Pupil(5.0, 0.33, ((2.6, 2.4, 16.8, 3.5),), 0.2)),),),
        ((Order(LIGHTS, 0.0, (0.0, -4.0), Pupil(5.0, 0.33, (), 0.0)),),),
        zero=False,
    ),
    Case(
        "lens_ghosts",
        (Annuli(*np.array([[3.2, 4.0], [2.0, -3.0], [4.0, 6.0], [20.0, 5.0]])), 0.4),
        (Annuli(*np.zeros((4, 0))), 0.4),
        zero=False,
    ),
    Case("pixel_area", stretched(1e-2), stretched(0.0), zero=False),
    Case("fringes", (120.0, 0.01, 20.0), (120.0, 0.0, 20.0), zero=False, positive=False),
    Case(
        "satellite_trails",
        (Satellites(20.0, 500.0, 0.5), Blur(3.0, 2.0, 1.0), None, 10.0),
        (Satellites(0.0, 500.0, 0.5), Blur(3.0, 2.0, 1.0), None, 10.0),
        zero=False,
    ),
    Case("dispersed_sky", (np.array([[0.0, 3.0, 2.0], [1.0, 20.0, 5.0]]),), (None,), zero=False),
    Case("straylight", (LIGHTS, 5e-4, 40.0), (LIGHTS, 0.0, 40.0), zero=False),
    Case("illumination", bowl, flat, linear=True),
    Case(
        "pixel_response",
        lambda shape: (0.01, (1e-2, 1.0), DUST, columns(shape)),
        lambda shape: (0.0, (0.0, 0.0), (0.0, 3.0, 0.2), columns(shape)),
        linear=True,
    ),
    Case("tree_rings", (0.03, 5.0, 3.0, 9.0), (0.0, 5.0, 3.0, 9.0), linear=True, conserves=True),
    Case("edge_displacement", (0.2, 3.0), (0.0, 3.0), linear=True, conserves=True),
    Case("chromatic_response", tinted(30.0, (-0.4, 0.1)), tinted(0.0), zero=False),
    Case("lamp_response", tinted(-30.0, (0.3, -0.2)), tinted(0.0), zero=False),
    Case("calibration_lamp", lambda shape: (500.0, *bowl(shape)), lambda shape: (0.0, *bowl(shape)), zero=False),
    Case(
        "readout_trail",
        lambda shape: (6e-5, 2, (0.01, (1e-2, 1.0), DUST, columns(shape))),
        (0.0, 2),
        linear=True,
    ),
    Case("poisson", (), None, whole=True),
    Case(
        "brighter_fatter",
        ((1.2e-7, 2e-7), 0.5, 2e5, 0.0, 0),
        ((0.0, 0.0), 0.5, 2e5, 0.0, 0),
        conserves=True,
        whole=True,
    ),
    Case("dark_current", (0.3,), (0.0,), zero=False, whole=True),
    Case("hot_pixels", (0.1, 50.0), (0.0, 50.0), zero=False, whole=True),
    Case("cosmic_rays", (5.0, TRACKS, THIN), (0.0, TRACKS, THIN), zero=False, whole=True),
    Case(
        "cosmic_rays: wide, with an uneven energy loss",
        (5.0, TRACKS, Spread(0.3, 0.2, 3.3)),
        (0.0, TRACKS, Spread(0.3, 0.2, 3.3)),
        zero=False,
        whole=True,
    ),
    Case(
        "readout_cosmic_rays",
        (5.0, TRACKS, (4, 1, 3), END_OF_LIFE, THIN),
        (0.0, TRACKS, (4, 1, 3), END_OF_LIFE, THIN),
        planes=True,
        zero=False,
    ),
    Case(
        "readout_cosmic_rays: silicon without traps",
        (5.0, TRACKS, (4, 1, 3), None, THIN),
        (0.0, TRACKS, (4, 1, 3), None, THIN),
        planes=True,
        zero=False,
        whole=True,
    ),
    Case("charge_injection", (1e4, 2, 2, 0.03), (0.0, 2, 2, 0.03), zero=False, whole=True),
    Case("injection_noise", (2, 2, 10.0), (2, 2, 0.0), zero=False, whole=True),
    Case(
        "trap_pumping",
        lambda shape: (END_OF_LIFE, PUMPING, columns(shape)),
        lambda shape: (EMPTY, PUMPING, columns(shape)),
        conserves=True,
        whole=True,
    ),
    Case("bleeding", lambda shape: (2e5, columns(shape)), lambda shape: (1e300, columns(shape)), whole=True),
    Case("quadrants", (2, 3, 1), None, linear=True, conserves=True, whole=True),
    Case("amplifiers", lambda shape: (halves(shape),), None, linear=True, conserves=True, whole=True),
    Case("parallel_cti", (END_OF_LIFE, Sweeps(1, 2), 3), (EMPTY, Sweeps(1, 2), 3), planes=True),
    Case("serial_cti", (END_OF_LIFE, Sweeps(1, 2), 3), (EMPTY, Sweeps(1, 2), 3), planes=True),
    Case("parallel_loss", (1e-4,), (0.0,), planes=True, linear=True),
    Case("serial_loss", (1e-4,), (0.0,), planes=True, linear=True),
    Case("nonlinearity", (0.05, 2.28e5, 0.01, 2e3), (0.0, 2.28e5, 0.0, 2e3)),
    Case("crosstalk", (PAIRS,), (np.zeros((4, 4)),), planes=True, linear=True),
    Case("detector_crosstalk", beside(1e5), (None, 1e-4), planes=True, zero=False),
    Case("bias_structure", (30.0, -9.0, 40.0, 1.0), (0.0, 0.0, 40.0, 0.0), planes=True, zero=False, positive=False),
    Case("bias_drift", (3.0, 60900.0, 0.25), (0.0, 60900.0, 0.25), planes=True, zero=False, positive=False),
    Case("row_noise", (3.0,), (0.0,), planes=True, zero=False, positive=False),
    Case("read_noise", (4.4,), (0.0,), zero=False, positive=False),
    Case("adc", (3.48, 0.0, 65535.0), None, whole=True),
    # Up the ramp.
    Case("dark_map", (1.7, 0.3, 0.01, 400.0), (0.0, 0.3, 0.0, 400.0), zero=False),
    Case("persistence", remembering(3.0), (None, 0.3), zero=False),
    Case("ramp_cosmic_rays", (5.0, 0.4, 6e3, 0.5), (0.0, 0.4, 6e3, 0.5), zero=False, reshapes=True, dtype=np.float32),
    Case("ramp_nonlinearity", (6e-7, 0.1), None, zero=False, reshapes=True, dtype=np.float32),
    Case("ramp", (PHOTOMETRIC, 1.3e5), None, positive=False, reshapes=True, dtype=np.float32),
    Case("ipc", (6.5e-3, 4e-4), (0.0, 0.0), planes=True, linear=True, conserves=True),
    Case("reset_level", (44.0,), (0.0,), planes=True, zero=False, positive=False),
    Case("group_noise", (13.0, 16), (0.0, 16), planes=True, zero=False, positive=False),
    Case("drift", (5.1,), (0.0,), planes=True, zero=False, positive=False),
    Case("output_gain", (0.01,), (0.0,), planes=True, linear=True),
    Case("macc", (PHOTOMETRIC, 13.0), None, planes=True, zero=False, positive=False, reshapes=True),
    Case("signal_nonlinearity", (6e-7, 0.1), (0.0, 0.1), planes=True),
    Case("signal_adc", (1.92, 1024.0, 65535.0), None, planes=True, zero=False, reshapes=True),
)
CASES = {case.name: case for case in _CASES}
# Effects that split frames.
CUT = ("quadrants", "amplifiers")
# Shapes of frames. Quadrants require even sides.
SHAPES = ((4, 6), (1, 1), (1, 9), (9, 1), (12, 10))


def call(case, frame, off=False, seed=7, **options):
    arguments = case.off if off else case.on
    arguments = arguments(frame.shape) if callable(arguments) else arguments
    return case.apply(frame, *arguments, rng=np.random.default_rng(seed), **options)


def shapes_of(name):
    return [s for s in SHAPES if name not in CUT or not (s[0] % 2 or s[1] % 2)]


def frame_of(case, shape, values):
    """Return a frame with the shape of the case, from values of shape (4 * ny * nx,)."""
    ny, nx = shape
    values = np.asarray(values, float)
    return values[: 4 * ny * nx].reshape(4, ny, nx) if case.planes else values[: ny * nx].reshape(ny, nx)
