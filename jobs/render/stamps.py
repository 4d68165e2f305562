"""Drawing sources: each on its own stamp, through its own PSF, in Fourier space, summed onto a frame.

A stamp's image is the inverse transform of profile(k) PSF(k) pixel(k) on the stamp's own k grid. A galaxy's light
that belongs outside its stamp comes in at the opposite edge. What of it reaches the middle is taken off and drawn where
it belongs, as are the PSF's wings beyond the stamp (wings.py); the rest stays at the edge, where it is below the noise,
and where a PSF that has no planes leaves all of its wings (transfer.py).
A stamp is large enough that all that comes in is below a part of the flux in the source's aperture. A galaxy that the
largest does not hold has its outer light from real space (outskirts.py). Nothing is lost, nothing is rescaled. A source
whose stamp lies beside the frame sends in what is drawn beyond its stamp.

Sources         what is drawn: galaxies (with a shape) and points
settings_for, seconds_for   what an accuracy takes, from the measured table
stamp_sizes     pixels, from flux, shape, PSF, noise and settings
reach, least_electrons   how far a source may show, and what it takes to show there
shone_on        sources that `draw` puts light of onto a frame
draw            sources -> frame
shining         points that do so beyond their stamps;  reaches : and how far
work, seconds, memory    what it goes through, and takes
reference       one source by galsim's own drawImage: what `draw` is held against
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from typing import Any

import galsim
import numpy as np
import numpy.typing as npt
import scipy.fft

from jobs import accuracy
from jobs.accuracy import Accuracy
from jobs.render import edges, kernel, outskirts, pictures, profiles, selection, sersic, transfer, wings
from jobs.render.effects.effect import NOTICEABLE
from jobs.render.pictures import Picture
from jobs.render.profiles import Forms, Shapes
from jobs.render.psf import SIDE, Psf
from jobs.render.transfer import Transfer

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Array = npt.NDArray[Any]

# Sides whose transforms are fast; the last bounds memory (its planes have 134 MB).
SIZES = np.array(
    [32, 40, 48, 56, 64, 72, 80, 96, 112, 128, 160, 192, 256, 320, 384, 512, 640, 768, 1024, 1280, 1536, 2048]
)
# Light that wraps is counted in this aperture about the source: radius, arcsec.
_APERTURE = 1.0
# A source's light a stamp's side away, times this, is what all its periodic images bring to its middle: the sum of
# r^-3 over the square lattice (the PSF's wings), and of the flattest wings of galaxies.
_LATTICE_PSF, _LATTICE_GALAXY = 9.03, 6.0
# Logarithmic slope of the light that wraps from which on its response to shear is what counts, not its flux; and the
# ratio of radii between which the slope is taken.
_RESPONSE, _SLOPE_RATIO = 3.0, 1.05
# Of a galaxy's half-light radius, that its stamp is wider than a point's.
_EXTENT = 4.0
# Axis ratio of the thinnest sources: discs of the scale height profiles.py draws, seen edge-on.
_THINNEST = 0.1
# Above this many electrons the rounding of single precision would show; and where no pixel may miss more than this of a
# source's flux.
_BRIGHT, _ROUNDING = 1e7, 2.5e-8
# In Fourier space such sources are followed to so many times what may be left out of them: at the most three
# thousandths of what is cut off ring (seeing of two pixels).
_RINGS = 1e2
# Larger stamps are followed no farther than others.
_DEEP = 1024
# Larger stamps collapse the PSF's planes first: their planes would not fit into memory.
_SHARED = 512
# For fewer than this a plane the planes are not worth their transforms.
_FEW = 0.5
# Bytes while drawing, measured, of what is drawn to the PSF's last frequency: of a frame's pixel (integers and result),
# of a pixel of the largest stamp (its plane and transforms) in single and double precision, and where it is followed
# farther, of a source (its form and
# weights), of all else (planes of the small stamps).
_FRAME_BYTES, _STAMP_BYTES, _DOUBLE_BYTES, _DEEP_BYTES, _SOURCE_BYTES, _OTHER_BYTES = 16, 160, 190, 470, 900, 40_000_000
# The same of a pixel of the largest stamp of a picture.
_PICTURE_BYTES = 370
# CPU s while drawing, measured (2.5 GHz, one core): of a pixel of a stamp, of a plane of the PSF on a stamp's grid and
# of the frame; of a block that a galaxy's light beyond its stamp may reach; of all else.
_STAMP_S, _PLANE_S, _FRAME_S, _BLOCK_S, _START_S = 2.0e-8, 2.3e-7, 1.1e-8, 1.5e-8, 0.01
# A trail is drawn in pieces no longer than this, pixels, each on a stamp of its own.
_PIECE = 64.0
# Of a galaxy's light, what may stay where it comes in at the stamp's edges: about what single precision sums to.
_STRAY = 2e-6
# Of a galaxy's light, what may lie nearer than it should, beyond the stamp: a tenth of the 3e-3 that circles about it
# are known to.
_LOST = 3e-4
# Half stamps, and pixels, as far as which it is drawn.
_STEPS, _FARTHEST = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0), 2048.0
# Pixels of stamps that are transformed together.
_BATCH = 1 << 17
# What galsim takes for a point in the reference, arcsec.
_POINT = 1e-6


@dataclass(frozen=True, slots=True)
class Sources:
    """n sources in the order in which they are drawn (ascending id).

    column, row : float64[n] 0-based pixel position
    jacobian    : float64[n, 2, 2] d(u, v) / d(column, row), arcsec
    electrons   : float64[n] expected
    shape       : row of `shapes`, -1 = a point or a picture
    photons     : float64[n, w] fraction of its photons in each sub-band of the PSF; None: flat f_nu
    picture     : row of `pictures`, -1 = no picture; None: there is none
    trail       : float64[n, 2] pixels that a point moves by in the exposure, in the middle of which it is at its
                  position; None: nothing moves
    """

    ids: Int
    column: Float
    row: Float
    jacobian: Float
    electrons: Float
    shape: Int
    shapes: Shapes
    photons: Float | None = None
    picture: Int | None = None
    pictures: tuple[Picture, ...] = ()
    trail: Float | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, chosen: npt.NDArray[np.bool_] | Int) -> Sources:
        """Some of the sources."""
        return Sources(
            self.ids[chosen],
            self.column[chosen],
            self.row[chosen],
            self.jacobian[chosen],
            self.electrons[chosen],
            self.shape[chosen],
            self.shapes,
            None if self.photons is None else self.photons[chosen],
            None if self.picture is None else self.picture[chosen],
            self.pictures,
            None if self.trail is None else self.trail[chosen],
        )

    def picture_of(self, i: int) -> Picture | None:
        """The picture of source i, if it has one."""
        return None if self.picture is None or self.picture[i] < 0 else self.pictures[self.picture[i]]

    def with_moving(self, moving: Sources) -> Sources:
        """These, at rest, and points that move, of later identifiers and the same shapes."""
        names = ("ids", "column", "row", "jacobian", "electrons", "shape")
        both: dict[str, Any] = {n: np.concatenate([getattr(self, n), getattr(moving, n)]) for n in names}
        photons = None if self.photons is None else np.concatenate([self.photons, moving.photons])
        picture = None if self.picture is None else np.concatenate([self.picture, np.full(len(moving), -1)])
        trail = np.concatenate([np.zeros((len(self), 2)), moving.trail])
        return Sources(
            **both, shapes=self.shapes, photons=photons, picture=picture, pictures=self.pictures, trail=trail
        )

    @property
    def length(self) -> Float:
        """Of the trails, pixels."""
        return np.zeros(len(self)) if self.trail is None else np.hypot(*self.trail.T)


@dataclass(frozen=True, slots=True)
class Settings:
    """What decides how much of a source is drawn.

    edge  : largest light at a stamp's edge, of a pixel's noise: the source's own, and of the PSF's spikes there
    ghost : largest part of a source's flux that wraps into its own aperture
    floor : Fourier samples of less than this are left out, 1 at k = 0
    least : smallest side of a stamp, arcsec: what of the PSF a source keeps
    positions : of the PSF on a detector, one of psf.DEGREES
    colours : that the PSF is made of, a divisor of chromatic.PARTS
    """

    edge: float
    ghost: float
    floor: float
    least: float
    positions: int
    colours: int = 8


def settings_for(wanted: Accuracy) -> Settings:
    """The cheapest settings whose measured errors are within an accuracy; BadInput where none are."""
    return of_row(accuracy.row_for(wanted))


def of_row(row: Mapping[str, float]) -> Settings:
    """Settings of a row of the measured table."""
    whole = {name: int(row[name]) for name in ("positions", "colours")}
    return Settings(row["edge"], row["ghost"], row["floor"], row["least"], **whole)


def seconds_for(wanted: Accuracy) -> float:
    """CPU s of the sources of a VIS detector, measured with these settings."""
    return accuracy.row_for(wanted)["seconds"]


def stamp_sizes(
    electrons: Float,
    shape: Int,
    shapes: Shapes,
    psf: Psf,
    noise: float,
    settings: Settings,
    wider: Float | None = None,
) -> Int:
    """Side of each source's stamp, pixels: int64[n], one of SIZES.

    wider : float64[n] pixels that a stamp is wider than a point's: the length of a piece of a trail, a picture's side
    noise : of a pixel, electrons. A cut by noise alone biases faint sources, for what wraps is coherent: the second
            condition holds it to a part of the flux, from the wings of the PSF and of high-n bulges alike
    """
    # The PSF's wings beyond a stamp are those of a point: the larger a galaxy, the farther out that may begin.
    least = np.full(len(shape), float(settings.least))
    body = shape >= 0
    least[body] += _EXTENT * profiles.half_light(shapes)[shape[body]]
    # Of a galaxy the PSF's spikes, as wide as its core, are smeared over its width.
    smeared, core = np.ones(len(shape)), psf.fwhm / psf.pixel_scale
    smeared[body] = core / (core + 2.0 * profiles.half_light(shapes)[shape[body]] / psf.pixel_scale)
    aperture = np.pi * (_APERTURE / psf.pixel_scale) ** 2
    found, left = np.full(len(shape), SIZES[-1]), np.arange(len(shape))
    for size in SIZES[:-1]:
        psf_light = _beyond_the_table(psf, psf.surface, np.array([size // 2, size]))
        (rim,) = _beyond_the_table(psf, psf.rim, np.array([size // 2]))
        psf_edge = psf_light[0] + smeared[left] * (rim - psf_light[0])
        light, body = np.zeros((len(left), 3)), shape[left] >= 0
        if body.any():
            at = np.array([size // 2, size, _SLOPE_RATIO * size]) * psf.pixel_scale
            light[body] = profiles.surface(shapes.take(shape[left[body]]), at) * psf.pixel_scale**2
        edge, near, far = light.T
        steepness = np.log(np.maximum(near, 1e-300) / np.maximum(far, 1e-300))
        # What shear makes of the light that wraps goes with how steeply it falls.
        steeper = np.maximum(steepness / (_RESPONSE * np.log(_SLOPE_RATIO)), 1.0)
        # A PSF in planes is cut to the stamp and does not wrap.
        wings = _LATTICE_PSF * psf_light[1] * (psf.planes is None)
        wrapped = (wings + _LATTICE_GALAXY * steeper * near) * aperture
        enough = (electrons[left] * (psf_edge + edge) < settings.edge * noise) & (wrapped < settings.ghost)
        enough &= size * psf.pixel_scale >= least[left]
        # A point has no light beyond the PSF's planes.
        enough |= ~body & (psf.planes is not None) & (size >= SIDE)
        found[left[enough]] = size
        left = left[~enough]
    if wider is None:
        return np.asarray(found)
    return np.asarray(SIZES[np.minimum(np.searchsorted(SIZES, found + wider), len(SIZES) - 1)])


def reach(pixel_scale: float) -> float:
    """How far from a source it may shine, arcsec: beyond the corners of the largest stamp. So far sources are read."""
    return _FARTHEST * pixel_scale


def least_electrons(distance: float, pixel_scale: float, noise: float, settings: Settings) -> float:
    """Electrons of which a source must have more to show at a distance, arcsec, from its middle.

    No profile rises outward: at its edge an ellipse is no brighter than all of the light spread over it.
    Error : of a source thinner than 1 : 10, the edge-on disc, what shows may be left out
    """
    pixels = np.pi * _THINNEST * (distance / pixel_scale) ** 2
    return float(settings.edge * noise * pixels)


def _beyond_the_table(psf: Psf, light: Float, radius: Int) -> Float:
    """psf.surface or psf.rim at any radius, pixels: wings of r^-3 beyond the table, nothing beyond planes."""
    last = len(light) - 1
    wing = light[np.minimum(radius, last)] * (np.minimum(radius, last) / radius) ** 3
    return np.where((radius < SIDE) | (psf.planes is None), wing, 0.0)


def floors(electrons: Float, noise: float, settings: Settings) -> Float:
    """Per source, the Fourier samples that `draw` may leave out: of its flux, and in the noise."""
    return np.minimum(settings.floor, settings.edge * noise / np.maximum(electrons, 1e-30))


def draw(
    sources: Sources,
    sizes: Int,
    psf: Psf,
    nx: int,
    ny: int,
    progress: Callable[[int], None] | None = None,
    floors: Float | None = None,
    drawn: Float | None = None,
    unread: tuple[int, int] = (0, 0),
) -> Float:
    """Expected electrons of the sources alone.

    sizes    : int[n] from stamp_sizes;  floors : float[n] from `floors`, None: nothing is left out
    progress : called now and then with the number of sources drawn
    drawn    : float64[n] to be filled with what of each source's stamp fell onto the frame, electrons
    unread   : of the frame, the first row that counts for nothing in `drawn`, and the first behind that counts again
    returns  : float64[ny, nx], to half a unit of `kernel.units_of` a source (5e-7 electrons for all but the brightest);
               the same, bit by bit, in any order of the sources
    """
    pieces, trail, whole = _in_pieces(sources)
    of_piece = np.zeros(len(pieces))
    some_floors = None if floors is None else floors[whole]
    frame = _draw(pieces, trail, whole, sizes[whole], psf, nx, ny, progress, some_floors, of_piece, unread)
    if drawn is not None:
        drawn[:] = np.bincount(whole, of_piece, len(sources))
    return frame


def piece_length(length: Float) -> Float:
    """Of the pieces that trails [n] of a length are drawn in, pixels."""
    return np.asarray(length / piece_count(length))


def piece_count(length: Float) -> Int:
    """How many they are [n]."""
    return np.maximum(np.ceil(length / _PIECE), 1.0).astype(np.int64)


def _in_pieces(sources: Sources) -> tuple[Sources, Float, Int]:
    """(what is drawn: each piece of a trail as a source [p], its own trail [p, 2] pixels, whose piece it is [p])."""
    if sources.trail is None:
        return sources, np.zeros((len(sources), 2)), np.arange(len(sources))
    count = piece_count(sources.length)
    whole = np.repeat(np.arange(len(sources)), count)
    number = np.arange(len(whole)) - np.repeat(np.cumsum(count) - count, count)
    # From the middle of the trail to that of the piece, in lengths of the trail.
    along = (number + 0.5) / count[whole] - 0.5
    trail = sources.trail[whole]
    pieces = replace(
        sources.take(whole),
        column=sources.column[whole] + along * trail[:, 0],
        row=sources.row[whole] + along * trail[:, 1],
        electrons=sources.electrons[whole] / count[whole],
        trail=None,
    )
    return pieces, trail / count[whole, None], whole


def _draw(
    sources: Sources,
    trail: Float,
    whole: Int,
    sizes: Int,
    psf: Psf,
    nx: int,
    ny: int,
    progress: Callable[[int], None] | None,
    floors: Float | None,
    drawn: Float,
    unread: tuple[int, int],
) -> Float:
    frame, unit = np.zeros((ny, nx), np.int64), kernel.units_of(sources.electrons)
    weights = transfer.basis_weights(psf, sources.photons, sources.column, sources.row)
    some, form = _forms(sources)
    bodies, table = (*_bodies(sources, some, form), trail), sersic.table()
    stray, farthest, most = _strays(sources, some, form, sizes, psf.pixel_scale)
    x0, y0 = (np.rint(position).astype(np.int64) - sizes // 2 for position in (sources.column, sources.row))
    curve = kernel.returning(sizes, sources.column - x0, sources.row - y0, stray, most)
    # Of stamps that are not drawn, what would come in: 5 % from what would be taken off, 0.1 % of many together.
    taken = curve[:, -1].copy()
    passing = transfer.passing(psf)
    left_out = np.zeros(len(sources)) if floors is None else floors
    body, fraction, bulge, disk, _, row, *_ = bodies
    bodied = body, fraction, bulge, disk, table, row
    cut = kernel.reaches(passing, transfer.STEP, *bodied, left_out)
    reach = transfer.STEP * len(passing)
    deep = _ringing(cut, sources.electrons, sizes, left_out, psf, bodied)
    far = shining(sources.electrons, sizes, sources.shape, sources.picture, psf)
    largest = _largest(sources.shape, sizes)

    def star(parts: Int) -> dict[str, Any]:
        # A point at rest, or pieces of one trail.
        electrons, first = float(sources.electrons[parts].sum()), parts[0]
        return {
            "column": float(sources.column[parts].mean()), "row": float(sources.row[parts].mean()),
            "electrons": electrons, "photons": None if sources.photons is None else sources.photons[first],
            "size": SIDE, "least": left_out[first] * electrons, "edges": psf.edges, "trail": trail[parts].sum(axis=0),
        }  # fmt: skip

    def of_largest(i: int) -> outskirts.Outskirts:
        return _outskirts(sources, i, some, form, psf, weights, nx, ny)

    def add_outskirts(i: int, of: outskirts.Outskirts) -> None:
        hole, place = (int(x0[i]), int(y0[i]), int(sizes[i])), (float(sources.column[i]), float(sources.row[i]))
        drawn[i] += outskirts.add(of, frame, *place, hole, unread, unit) / unit

    here, precise = selection.touching(sources.column, sources.row, sizes, nx, ny), _precise(sources, floors)
    done = int(np.sum(~here))
    for size in np.unique(sizes):
        alone, together = (found[here[found]] for found in _split(sources, sizes, psf, int(size), precise))
        shared = transfer.transfer(psf, int(size), reach) if len(together) else None
        own = transfer.grid(int(size), float(cut[alone].max()) if size > SIDE else reach) if len(alone) else None
        batch = max(_BATCH // int(size) ** 2, 2)
        groups = [together[i : i + batch] for i in range(0, len(together), batch)]
        for number, chosen in enumerate([*groups, *alone[:, None]]):
            if own is not None and number >= len(groups):
                dtype = np.float64 if precise[chosen[0]] else np.float32
                seen = transfer.grid(int(size), float(cut[chosen[0]])) if deep[chosen[0]] else own
                passed = transfer.collapsed(psf, weights[chosen[0]], seen, dtype, bool(far[chosen[0]]))
                if (picture := sources.picture_of(int(chosen[0]))) is not None:
                    passed = pictures.through(passed, picture, sources.jacobian[chosen[0]])
                share = np.ones((1, 1), dtype)
            elif shared is not None:
                passed, share = shared, weights[chosen].astype(np.float32)
            finish = partial(edges.unfold, **star(chosen)) if far[chosen[0]] else None
            outer = of_largest(int(chosen[0])) if largest[chosen[0]] else None
            if outer is not None:
                finish = partial(_finish_largest, sources, int(chosen[0]), outer)
            added = _draw_some(
                frame, sources, chosen, passed, share, bodies, table, cut, curve, taken, finish, unread, unit
            )
            drawn[chosen] = added / unit
            if outer is not None:
                add_outskirts(int(chosen[0]), outer)
            done += len(chosen)
            if progress is not None:
                progress(done)
    for i in np.flatnonzero(largest & ~here).tolist():
        add_outskirts(i, of_largest(i))
    bright = np.flatnonzero(far)
    for trailing in np.split(bright, np.flatnonzero(np.diff(whole[bright])) + 1) if len(bright) else []:
        edges.add(frame, **star(trailing), unit=unit)
    layer = wings.wings(sources.column, sources.row, sources.electrons, sizes, psf, nx, ny, unit)
    layer += wings.galaxies(sources.column, sources.row, stray, taken, farthest, sizes, nx, ny, unit)
    return np.asarray(kernel.electrons_of(frame, unit, layer, wings.BLOCK, wings.MARGIN))


def _ringing(
    cut: Float, electrons: Float, sizes: Int, left_out: Float, psf: Psf, bodied: tuple[Array, ...]
) -> npt.NDArray[np.bool_]:
    """[n] True of sources that are followed so far, in `cut`, that what is cut off behind is not seen to ring.

    A hard edge in Fourier space rings by up to three thousandths of what it cuts off. Planes end by themselves.
    left_out : of `floors`, what may be left out of a source, 0 = as of others;  bodied : arguments of kernel.reaches
    """
    floor = np.where(left_out > 0.0, np.clip(_RINGS * left_out, transfer.LEAST, transfer.NOTHING), transfer.NOTHING)
    deep = (electrons > _BRIGHT) & (floor < transfer.NOTHING) & (psf.planes is None)
    some = np.flatnonzero(deep)
    if len(some):
        farther = transfer.passing(psf, float(floor[some].min()))
        body, fraction, bulge, disk, table, row = bodied
        own = body[some], fraction[some], bulge[some], disk[some], table, row[some]
        found = kernel.reaches(farther, transfer.STEP, *own, floor[some])
        # What memory holds: the largest stamps are followed as far as any.
        found[sizes[some] > _DEEP] = np.minimum(found[sizes[some] > _DEEP], transfer.HIGHEST)
        cut[some] = np.maximum(cut[some], found)
    return deep


def shone_on(
    column: Float, row: Float, electrons: Float, sizes: Int, shape: Int, shapes: Shapes, picture: Int | None, psf: Psf,
    noise: float, nx: int, ny: int,
) -> npt.NDArray[np.bool_]:  # fmt: skip
    """[n] True of sources at rest of which light may be noticed on the frame: their stamps', or what is drawn beyond.

    column .. picture : as of Sources;  noise : of a pixel, electrons
    """
    wide = reaches(electrons, sizes, shape, picture, psf, noise)
    largest = _largest(shape, sizes)
    farthest = outskirts.reach(
        electrons[largest], shapes.take(shape[largest]), psf.pixel_scale, noise, 0.5 * SIZES[-1] * psf.pixel_scale
    )
    wide[largest] = np.ceil(2.0 * farthest / psf.pixel_scale).astype(np.int64)
    here = selection.touching(column, row, wide, nx, ny)
    # What else of a galaxy may be seen there is looked at closer.
    most = 2.0 * np.minimum(_STEPS[-1] * sizes / 2, _FARTHEST)
    more = np.flatnonzero(~here & (shape >= 0) & ~largest)
    more = more[selection.touching(column[more], row[more], wings.around(most[more]), nx, ny)]
    beyond, _ = _beyond_stamps(shapes.take(shape[more]), sizes[more], psf.pixel_scale)
    here[more] = (beyond > 0) & selection.touching(column[more], row[more], wings.around(2.0 * beyond), nx, ny)
    return here


def shining(electrons: Float, sizes: Int, shape: Int, picture: Int | None, psf: Psf) -> npt.NDArray[np.bool_]:
    """[n] True of points so bright that their light does not end where the PSF's plane does: `draw` takes it on."""
    point = shape < 0 if picture is None else (shape < 0) & (picture < 0)
    return np.asarray(point & (sizes >= SIDE) & (electrons > _BRIGHT) & (psf.edges is not None))


def reaches(
    electrons: Float,
    sizes: Int,
    shape: Int,
    picture: Int | None,
    psf: Psf,
    noise: float,
    length: Float | None = None,
) -> Int:
    """Sides of the squares about sources outside which none of their light is noticed, pixels: int64[n].

    Of stamps, and of the PSF's wings beyond them; about points that shine beyond these all that is read of the sky
    around (`reach`), and for their spikes more: to where no pixel has a tenth of its noise. Of a galaxy's own light
    beyond its stamp `shone_on` knows.
    length : float64[n] of trails, pixels;  noise : of a pixel, electrons
    """
    length = np.zeros(len(sizes)) if length is None else length
    pieces = piece_count(length)
    sides = np.maximum(sizes, 0.0 if psf.planes is None else 2.0 * wings.MARGIN * wings.BLOCK)
    far = shining(electrons / pieces, sizes, shape, picture, psf)
    if psf.edges is not None and far.any():
        spikes = edges.reach(psf.edges, electrons[far], NOTICEABLE * noise)
        sides[far] = 2.0 * np.maximum(spikes, reach(1.0))
    return np.ceil(sides + length).astype(np.int64)


def _largest(shape: Int, sizes: Int) -> npt.NDArray[np.bool_]:
    """[n] True of galaxies that no stamp holds."""
    return np.asarray((shape >= 0) & (sizes >= SIZES[-1]))


def _outskirts(
    sources: Sources, i: int, shapes: Shapes, form: Forms, psf: Psf, weights: Float, nx: int, ny: int
) -> outskirts.Outskirts:
    """Of galaxy i; shapes, form : of the sources that have one;  weights : of `transfer.basis_weights`."""
    own = np.array([np.count_nonzero(sources.shape[:i] >= 0)])
    x, y = sources.column[i], sources.row[i]
    # The corners of the stamps about its own, and of the frame.
    farthest = max(1.5 * SIZES[-1] + 1.0, x, nx - x, y, ny - y)
    one = Forms(*(getattr(form, part.name)[own] for part in fields(Forms)))
    return outskirts.of_galaxy(shapes.take(own), one, float(sources.electrons[i]), psf, weights[i], farthest)


def _finish_largest(
    sources: Sources, i: int, outer: outskirts.Outskirts, stamp: Array, left: int, low: int, *_: int
) -> None:
    """Takes off galaxy i's stamp, whose first pixel is (left, low) of the frame, what came in at its edges."""
    outskirts.take_in(outer, stamp, float(sources.column[i]) - left, float(sources.row[i]) - low)


def _precise(sources: Sources, floors: Float | None) -> npt.NDArray[np.bool_]:
    """[n] True of those that are drawn in double precision; floors : of `draw`."""
    wanted = np.zeros(len(sources), bool) if floors is None else floors < _ROUNDING
    return np.asarray(wanted | (sources.electrons > _BRIGHT))


def _split(sources: Sources, sizes: Int, psf: Psf, size: int, precise: npt.NDArray[np.bool_]) -> tuple[Int, Int]:
    """Sources of a size that are drawn each through a PSF of its own, and those that share planes."""
    of_size = sizes == size
    few = psf.planes is not None and (size > _SHARED or of_size.sum() < _FEW * transfer.plane_count(psf))
    pictured = np.zeros(len(sources), bool) if sources.picture is None else sources.picture >= 0
    alone = of_size & (few | precise | pictured | _largest(sources.shape, sizes))
    return np.flatnonzero(alone), np.flatnonzero(of_size & ~alone)


def work(sources: Sources, sizes: Int, psf: Psf) -> tuple[int, int]:
    """(pixels of stamps, samples' places of the PSF's planes) that `draw` goes through, before anything is drawn."""
    planes, transformed = transfer.plane_count(psf), 0
    for size in np.unique(sizes).tolist():
        alone, together = _split(sources, sizes, psf, size, _precise(sources, None))
        transformed += size**2 * (len(alone) + planes * (len(together) > 0))
    return int((sizes.astype(np.int64) ** 2).sum()), transformed


def seconds(sources: Sources, sizes: Int, psf: Psf, nx: int, ny: int) -> float:
    """CPU s that `draw` takes, predicted from the sources and their stamps.

    Error : between half and twice of what the machine takes that it was measured on
    """
    pieces, trail, whole = _in_pieces(sources)
    sizes = sizes[whole]
    here, body = selection.touching(pieces.column, pieces.row, sizes, nx, ny), pieces.shape >= 0
    pixels, transformed = work(pieces.take(here), sizes[here], psf)
    reach, _ = _beyond_stamps(pieces.shapes.take(pieces.shape[body]), sizes[body], psf.pixel_scale)
    blocks = float(((2 * reach / wings.BLOCK) ** 2).sum())
    far = shining(pieces.electrons, sizes, pieces.shape, pieces.picture, psf)
    shone = edges.seconds(sources.length[np.unique(whole[far])], nx, ny)
    shone += edges.unfold_seconds(np.hypot(*trail[here & far].T), sizes[here & far])
    largest = _largest(pieces.shape, sizes)
    shone += outskirts.FRAME_S * nx * ny * float(largest.sum())
    shone += outskirts.STAMP_S * float(SIZES[-1]) ** 2 * float((largest & here).sum())
    return _STAMP_S * pixels + _PLANE_S * transformed + _BLOCK_S * blocks + shone + _FRAME_S * nx * ny + _START_S


def memory(electrons: Float, sizes: Int, nx: int, ny: int, picture: Int | None = None) -> float:
    """Bytes that `draw` takes at its peak on top of its arguments, predicted from the stamps alone.

    picture : of Sources
    Error : the peak is between a third of it and all of it: what is faint is not followed to the last frequency
    """
    bright = electrons > _BRIGHT
    pictured = np.zeros(len(sizes), bool) if picture is None else picture >= 0
    largest = [
        of * float(sizes[chosen].max(initial=0)) ** 2
        for of, chosen in (
            (_STAMP_BYTES, ~bright),
            (_DOUBLE_BYTES, bright),
            (_DEEP_BYTES, bright & (sizes <= _DEEP)),
            (_PICTURE_BYTES, pictured),
        )
    ]
    return _FRAME_BYTES * nx * ny + max(largest) + _SOURCE_BYTES * len(sizes) + _OTHER_BYTES


def _draw_some(
    frame: Int,
    sources: Sources,
    chosen: Int,
    passed: Transfer,
    weights: Array,
    bodies: tuple[Array, ...],
    table: Array,
    cut: Float,
    curve: Float,
    taken: Float,
    finish: Callable[..., None] | None,
    unread: tuple[int, int],
    unit: float,
) -> Int:
    """Stamps of one size through one set of planes, onto the frame; returns what `accumulate` does.

    bodies, cut, curve : arrays by source: of `_bodies` and trails; of kernel.reaches; of kernel.returning
    taken : filled at the chosen with what kernel.take_off took;  finish : what is still done to a stamp of one source
    """
    size = passed.grid.size
    column, row = sources.column[chosen], sources.row[chosen]
    x0, y0 = (np.rint(position).astype(np.int64) - size // 2 for position in (column, row))
    kind = np.complex128 if passed.planes.dtype == np.float64 else np.complex64
    zones = np.empty((len(chosen), size, size // 2 + 1), kind)
    some = passed.grid
    kernel.nyquist_zones(
        zones, passed.planes, some.kx, some.ky, some.runs, some.pieces, some.inner, weights, column - x0, row - y0,
        sources.electrons[chosen], cut[chosen], table, *(part[chosen] for part in bodies),
    )  # fmt: skip
    stamps = scipy.fft.irfft2(zones, s=(size, size), overwrite_x=True)
    off = np.zeros(len(chosen))
    kernel.take_off(stamps, column - x0, row - y0, curve[chosen], off)
    taken[chosen] = off
    if finish is not None:
        finish(stamps[0], int(x0[0]), int(y0[0]), frame.shape[1], frame.shape[0])
    return kernel.accumulate(frame, stamps, x0, y0, unread, unit)


def _forms(sources: Sources) -> tuple[Shapes, Forms]:
    """Shapes and forms of the sources that have a shape."""
    body = sources.shape >= 0
    shapes = sources.shapes.take(sources.shape[body])
    return shapes, profiles.forms(shapes, sources.jacobian[body])


def _bodies(sources: Sources, shapes: Shapes, form: Forms) -> tuple[Array, ...]:
    """The kernel's arguments of each source's profile: body, fraction, bulge, disk, thick, row, row_weights."""
    n, body = len(sources), sources.shape >= 0
    fraction, row, row_weights = np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 4))
    bulge, disk, thick = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2))
    fraction[body] = shapes.bulge_fraction
    bulge[body], disk[body], thick[body] = form.bulge, form.disk, form.thick
    row[body], row_weights[body] = sersic.row_of(shapes.sersic_index)
    return body, fraction, bulge, disk, thick, row, row_weights


def _strays(
    sources: Sources, shapes: Shapes, form: Forms, sizes: Int, pixel_scale: float
) -> tuple[Float, Float, Float]:
    """Of sources [n], what leaves their stamps.

    returns : ([n, 11] profiles.on_the_sky of a source's electrons, 0 where nothing leaves its stamp; [n] how far,
              pixels: until no more than _LOST of the light lies farther out; [n] electrons at most)
    """
    body = sources.shape >= 0
    stray, far, most = np.zeros((len(sources), 11)), np.zeros(len(sources)), np.zeros(len(sources))
    far[body], leaves = _beyond_stamps(shapes, sizes[body], pixel_scale)
    # The largest have outskirts.
    far[_largest(sources.shape, sizes)] = 0.0
    sky = profiles.on_the_sky(shapes, form)
    sky[:, [kernel.BULGE, kernel.DISK]] *= np.where(far[body] > 0, sources.electrons[body], 0.0)[:, None]
    stray[body] = sky
    most[body] = leaves * sources.electrons[body]
    return stray, far, most


def _beyond_stamps(shapes: Shapes, sizes: Int, pixel_scale: float) -> tuple[Float, Float]:
    """Of galaxies [n], (how far their light is drawn, pixels, 0 where none is beyond its stamp; the part of it there).

    Until no more than _LOST of the light lies farther out.
    """
    half = sizes / 2
    leaves = profiles.outside(shapes, half * pixel_scale)
    far, left = np.full(len(half), _STEPS[0]), np.flatnonzero(leaves > _LOST)
    for step, next_one in pairwise(_STEPS):
        left = left[profiles.outside(shapes.take(left), half[left] * step * pixel_scale) > _LOST]
        far[left] = next_one
    far = np.maximum(np.minimum(half * far, _FARTHEST), _STEPS[0] * half)
    return np.where(leaves > _STRAY, far, 0.0), leaves


def reference(sources: Sources, i: int, psf: Psf, size: int, folding: float = 1e-4, highest: float = 1e-4) -> Float:
    """Source i by galsim.Convolve and drawImage, tight thresholds: slow, with none of `draw`'s transforms.

    folding, highest : galsim's folding_threshold and maxk_threshold; what is cut at 1e-4 shows as 3e-3 of the noise in
                        the middle of bright discs
    returns : float64[size, size], lower left pixel at round(position) - size / 2
    """
    settings = galsim.GSParams(
        folding_threshold=folding, maxk_threshold=highest, kvalue_accuracy=1e-7, maximum_fft_size=16384
    )
    weights = transfer.basis_weights(psf, sources.photons, sources.column, sources.row)[i]
    pixel = [] if psf.intra_pixel is None else [galsim.Pixel(1.0)]
    parts = [transfer.profile_of(psf, weights).dilate(1.0 / psf.pixel_scale), *pixel]
    picture = sources.picture_of(i)
    if sources.shape[i] >= 0 or picture is not None:
        profile = _of(picture) if picture else profiles.profile(sources.shapes, int(sources.shape[i]), _POINT)
        # World frame, arcsec -> pixels, the flux kept.
        parts.append(galsim.JacobianWCS(*sources.jacobian[i].ravel()).toImage(profile))
    whole = galsim.Convolve(parts, gsparams=settings) * float(sources.electrons[i])
    x0, y0 = (int(np.rint(position[i])) - size // 2 for position in (sources.column, sources.row))
    centre = galsim.PositionD(sources.column[i] - x0, sources.row[i] - y0)
    image = galsim.ImageD(galsim.BoundsI(0, size - 1, 0, size - 1), scale=1.0)
    whole.drawImage(image, center=centre, method="no_pixel")
    return np.asarray(image.array)


def _of(picture: Picture) -> galsim.GSObject:
    """A picture as galsim interpolates it, world frame (u to the west), flux 1."""
    image = galsim.Image(np.ascontiguousarray(picture.image[:, ::-1], float), scale=picture.scale)
    # Padded more than by default: the transform is as good as the reference should be.
    return galsim.InterpolatedImage(image, x_interpolant="quintic", pad_factor=8.0)
