"""Draw sources on stamps in Fourier space, each with its PSF, and add them to a frame.

The image of a stamp is the inverse transform of profile(k) PSF(k) pixel(k) on the k grid of the stamp. Light of a
galaxy outside its stamp is aliased to the opposite edge. The part that reaches the middle is removed and drawn at its
correct position, as are the PSF's wings beyond the stamp (wings.py). The rest stays at the edge, where it is below the
noise. A PSF without planes leaves all of its wings there (transfer.py).

A stamp is large enough that all aliased light is below a given fraction of the flux in the source's aperture. For a
galaxy that exceeds the largest stamp, the outer light is drawn in real space (outskirts.py). No light is lost and no
light is rescaled. A source whose stamp lies outside the frame contributes the light drawn beyond its stamp.
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

# Bright sources are followed in Fourier space down to this multiple of their neglected flux, since at most 0.3 % of the
# part that is cut off rings (for seeing of two pixels).
_RINGS = 1e2
# Largest side of the stamps of sources that are followed beyond the default frequency, pixels.
DEEP = 1024
# Stamps with larger sides sum the PSF's planes for each source, since all planes would not fit into memory.
_SHARED = 512
# With fewer sources per plane than this, transforming all planes takes longer than summing them for each source.
_FEW = 0.5
# Number of stamp pixels that are transformed together.
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
    """Draw the expected electrons of sources, without sky.

    Parameters
    ----------
    sources : Sources
        Sources to be drawn.
    sizes : int array, shape (n,)
        Sides of their stamps from `stamp_sizes`, pixels.
    psf : Psf
        PSF of the detector.
    nx, ny : int
        Columns and rows of the detector.
    progress : callable, optional
        Called repeatedly with the number of sources drawn.
    neglected : float array, shape (n,), optional
        Fourier samples that may be neglected, from `neglected_flux`; None to neglect nothing.
    tally : Tally, optional
        Filled with the light of each source's stamp on the frame.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons, rounded per source to half a unit of `fourier.units_of` (5e-7 electrons for all but the brightest
        sources). The result does not depend on the order of the sources.
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
    """Light of each source's stamp that falls onto the frame.

    Attributes
    ----------
    electrons : float array, shape (n,)
        Filled by `draw`.
    unread_rows : (int, int)
        First row of the frame that is not counted, and the row after the last.
    """

    electrons: Float
    unread_rows: tuple[int, int] = (0, 0)


def split_into_pieces(sources: Sources) -> tuple[Sources, Float, Int]:
    """Split trails into pieces, and structured discs into the smooth source and the structure.

    Parameters
    ----------
    sources : Sources
        n sources.

    Returns
    -------
    (Sources, float array, int array)
        The p pieces as sources; the trail of each piece [p, 2], pixels; the number of its source [p].
    """
    structured = np.flatnonzero(sources.has_structure)
    if len(structured):
        return _split_with_structure(sources, structured)
    if sources.trail is None:
        return sources, np.zeros((len(sources), 2)), np.arange(len(sources))
    count = stamp_sizes.piece_count(sources.trail_length)
    parent = np.repeat(np.arange(len(sources)), count)
    number = np.arange(len(parent)) - np.repeat(np.cumsum(count) - count, count)
    # Offset from the middle of the trail to that of the piece, in lengths of the trail.
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
    """Net electrons of each piece [p]; 0 for the structure of a disc."""
    if pieces.picture is None or not any(picture.is_structure for picture in pieces.pictures):
        return pieces.electrons
    is_structure = np.array([*(picture.is_structure for picture in pieces.pictures), False])
    return np.asarray(np.where(is_structure[pieces.picture], 0.0, pieces.electrons))


def _split_with_structure(sources: Sources, structured: Int) -> tuple[Sources, Float, Int]:
    """Result of `split_into_pieces` if discs have a structure: first the smooth sources, then the structures."""
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
    """Properties of the pieces [p] that are computed before drawing.

    Attributes
    ----------
    sources : Sources
        The pieces.
    trail : float array, shape (p, 2)
        Displacement of each piece, pixels.
    parent : int array, shape (p,)
        Number of its source.
    sizes : int array, shape (p,)
        Sides of the stamps, pixels.
    psf : Psf
        PSF of the detector.
    weights : float array, shape (p, planes)
        Weights of `transfer.basis_weights`.
    shapes, form : Shapes, Forms
        Shapes and forms of the pieces that have a shape.
    profile_arguments, table : array
        Arguments of the kernel for each profile, and the table of Sersic transforms.
    cut : float array, shape (p,)
        Frequency up to which each piece is followed, radian / pixel.
    deep : bool array, shape (p,)
        True for pieces that are followed beyond the default frequency.
    reach : float
        Default frequency, radian / pixel.
    left_out : float array, shape (p,)
        Fourier samples that may be neglected.
    outside : wings.OutsideLight
        Light of galaxies that is drawn beyond their stamps; `_draw_batch` stores the removed light in it.
    curve : float array, shape (p, 5)
        Result of `kernels.frame.aliased_light`.
    has_far_light : bool array, shape (p,)
        True for points that shine beyond the PSF's planes.
    largest : bool array, shape (p,)
        True for galaxies that are larger than the largest stamp.
    unit : float
        Units of the frame per electron.
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
        """Star for a point at rest, or for the pieces of one trail."""
        sources, first = self.sources, parts[0]
        electrons = float(sources.electrons[parts].sum())
        photons = None if sources.photons is None else sources.photons[first]
        return far_light.Star(
            float(sources.column[parts].mean()), float(sources.row[parts].mean()), electrons,
            photons, self.psf.side, self.left_out[first] * electrons,
            self.psf.edges, self.trail[parts].sum(axis=0),
        )  # fmt: skip

    def outskirts(self, i: int, nx: int, ny: int) -> outskirts.Outskirts:
        """Outskirts of galaxy `i`."""
        sources = self.sources
        shape_row = np.array([np.count_nonzero(sources.shape[:i] >= 0)])
        x, y = sources.column[i], sources.row[i]
        # Distance to the corners of the neighbouring stamps and of the frame.
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
        # For stamps that are not drawn, the aliased light approximates the removed light: to 5 % for single sources,
        # and to 0.1 % for many together.
        outside=wings.OutsideLight(profile, curve[:, -1].copy(), farthest),
        curve=curve,
        has_far_light=stamp_sizes.has_far_light(sources.electrons, sizes, sources.shape, sources.picture, psf),
        largest=stamp_sizes.on_largest(sources.shape, sizes),
        unit=fourier.units_of(sources.electrons),
    )


def _batches(prepared: _PreparedSources, on_frame: Bool, precise: Bool) -> Iterator[tuple[Int, Transfer, Array]]:
    """Yield (pieces of one stamp size, planes of their PSF, weights [n, planes]) for the stamps on the frame.

    Pieces of the mask `precise` are drawn in double precision.
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
    """Add the light of galaxy `i` outside its stamp to the frame, and return its electrons there."""
    place, size = (float(prepared.sources.column[i]), float(prepared.sources.row[i])), int(prepared.sizes[i])
    x_first, y_first = (int(np.rint(at)) - size // 2 for at in place)
    return float(
        outskirts.add(light, frame, *place, (x_first, y_first, size), unread_rows, prepared.unit) / prepared.unit
    )


def _draw_light_beyond_stamps(
    prepared: _PreparedSources, on_frame: Bool, frame: Int, fallen: Float, unread_rows: tuple[int, int]
) -> None:
    """Draw galaxies whose stamps are outside the frame, and points beyond the PSF's planes.

    Electrons of these galaxies on the frame are added to `fallen` [p].
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
    """Extend `cut` for bright sources until ringing is not noticeable, and return the mask [n] of these sources.

    A sharp edge in Fourier space rings by up to 0.3 % of the part that is cut off. Planes have a last frequency. In
    `left_out`, 0 stands for the default limit. `reach_arguments` are arguments of `fourier.fourier_reach`.
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
        # The limited memory does not allow a larger reach for the largest stamps.
        new_reach[sizes[indices] > DEEP] = np.minimum(new_reach[sizes[indices] > DEEP], transfer.HIGHEST)
        cut[indices] = np.maximum(cut[indices], new_reach)
    return deep


def in_double_precision(sources: Sources, neglected: Float | None) -> Bool:
    """Mask [n] of the sources that are drawn in double precision; `neglected` is the argument of `draw`."""
    is_precise = np.zeros(len(sources), bool) if neglected is None else neglected < ROUNDING
    return np.asarray(is_precise | (sources.electrons > BRIGHT))


def split_by_size(sources: Sources, sizes: Int, psf: Psf, size: int, precise: Bool) -> tuple[Int, Int]:
    """Find sources of one stamp size that have individual PSFs, and sources that share the PSF's planes.

    Parameters
    ----------
    sources : Sources
        n sources.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    psf : Psf
        PSF of the detector.
    size : int
        Side of the selected stamps, pixels.
    precise : bool array, shape (n,)
        True for sources that are drawn in double precision.

    Returns
    -------
    (int array, int array)
        Indices of sources with individual PSFs, and of sources that share planes.
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
    """Draw stamps of one size with one set of planes onto the frame, and return each source's electrons there."""
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
    # Sources with outskirts or far light are alone in their batch; their aliased light is removed here.
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
    """Arguments of the kernel for each profile: body, fraction, bulge, disk, thick, row, row_weights."""
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
    """Light of sources [n] outside their stamps.

    Returns the profiles [n, 11] of `galaxy_shapes.real_space_profile`, in electrons and 0 if no light leaves the stamp;
    the distances [n] up to which the light is drawn, pixels; and upper limits [n] of the light, electrons.
    """
    body = sources.shape >= 0
    profile, light_reach, max_electrons = np.zeros((len(sources), 11)), np.zeros(len(sources)), np.zeros(len(sources))
    light_reach[body], outside_fraction = stamp_sizes.light_beyond_stamps(shapes, sizes[body], pixel_scale)
    # The outer light of the largest galaxies is drawn by outskirts.py.
    light_reach[stamp_sizes.on_largest(sources.shape, sizes)] = 0.0
    sky = galaxy_shapes.real_space_profile(shapes, form)
    sky[:, [BULGE, DISK]] *= np.where(light_reach[body] > 0, sources.electrons[body], 0.0)[:, None]
    profile[body] = sky
    max_electrons[body] = outside_fraction * sources.electrons[body]
    return profile, light_reach, max_electrons
