"""Drawing sources: each on its own stamp, through its own PSF, in Fourier space, summed onto a frame.

A stamp's image is the inverse transform of profile(k) PSF(k) pixel(k) on the stamp's own k grid. A galaxy's light
that belongs outside its stamp comes in at the opposite edge. What of it reaches the middle is taken off and drawn where
it belongs, as are the PSF's wings beyond the stamp (wings.py); the rest stays at the edge, where it is below the noise,
and where a PSF that has no planes leaves all of its wings (transfer.py).
A stamp is large enough that all that comes in is below a part of the flux in the source's aperture. A galaxy that the
largest does not hold has its outer light from real space (outskirts.py). Nothing is lost, nothing is rescaled. A source
whose stamp lies beside the frame sends in what is drawn beyond its stamp.

draw            sources -> frame;  Tally : with what each brought
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.fft

from lake_schema.arrays import Array, Bool, Float, Int
from truesky.render.drawing import arcs, far_light, outskirts, stamp_sizes, transfer, wings
from truesky.render.drawing.kernels import fourier
from truesky.render.drawing.kernels.frame import BULGE, DISK, accumulate, aliased_light, subtract_aliased, to_electrons
from truesky.render.drawing.stamp_sizes import BRIGHT, ROUNDING, SIZES
from truesky.render.drawing.transfer import Transfer
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes, selection, sersic
from truesky.render.sources.galaxy_shapes import Forms, Shapes
from truesky.render.sources.source_list import Sources

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
    neglected: Float | None = None,
    tally: Tally | None = None,
) -> Float:
    """Expected electrons of the sources alone.

    sizes    : int[n] from stamp_sizes;  neglected : float[n] from `neglected_flux`, None: nothing is left out
    progress : called now and then with the number of sources drawn
    tally    : to be filled with what of each source's stamp fell onto the frame
    sources  : to be drawn;  psf : of the detector;  nx, ny : its pixels
    returns  : float64[ny, nx], to half a unit of fourier.units_of a source (5e-7 electrons for all but the brightest);
               the same, bit by bit, in any order of the sources
    """
    pieces, trail, parent = split_into_pieces(sources)
    piece_neglected = None if neglected is None else neglected[parent]
    prepared = _prepare(pieces, trail, parent, sizes[parent], psf, piece_neglected)
    frame, fallen = np.zeros((ny, nx), np.int64), np.zeros(len(pieces))
    unread_rows = (0, 0) if tally is None else tally.unread_rows
    on_frame = selection.overlaps_frame(pieces.column, pieces.row, prepared.sizes, nx, ny)
    done = int(np.sum(~on_frame))
    for chosen, psf_transfer, share in _batches(prepared, on_frame, in_double_precision(pieces, piece_neglected)):
        fallen[chosen] = _draw_batch(prepared, chosen, psf_transfer, share, frame, unread_rows)
        done += len(chosen)
        if progress is not None:
            progress(done)
    _draw_light_beyond_stamps(prepared, on_frame, frame, fallen, unread_rows)
    if tally is not None:
        tally.electrons[:] = np.bincount(parent, fallen, len(sources))
    layer = wings.wings(pieces.column, pieces.row, _net_electrons(pieces), prepared.sizes, psf, nx, ny, prepared.unit)
    layer += wings.galaxies(pieces.column, pieces.row, prepared.outside, prepared.sizes, nx, ny, prepared.unit)
    return np.asarray(to_electrons(frame, prepared.unit, layer, wings.BLOCK, wings.MARGIN))


@dataclass(frozen=True, slots=True)
class Tally:
    """What of each source's stamp fell onto the frame.

    electrons : float64[n], filled by `draw`
    unread    : of the frame, the first row that does not count, and the first behind that counts again
    """

    electrons: Float
    unread_rows: tuple[int, int] = (0, 0)


def split_into_pieces(sources: Sources) -> tuple[Sources, Float, Int]:
    """(what is drawn: each piece of a trail as a source [p], its own trail [p, 2] pixels, whose piece it is [p]).

    The structure of a disc is a piece besides.
    """
    structured = np.flatnonzero(sources.has_structure)
    if len(structured):
        return _split_with_structure(sources, structured)
    if sources.trail is None:
        return sources, np.zeros((len(sources), 2)), np.arange(len(sources))
    count = stamp_sizes.piece_count(sources.trail_length)
    parent = np.repeat(np.arange(len(sources)), count)
    number = np.arange(len(parent)) - np.repeat(np.cumsum(count) - count, count)
    # From the middle of the trail to that of the piece, in lengths of the trail.
    along = (number + 0.5) / count[parent] - 0.5
    trail = sources.trail[parent]
    pieces = replace(
        sources.take(parent),
        column=sources.column[parent] + along * trail[:, 0],
        row=sources.row[parent] + along * trail[:, 1],
        electrons=sources.electrons[parent] / count[parent],
        trail=None,
    )
    return pieces, trail / count[parent, None], parent


def _net_electrons(pieces: Sources) -> Float:
    """[p] electrons that each brings: a disc's structure none, in the sum."""
    if pieces.picture is None or not any(picture.is_structure for picture in pieces.pictures):
        return pieces.electrons
    is_structure = np.array([*(picture.is_structure for picture in pieces.pictures), False])
    return np.asarray(np.where(is_structure[pieces.picture], 0.0, pieces.electrons))


def _split_with_structure(sources: Sources, structured: Int) -> tuple[Sources, Float, Int]:
    """`in_pieces` where some discs [m] have a structure: the sources without, then it, of the light of the discs."""
    assert sources.picture is not None
    bare = sources.picture.copy()
    bare[structured] = -1
    smooth, trail, parent = split_into_pieces(replace(sources, picture=bare))
    structured_sources, at_rest = sources.take(structured), np.zeros((len(structured), 2))
    light = structured_sources.electrons * (1.0 - sources.shapes.bulge_fraction[structured_sources.shape])
    discs = replace(structured_sources, electrons=light, shape=np.full(len(structured_sources), -1), trail=at_rest)
    pieces = replace(
        smooth.with_moving(discs), picture=np.append(bare[parent], sources.picture[structured]), trail=None
    )
    return pieces, np.concatenate([trail, at_rest]), np.append(parent, structured)


@dataclass(frozen=True, slots=True)
class _PreparedSources:
    """What is known of the pieces [p] before any is drawn.

    trail, whole   : [p, 2] pixels that each moves by, whose piece it is;  sizes : of their stamps
    weights        : [p, planes] of transfer.basis_weights
    shapes, form   : of those that have a shape;  bodies, table : the kernel's arguments for each profile
    cut, deep, reach : how far each is followed in Fourier space, whether farther than others, how far others are
    left_out       : Fourier samples that may be left out of each
    outside        : light of galaxies that is drawn beyond their stamps, of which `_draw_some` tells what was taken off
    curve          : of kernels.frame.aliased_light
    far, largest   : points that shine beyond the PSF's planes, galaxies that no stamp holds
    unit           : of the frame's integers to an electron
    """

    sources: Sources
    trail: Float
    parent: Int
    sizes: Int
    psf: Psf
    weights: Float
    shapes: Shapes
    form: Forms
    profile_arguments: tuple[Array, ...]
    table: Array
    cut: Float
    deep: Bool
    reach: float
    left_out: Float
    outside: wings.OutsideLight
    curve: Float
    has_far_light: Bool
    largest: Bool
    unit: float

    def star(self, parts: Int) -> far_light.Star:
        """A point at rest, or pieces of one trail."""
        sources, first = self.sources, parts[0]
        electrons = float(sources.electrons[parts].sum())
        photons = None if sources.photons is None else sources.photons[first]
        return far_light.Star(
            float(sources.column[parts].mean()), float(sources.row[parts].mean()), electrons,
            photons, self.psf.side, self.left_out[first] * electrons,
            self.psf.edges, self.trail[parts].sum(axis=0),
        )  # fmt: skip

    def outskirts(self, i: int, nx: int, ny: int) -> outskirts.Outskirts:
        """Of galaxy i."""
        sources = self.sources
        shape_row = np.array([np.count_nonzero(sources.shape[:i] >= 0)])
        x, y = sources.column[i], sources.row[i]
        # The corners of the stamps about its own, and of the frame.
        farthest = max(1.5 * SIZES[-1] + 1.0, x, nx - x, y, ny - y)
        galaxy_form = Forms(*(getattr(self.form, part.name)[shape_row] for part in fields(Forms)))
        light = float(sources.electrons[i])
        return outskirts.from_galaxy(
            self.shapes.take(shape_row), galaxy_form, light, self.psf, self.weights[i], farthest
        )


def _prepare(
    sources: Sources, trail: Float, parent: Int, sizes: Int, psf: Psf, neglected: Float | None
) -> _PreparedSources:
    shapes, form = _forms(sources)
    profile_arguments, table = (*_profile_arguments(sources, shapes, form), trail), sersic.table()
    profile, farthest, max_electrons = _light_outside(sources, shapes, form, sizes, psf.pixel_scale)
    x0, y0 = (np.rint(position).astype(np.int64) - sizes // 2 for position in (sources.column, sources.row))
    curve = aliased_light(sizes, sources.column - x0, sources.row - y0, profile, max_electrons)
    max_transfer = transfer.max_transfer(psf)
    left_out = np.zeros(len(sources)) if neglected is None else neglected
    body, fraction, bulge, disk, _, row, *_ = profile_arguments
    reach_arguments = body, fraction, bulge, disk, table, row
    cut = fourier.fourier_reach(max_transfer, transfer.STEP, *reach_arguments, transfer.neglect_factor(psf) * left_out)
    return _PreparedSources(
        sources,
        trail,
        parent,
        sizes,
        psf,
        transfer.basis_weights(psf, sources.photons, sources.column, sources.row),
        shapes,
        form,
        profile_arguments,
        table,
        cut,
        deep=_extend_reach(cut, sources.electrons, sizes, left_out, psf, reach_arguments),
        reach=transfer.STEP * len(max_transfer),
        left_out=left_out,
        # Of stamps that are not drawn, what would come in: 5 % from what would be taken off, 0.1 % of many together.
        outside=wings.OutsideLight(profile, curve[:, -1].copy(), farthest),
        curve=curve,
        has_far_light=stamp_sizes.has_far_light(sources.electrons, sizes, sources.shape, sources.picture, psf),
        largest=stamp_sizes.on_largest(sources.shape, sizes),
        unit=fourier.units_of(sources.electrons),
    )


def _batches(prepared: _PreparedSources, on_frame: Bool, precise: Bool) -> Iterator[tuple[Int, Transfer, Array]]:
    """(sources of one size, the PSF's planes that they go through, their shares [n, planes]) of those on the frame.

    precise : those that are drawn in double precision
    """
    sources, psf = prepared.sources, prepared.psf
    for size in np.unique(prepared.sizes).tolist():
        individual, sharing = (
            indices[on_frame[indices]] for indices in split_by_size(sources, prepared.sizes, psf, size, precise)
        )
        if len(sharing):
            shared, batch = transfer.transfer(psf, size, prepared.reach), max(_BATCH // size**2, 2)
            for i in range(0, len(sharing), batch):
                chosen = sharing[i : i + batch]
                yield chosen, shared, prepared.weights[chosen].astype(np.float32)
        if len(individual):
            default_grid = transfer.grid(
                size, float(prepared.cut[individual].max()) if size > psf.side else prepared.reach
            )
        for i in individual.tolist():
            dtype = np.float64 if precise[i] else np.float32
            source_grid = transfer.grid(size, float(prepared.cut[i])) if prepared.deep[i] else default_grid
            psf_transfer = transfer.source_transfer(
                psf, prepared.weights[i], source_grid, dtype, bool(prepared.has_far_light[i])
            )
            if (picture := sources.picture_of(i)) is not None:
                psf_transfer = arcs.apply_picture(psf_transfer, picture, sources.jacobian[i])
            yield np.array([i]), psf_transfer, np.ones((1, 1), dtype)


def _add_outskirts(
    prepared: _PreparedSources, i: int, light: outskirts.Outskirts, frame: Int, unread_rows: tuple[int, int]
) -> float:
    """What galaxy i has outside its stamp, onto the frame; returns the electrons that fell there."""
    place, size = (float(prepared.sources.column[i]), float(prepared.sources.row[i])), int(prepared.sizes[i])
    x_first, y_first = (int(np.rint(at)) - size // 2 for at in place)
    return float(
        outskirts.add(light, frame, *place, (x_first, y_first, size), unread_rows, prepared.unit) / prepared.unit
    )


def _draw_light_beyond_stamps(
    prepared: _PreparedSources, on_frame: Bool, frame: Int, fallen: Float, unread_rows: tuple[int, int]
) -> None:
    """What galaxies have outside stamps that are not `here`, and points beyond the PSF's planes.

    fallen : float64[p] electrons on the frame, to which the galaxies' are added
    """
    ny, nx = frame.shape
    for i in np.flatnonzero(prepared.largest & ~on_frame).tolist():
        fallen[i] += _add_outskirts(prepared, i, prepared.outskirts(i, nx, ny), frame, unread_rows)
    bright = np.flatnonzero(prepared.has_far_light)
    for trailing in np.split(bright, np.flatnonzero(np.diff(prepared.parent[bright])) + 1) if len(bright) else []:
        far_light.add(frame, prepared.star(trailing), prepared.unit)


def _extend_reach(
    cut: Float, electrons: Float, sizes: Int, left_out: Float, psf: Psf, reach_arguments: tuple[Array, ...]
) -> Bool:
    """[n] True of sources that are followed so far, in `cut`, that what is cut off behind is not seen to ring.

    A hard edge in Fourier space rings by up to three thousandths of what it cuts off. Planes end by themselves.
    left_out : of `neglected_flux`, what may be left out of a source, 0 = as of others
    bodied   : arguments of fourier.reaches
    """
    floor = np.where(
        left_out > 0.0, np.clip(_RINGS * left_out, transfer.NEGLIGIBLE_DOUBLE, transfer.NEGLIGIBLE), transfer.NEGLIGIBLE
    )
    deep = (electrons > BRIGHT) & (floor < transfer.NEGLIGIBLE) & (psf.planes is None)
    indices = np.flatnonzero(deep)
    if len(indices):
        max_transfer = transfer.max_transfer(psf, float(floor[indices].min()))
        body, fraction, bulge, disk, table, row = reach_arguments
        arguments = body[indices], fraction[indices], bulge[indices], disk[indices], table, row[indices]
        new_reach = fourier.fourier_reach(max_transfer, transfer.STEP, *arguments, floor[indices])
        # What memory holds: the largest stamps are followed as far as any.
        new_reach[sizes[indices] > DEEP] = np.minimum(new_reach[sizes[indices] > DEEP], transfer.HIGHEST)
        cut[indices] = np.maximum(cut[indices], new_reach)
    return deep


def in_double_precision(sources: Sources, neglected: Float | None) -> Bool:
    """[n] True of those that are drawn in double precision; neglected : of `draw`."""
    is_precise = np.zeros(len(sources), bool) if neglected is None else neglected < ROUNDING
    return np.asarray(is_precise | (sources.electrons > BRIGHT))


def split_by_size(sources: Sources, sizes: Int, psf: Psf, size: int, precise: Bool) -> tuple[Int, Int]:
    """Sources of a size that are drawn each through a PSF of its own, and those that share planes.

    sources, sizes : n sources and their stamps' sides;  size : of the stamps that are wanted
    psf            : of the detector;  precise : bool[n] drawn in double precision
    """
    of_size = sizes == size
    few = psf.planes is not None and (size > _SHARED or of_size.sum() < _FEW * transfer.plane_count(psf))
    pictured = np.zeros(len(sources), bool) if sources.picture is None else sources.picture >= 0
    individual = of_size & (few | precise | pictured | stamp_sizes.on_largest(sources.shape, sizes))
    return np.flatnonzero(individual), np.flatnonzero(of_size & ~individual)


def _draw_batch(
    prepared: _PreparedSources,
    chosen: Int,
    psf_transfer: Transfer,
    share: Array,
    frame: Int,
    unread_rows: tuple[int, int],
) -> Float:
    """Stamps of one size through one set of planes, onto the frame; returns each source's electrons there."""
    sources, size = prepared.sources, psf_transfer.grid.size
    column, row = sources.column[chosen], sources.row[chosen]
    x0, y0 = (np.rint(position).astype(np.int64) - size // 2 for position in (column, row))
    kind = np.complex128 if psf_transfer.planes.dtype == np.float64 else np.complex64
    zones = np.empty((len(chosen), size, size // 2 + 1), kind)
    grid = psf_transfer.grid
    fourier.nyquist_zones(
        zones,
        psf_transfer.planes,
        grid.kx,
        grid.ky,
        grid.runs,
        grid.pieces,
        grid.inner,
        share,
        column - x0,
        row - y0,
        sources.electrons[chosen],
        prepared.cut[chosen],
        prepared.table,
        *(part[chosen] for part in prepared.profile_arguments),
    )
    stamps = scipy.fft.irfft2(zones, s=(size, size), overwrite_x=True)
    removed = np.zeros(len(chosen))
    subtract_aliased(stamps, column - x0, row - y0, prepared.curve[chosen], removed)
    prepared.outside.electrons[chosen] = removed
    first, stamp_x, stamp_y, (ny, nx) = int(chosen[0]), int(x0[0]), int(y0[0]), frame.shape
    # Of these, which are alone, what comes in at the stamp's edges is taken off.
    outer = prepared.outskirts(first, nx, ny) if prepared.largest[first] else None
    if outer is not None:
        outskirts.remove_aliased(outer, stamps[0], float(column[0]) - stamp_x, float(row[0]) - stamp_y)
    elif prepared.has_far_light[first]:
        far_light.remove_aliased(prepared.star(chosen), stamps[0], stamp_x, stamp_y, nx, ny)
    fallen = accumulate(frame, stamps, x0, y0, unread_rows, prepared.unit) / prepared.unit
    if outer is not None:
        fallen[0] += _add_outskirts(prepared, first, outer, frame, unread_rows)
    return np.asarray(fallen)


def _forms(sources: Sources) -> tuple[Shapes, Forms]:
    """Shapes and forms of the sources that have a shape."""
    body = sources.shape >= 0
    shapes = sources.shapes.take(sources.shape[body])
    return shapes, galaxy_shapes.forms(shapes, sources.jacobian[body])


def _profile_arguments(sources: Sources, shapes: Shapes, form: Forms) -> tuple[Array, ...]:
    """The kernel's arguments of each source's profile: body, fraction, bulge, disk, thick, row, row_weights."""
    n, body = len(sources), sources.shape >= 0
    fraction, row, row_weights = np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 4))
    bulge, disk, thick = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2))
    fraction[body] = shapes.bulge_fraction
    bulge[body], disk[body], thick[body] = form.bulge, form.disk, form.thick
    row[body], row_weights[body] = sersic.interpolation_weights(shapes.sersic_index)
    return body, fraction, bulge, disk, thick, row, row_weights


def _light_outside(
    sources: Sources, shapes: Shapes, form: Forms, sizes: Int, pixel_scale: float
) -> tuple[Float, Float, Float]:
    """Of sources [n], what leaves their stamps.

    returns : ([n, 11] galaxy_shapes.on_the_sky of a source's electrons, 0 where nothing leaves its stamp; [n] how far,
              pixels: until no more than _LOST of the light lies farther out; [n] electrons at most)
    """
    body = sources.shape >= 0
    profile, light_reach, max_electrons = np.zeros((len(sources), 11)), np.zeros(len(sources)), np.zeros(len(sources))
    light_reach[body], outside_fraction = stamp_sizes.light_beyond_stamps(shapes, sizes[body], pixel_scale)
    # The largest have outskirts.
    light_reach[stamp_sizes.on_largest(sources.shape, sizes)] = 0.0
    sky = galaxy_shapes.real_space_profile(shapes, form)
    sky[:, [BULGE, DISK]] *= np.where(light_reach[body] > 0, sources.electrons[body], 0.0)[:, None]
    profile[body] = sky
    max_electrons[body] = outside_fraction * sources.electrons[body]
    return profile, light_reach, max_electrons
