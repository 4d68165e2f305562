"""Drawing sources: each on its own stamp, through its own PSF, in Fourier space, summed onto a frame.

A stamp's image is the inverse transform of profile(k) PSF(k) pixel(k) on the stamp's own k grid. A galaxy's light
that belongs outside its stamp comes in at the opposite edge. What of it reaches the middle is taken off and drawn where
it belongs, as are the PSF's wings beyond the stamp (wings.py); the rest stays at the edge, where it is below the noise,
and where a PSF that has no planes leaves all of its wings (transfer.py).
A stamp is large enough that all that comes in is below a part of the flux in the source's aperture. A galaxy that the
largest does not hold has its outer light from real space (outskirts.py). Nothing is lost, nothing is rescaled. A source
whose stamp lies beside the frame sends in what is drawn beyond its stamp.

draw            sources -> frame
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.fft

from jobs.render.drawing import arcs, far_light, outskirts, stamp_sizes, transfer, wings
from jobs.render.drawing.kernels import fourier
from jobs.render.drawing.kernels.frame import BULGE, DISK, accumulate, electrons_of, returning, take_off
from jobs.render.drawing.stamp_sizes import BRIGHT, ROUNDING, SIZES
from jobs.render.drawing.transfer import Transfer
from jobs.render.psf.model import SIDE, Psf
from jobs.render.sources import galaxy_shapes, selection, sersic
from jobs.render.sources.galaxy_shapes import Forms, Shapes
from jobs.render.sources.source_list import Sources
from lake_schema.arrays import Array, Float, Int

# In Fourier space such sources are followed to so many times what may be left out of them: at the most three
# thousandths of what is cut off ring (seeing of two pixels).
_RINGS = 1e2
# Larger stamps are followed no farther than others.
DEEP = 1024
# Larger stamps collapse the PSF's planes first: their planes would not fit into memory.
_SHARED = 512
# For fewer than this a plane the planes are not worth their transforms.
_FEW = 0.5
# Pixels of stamps that are transformed together.
_BATCH = 1 << 17


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
    pieces, trail, whole = in_pieces(sources)
    of_piece = np.zeros(len(pieces))
    some_floors = None if floors is None else floors[whole]
    frame = _draw(pieces, trail, whole, sizes[whole], psf, nx, ny, progress, some_floors, of_piece, unread)
    if drawn is not None:
        drawn[:] = np.bincount(whole, of_piece, len(sources))
    return frame


def in_pieces(sources: Sources) -> tuple[Sources, Float, Int]:
    """(what is drawn: each piece of a trail as a source [p], its own trail [p, 2] pixels, whose piece it is [p])."""
    if sources.trail is None:
        return sources, np.zeros((len(sources), 2)), np.arange(len(sources))
    count = stamp_sizes.piece_count(sources.length)
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
    frame, unit = np.zeros((ny, nx), np.int64), fourier.units_of(sources.electrons)
    weights = transfer.basis_weights(psf, sources.photons, sources.column, sources.row)
    some, form = _forms(sources)
    bodies, table = (*_bodies(sources, some, form), trail), sersic.table()
    stray, farthest, most = _strays(sources, some, form, sizes, psf.pixel_scale)
    x0, y0 = (np.rint(position).astype(np.int64) - sizes // 2 for position in (sources.column, sources.row))
    curve = returning(sizes, sources.column - x0, sources.row - y0, stray, most)
    # Of stamps that are not drawn, what would come in: 5 % from what would be taken off, 0.1 % of many together.
    taken = curve[:, -1].copy()
    passing = transfer.passing(psf)
    left_out = np.zeros(len(sources)) if floors is None else floors
    body, fraction, bulge, disk, _, row, *_ = bodies
    bodied = body, fraction, bulge, disk, table, row
    cut = fourier.reaches(passing, transfer.STEP, *bodied, left_out)
    reach = transfer.STEP * len(passing)
    deep = _ringing(cut, sources.electrons, sizes, left_out, psf, bodied)
    far = stamp_sizes.shining(sources.electrons, sizes, sources.shape, sources.picture, psf)
    largest = stamp_sizes.on_largest(sources.shape, sizes)

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

    here, precise = selection.touching(sources.column, sources.row, sizes, nx, ny), in_double_precision(sources, floors)
    done = int(np.sum(~here))
    for size in np.unique(sizes):
        alone, together = (found[here[found]] for found in split_by_size(sources, sizes, psf, int(size), precise))
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
                    passed = arcs.through(passed, picture, sources.jacobian[chosen[0]])
                share = np.ones((1, 1), dtype)
            elif shared is not None:
                passed, share = shared, weights[chosen].astype(np.float32)
            finish = partial(far_light.unfold, **star(chosen)) if far[chosen[0]] else None
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
        far_light.add(frame, **star(trailing), unit=unit)
    layer = wings.wings(sources.column, sources.row, sources.electrons, sizes, psf, nx, ny, unit)
    layer += wings.galaxies(sources.column, sources.row, stray, taken, farthest, sizes, nx, ny, unit)
    return np.asarray(electrons_of(frame, unit, layer, wings.BLOCK, wings.MARGIN))


def _ringing(
    cut: Float, electrons: Float, sizes: Int, left_out: Float, psf: Psf, bodied: tuple[Array, ...]
) -> npt.NDArray[np.bool_]:
    """[n] True of sources that are followed so far, in `cut`, that what is cut off behind is not seen to ring.

    A hard edge in Fourier space rings by up to three thousandths of what it cuts off. Planes end by themselves.
    left_out : of `floors`, what may be left out of a source, 0 = as of others;  bodied : arguments of kernel.reaches
    """
    floor = np.where(left_out > 0.0, np.clip(_RINGS * left_out, transfer.LEAST, transfer.NOTHING), transfer.NOTHING)
    deep = (electrons > BRIGHT) & (floor < transfer.NOTHING) & (psf.planes is None)
    some = np.flatnonzero(deep)
    if len(some):
        farther = transfer.passing(psf, float(floor[some].min()))
        body, fraction, bulge, disk, table, row = bodied
        own = body[some], fraction[some], bulge[some], disk[some], table, row[some]
        found = fourier.reaches(farther, transfer.STEP, *own, floor[some])
        # What memory holds: the largest stamps are followed as far as any.
        found[sizes[some] > DEEP] = np.minimum(found[sizes[some] > DEEP], transfer.HIGHEST)
        cut[some] = np.maximum(cut[some], found)
    return deep


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


def in_double_precision(sources: Sources, floors: Float | None) -> npt.NDArray[np.bool_]:
    """[n] True of those that are drawn in double precision; floors : of `draw`."""
    wanted = np.zeros(len(sources), bool) if floors is None else floors < ROUNDING
    return np.asarray(wanted | (sources.electrons > BRIGHT))


def split_by_size(sources: Sources, sizes: Int, psf: Psf, size: int, precise: npt.NDArray[np.bool_]) -> tuple[Int, Int]:
    """Sources of a size that are drawn each through a PSF of its own, and those that share planes."""
    of_size = sizes == size
    few = psf.planes is not None and (size > _SHARED or of_size.sum() < _FEW * transfer.plane_count(psf))
    pictured = np.zeros(len(sources), bool) if sources.picture is None else sources.picture >= 0
    alone = of_size & (few | precise | pictured | stamp_sizes.on_largest(sources.shape, sizes))
    return np.flatnonzero(alone), np.flatnonzero(of_size & ~alone)


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
    fourier.nyquist_zones(
        zones, passed.planes, some.kx, some.ky, some.runs, some.pieces, some.inner, weights, column - x0, row - y0,
        sources.electrons[chosen], cut[chosen], table, *(part[chosen] for part in bodies),
    )  # fmt: skip
    stamps = scipy.fft.irfft2(zones, s=(size, size), overwrite_x=True)
    off = np.zeros(len(chosen))
    take_off(stamps, column - x0, row - y0, curve[chosen], off)
    taken[chosen] = off
    if finish is not None:
        finish(stamps[0], int(x0[0]), int(y0[0]), frame.shape[1], frame.shape[0])
    return accumulate(frame, stamps, x0, y0, unread, unit)


def _forms(sources: Sources) -> tuple[Shapes, Forms]:
    """Shapes and forms of the sources that have a shape."""
    body = sources.shape >= 0
    shapes = sources.shapes.take(sources.shape[body])
    return shapes, galaxy_shapes.forms(shapes, sources.jacobian[body])


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
    far[body], leaves = stamp_sizes.beyond_stamps(shapes, sizes[body], pixel_scale)
    # The largest have outskirts.
    far[stamp_sizes.on_largest(sources.shape, sizes)] = 0.0
    sky = galaxy_shapes.on_the_sky(shapes, form)
    sky[:, [BULGE, DISK]] *= np.where(far[body] > 0, sources.electrons[body], 0.0)[:, None]
    stray[body] = sky
    most[body] = leaves * sources.electrons[body]
    return stray, far, most
