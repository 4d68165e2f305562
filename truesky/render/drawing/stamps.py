"""Draw sources on stamps in Fourier space, each with its PSF, and add the stamps to the image of a detector (frame).

A stamp is a square image around one source. It is the inverse transform of profile(k) PSF(k) pixel(k) on a grid of k.
A discrete transform is periodic, so light of a galaxy outside its stamp is aliased to the opposite edge. The aliased
light that reaches the middle is removed and drawn at its correct position. The PSF's wings beyond the stamp are also
drawn at their correct position (wings.py). The remaining aliased light stays at the edge of the stamp, where it is
below the noise. For a PSF that is given as a profile instead of images, all aliased wings are moved to the edge
(transfer.py).

A stamp is large enough that all aliased light is below a given fraction of the flux in the source's aperture. For a
galaxy that exceeds the largest stamp, the outer light is drawn in real space (outskirts.py). No light is lost and no
light is rescaled. A source whose stamp lies outside the frame contributes the light drawn beyond its stamp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy

from lake_schema.arrays import Array, Bool, Float, Int
from truesky.render.drawing import arcs, far_light, outskirts, stamp_sizes, transfer, wings
from truesky.render.drawing.drawn_units import DrawnUnits
from truesky.render.drawing.kernels import fourier
from truesky.render.drawing.kernels.frame import BULGE, DISK, accumulate, aliased_light, subtract_aliased, to_electrons
from truesky.render.drawing.stamp_sizes import BRIGHT, ROUNDING, SIZES
from truesky.render.drawing.transfer import Transfer
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes, selection, sersic
from truesky.render.sources.galaxy_shapes import Forms, Shapes
from truesky.render.sources.source_list import Sources

# The Fourier transform of a bright source is used up to the frequency where it falls below this multiple of the size of
# a Fourier sample that may be neglected. The cut causes ringing in the image, but by at most 0.3 % of the part of the
# transform that is cut off (for a seeing of two pixels).
_RINGS = 1e2
# Largest side of a stamp, pixels, for which bright sources use frequencies above the usual limit.
DEEP = 1024
# On stamps with sides above this number of pixels, the PSF's planes (basis images) are summed before the transform, for
# each source separately. The transforms of all planes would not fit into memory. The choice must not depend on other
# sources, so that a source has the same light when it is drawn alone.
_SHARED = 512
# Largest |k| on stamps that are wider than the stamps of stars, radian / pixel. Only a PSF from a PSFEx file reaches
# higher frequencies. They matter for stars alone, and on large stamps they would need too much memory.
_WIDE_REACH = 5.0 * np.pi
# Number of stamp pixels that one call of the FFT transforms together. At least two stamps are transformed, also if they
# have more pixels.
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
    """Draw the expected electrons of sources on a detector, without sky and noise.

    Parameters
    ----------
    sources : Sources
        Sources to be drawn.
    sizes : int array, shape (n,)
        Sides of the sources' stamps from `stamp_sizes.stamp_sizes`, pixels.
    psf : Psf
        PSF of the detector.
    nx, ny : int
        Number of columns and of rows of the detector.
    progress : callable, optional
        Function that is called after each batch of stamps with the total number of stamps that are done. A moving
        source has several stamps.
    neglected : float array, shape (n,), optional
        Size of the Fourier samples that may be neglected, as a fraction of each source's flux, from
        `stamp_sizes.neglected_flux`. None to use all samples up to the last frequency of the PSF.
    tally : Tally, optional
        Its array `electrons` is filled with the electrons of each source that fall onto the frame.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons. The light of each source in a pixel is rounded to a multiple of 2^-20 = 1e-6 electrons, or
        of a larger power of two with extremely bright sources (`kernels.fourier.units_of`). The sum therefore does not
        depend on the order of the sources.
    """
    drawn = draw_in_units(sources, sizes, psf, (nx, ny), progress, neglected, tally)
    return np.asarray(to_electrons(drawn.frame, drawn.unit, drawn.layer, wings.BLOCK, wings.MARGIN))


def draw_in_units(
    sources: Sources,
    sizes: Int,
    psf: Psf,
    shape: tuple[int, int],
    progress: Callable[[int], None] | None = None,
    neglected: Float | None = None,
    tally: Tally | None = None,
    unit: float | None = None,
) -> DrawnUnits:
    """Draw sources as `draw` does, without the conversion to electrons.

    Parameters
    ----------
    sources : Sources
        Sources to be drawn.
    sizes : int array, shape (n,)
        Sides of the sources' stamps, pixels.
    psf : Psf
        PSF of the detector.
    shape : (int, int)
        Number of columns and of rows of the detector.
    progress, neglected, tally
        As for `draw`.
    unit : float, optional
        Factor from electrons to integers, by default `unit_for` these sources.

    Returns
    -------
    DrawnUnits
        The light in integers.
    """
    nx, ny = shape
    pieces, trail, parent = split_into_pieces(sources)
    piece_neglected = None if neglected is None else neglected[parent]
    prepared = _prepare(pieces, trail, parent, sizes[parent], psf, piece_neglected)
    unit = prepared.unit if unit is None else unit
    prepared = replace(prepared, unit=unit)
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
    return DrawnUnits(frame, layer, unit)


def unit_for(sources: Sources) -> float:
    """Return the factor from electrons to the integers in which the light of sources is summed."""
    return fourier.units_of(split_into_pieces(sources)[0].electrons)


@dataclass(frozen=True, slots=True)
class Tally:
    """Electrons of each of n sources that fall onto the frame (image of the detector), as an output of `draw`.

    Attributes
    ----------
    electrons : float array, shape (n,)
        Electrons of the source's stamps on the frame, filled by `draw`. For a galaxy that is larger than the largest
        stamp, light outside its stamp is included. For other sources it is not.
    unread_rows : (int, int)
        First row that is not counted, because the detector does not read it, and the row after the last of these rows.
        (0, 0) to count all rows.
    """

    electrons: Float
    unread_rows: tuple[int, int] = (0, 0)


def split_into_pieces(sources: Sources) -> tuple[Sources, Float, Int]:
    """Split sources into pieces that are drawn on one stamp each.

    The trail of a moving source is split along its length. A galaxy whose disc has spiral arms and knots is split into
    the smooth galaxy and the structure. All other sources are one piece.

    Parameters
    ----------
    sources : Sources
        n sources.

    Returns
    -------
    (Sources, float array, int array)
        The p pieces as sources; the displacement of each piece during the exposure [p, 2] along columns and rows,
        pixels; the index of the source from which each piece comes [p].
    """
    structured = np.flatnonzero(sources.has_structure)
    if len(structured):
        return _split_with_structure(sources, structured)
    if sources.trail is None:
        return sources, np.zeros((len(sources), 2)), np.arange(len(sources))
    count = stamp_sizes.piece_count(sources.trail_length)
    parent = np.repeat(np.arange(len(sources)), count)
    number = np.arange(len(parent)) - np.repeat(np.cumsum(count) - count, count)
    # Offset from the middle of the trail to the middle of the piece, as a fraction of the trail's length.
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
    """Return the total electrons of each stamp [p]: 0 for the arms and knots of a disc, whose pixels have the sum 0."""
    if pieces.picture is None or not any(picture.is_structure for picture in pieces.pictures):
        return pieces.electrons
    is_structure = np.array([*(picture.is_structure for picture in pieces.pictures), False])
    return np.asarray(np.where(is_structure[pieces.picture], 0.0, pieces.electrons))


def _split_with_structure(sources: Sources, structured: Int) -> tuple[Sources, Float, Int]:
    """Return the result of `split_into_pieces` for sources some of which are discs with spiral arms and knots.

    `structured` [m] are the indices of these galaxies. The smooth sources come first, then the arms and knots.
    """
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
    """Properties of p pieces (sources, or parts of their trails, on one stamp each) that are computed before drawing.

    Attributes
    ----------
    sources : Sources
        The pieces.
    trail : float array, shape (p, 2)
        Displacement of each piece along columns and rows during the exposure, pixels.
    parent : int array, shape (p,)
        Index of the source from which the piece comes.
    sizes : int array, shape (p,)
        Sides of the stamps, pixels.
    psf : Psf
        PSF of the detector.
    weights : float array, shape (p, planes)
        Weights of the PSF's planes (basis images) from `transfer.basis_weights`.
    shapes, form : Shapes, Forms
        Bulge and disc parameters, and sizes and orientations of bulge and disc in pixels, of those pieces that are
        galaxies, in order.
    profile_arguments : tuple of array
        Arrays with one row per piece, from `_profile_arguments` (profiles of bulge and disc), followed by `trail`.
    table : array
        Table of the Fourier transforms of Sersic profiles, from `sersic.table`.
    cut : float array, shape (p,)
        Largest |k| at which the transform of the piece is computed, radian / pixel.
    deep : bool array, shape (p,)
        True for bright pieces whose `cut` may exceed `reach`.
    reach : float
        Largest |k| at which the PSF is not negligible for pieces that are not `deep`, radian / pixel.
    left_out : float array, shape (p,)
        Size of the Fourier samples that may be neglected, as a fraction of the flux.
    outside : wings.OutsideLight
        Light of galaxies that is drawn beyond their stamps. `_draw_batch` stores the electrons that it removed from
        the stamps in it.
    curve : float array, shape (p, 5)
        Light of each galaxy that is aliased onto its stamp (light beyond one edge appears at the opposite edge), as a
        polynomial about the galaxy, from `kernels.frame.aliased_light`.
    has_far_light : bool array, shape (p,)
        True for stars so bright that their light beyond the PSF's planes is drawn.
    largest : bool array, shape (p,)
        True for galaxies that are larger than the largest stamp.
    unit : float
        Factor from electrons to the integers of the frame.
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
        """Return the far_light.Star of a point source; `parts` are the indices of its pieces, which form one trail."""
        sources, first = self.sources, parts[0]
        electrons = float(sources.electrons[parts].sum())
        photons = None if sources.photons is None else sources.photons[first]
        return far_light.Star(
            float(sources.column[parts].mean()), float(sources.row[parts].mean()), electrons,
            photons, self.psf.side, self.left_out[first] * electrons,
            self.psf.edges, self.trail[parts].sum(axis=0),
        )  # fmt: skip

    def outskirts(self, i: int, nx: int, ny: int, with_stamp: bool) -> outskirts.Outskirts:
        """Return the light of galaxy `i` outside its stamp, on a frame of ny x nx pixels.

        With `with_stamp`, it is also returned on the periodic copies of the stamp next to it.
        """
        sources = self.sources
        shape_row = np.array([np.count_nonzero(sources.shape[:i] >= 0)])
        x, y = sources.column[i], sources.row[i]
        region = (-x, nx - x, -y, ny - y)
        if with_stamp:
            # Largest distance along columns or rows: to the corners of the periodic stamps next to the galaxy's stamp,
            # and to the corners of the frame.
            farthest = max(1.5 * SIZES[-1] + 1.0, *map(abs, region))
            region = (-farthest, farthest, -farthest, farthest)
        galaxy_form = Forms(*(getattr(self.form, part.name)[shape_row] for part in fields(Forms)))
        light = float(sources.electrons[i])
        return outskirts.from_galaxy(self.shapes.take(shape_row), galaxy_form, light, self.psf, self.weights[i], region)


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
        # `outside.electrons` starts as the expected aliased light, and is replaced by the light that is really removed
        # when the stamp is drawn. Stamps outside the frame are not drawn, so they keep the expected value. It is wrong
        # by 5 % for single sources and by 0.1 % for the sum of many.
        outside=wings.OutsideLight(profile, curve[:, -1].copy(), farthest),
        curve=curve,
        has_far_light=stamp_sizes.has_far_light(sources.electrons, sizes, sources.shape, sources.picture, psf),
        largest=stamp_sizes.on_largest(sources.shape, sizes),
        unit=fourier.units_of(sources.electrons),
    )


def _batches(prepared: _PreparedSources, on_frame: Bool, precise: Bool) -> Iterator[tuple[Int, Transfer, Array]]:
    """Yield groups of stamps that are drawn together: (indices of n pieces, PSF transforms, their weights [n, planes]).

    A piece is a source, or a part of the trail of a moving source, on one stamp. The stamps of a group have one size.
    Only pieces in the mask `on_frame` [p] are drawn. Pieces in the mask `precise` [p] are drawn in double precision,
    and each is the only piece of its group.
    """
    sources, psf = prepared.sources, prepared.psf
    own_reach = prepared.deep | (prepared.sizes > psf.side)
    # Largest side of the stamp of a star whose PSF is given as images.
    star_size = SIZES[min(int(np.searchsorted(SIZES, psf.side)), len(SIZES) - 1)]
    for size in np.unique(prepared.sizes).tolist():
        individual, sharing = (
            indices[on_frame[indices]] for indices in split_by_size(sources, prepared.sizes, psf, size, precise)
        )
        limit = np.inf if size <= star_size else _WIDE_REACH
        reach = min(prepared.reach, limit)
        if len(sharing):
            shared, batch = transfer.transfer(psf, size, reach), max(_BATCH // size**2, 2)
            for i in range(0, len(sharing), batch):
                chosen = sharing[i : i + batch]
                yield chosen, shared, prepared.weights[chosen].astype(np.float32)
        for i in individual.tolist():
            dtype = np.float64 if precise[i] else np.float32
            source_grid = transfer.grid(size, min(float(prepared.cut[i]), limit) if own_reach[i] else reach)
            psf_transfer = transfer.source_transfer(
                psf, prepared.weights[i], source_grid, dtype, bool(prepared.has_far_light[i])
            )
            if (picture := sources.picture_of(i)) is not None:
                psf_transfer = arcs.apply_picture(psf_transfer, picture, sources.jacobian[i])
            yield np.array([i]), psf_transfer, np.ones((1, 1), dtype)


def _add_outskirts(
    prepared: _PreparedSources, i: int, light: outskirts.Outskirts, frame: Int, unread_rows: tuple[int, int]
) -> float:
    """Add the light of a galaxy outside its stamp to the image of the detector (frame), and return the added electrons.

    `i` is the index of the galaxy in `prepared.sources`, and `light` its light as a function of position. Electrons on
    the rows from unread_rows[0] to unread_rows[1] - 1, which the detector does not read, are not counted.
    """
    place, size = (float(prepared.sources.column[i]), float(prepared.sources.row[i])), int(prepared.sizes[i])
    x_first, y_first = (int(np.rint(at)) - size // 2 for at in place)
    return float(
        outskirts.add(light, frame, *place, (x_first, y_first, size), unread_rows, prepared.unit) / prepared.unit
    )


def _draw_light_beyond_stamps(
    prepared: _PreparedSources, on_frame: Bool, frame: Int, fallen: Float, unread_rows: tuple[int, int]
) -> None:
    """Draw light far from sources: of very large galaxies whose stamps lie outside the frame, and of bright stars.

    `on_frame` [p] is the mask of the pieces of sources whose stamps overlap the image of the detector (frame). Stars
    are drawn beyond the border of their PSF images. The electrons of galaxies on the frame, without those in
    `unread_rows`, are added to `fallen` [p]; electrons of stars are not.
    """
    ny, nx = frame.shape
    for i in np.flatnonzero(prepared.largest & ~on_frame).tolist():
        fallen[i] += _add_outskirts(prepared, i, prepared.outskirts(i, nx, ny, False), frame, unread_rows)
    bright = np.flatnonzero(prepared.has_far_light)
    for trailing in np.split(bright, np.flatnonzero(np.diff(prepared.parent[bright])) + 1) if len(bright) else []:
        far_light.add(frame, prepared.star(trailing), prepared.unit)


def _extend_reach(
    cut: Float, electrons: Float, sizes: Int, left_out: Float, psf: Psf, reach_arguments: tuple[Array, ...]
) -> Bool:
    """Increase the largest |k| at which the transforms of bright sources are computed; return their mask [n].

    `cut` [n] is this |k| in radian / pixel, changed in place. A sharp edge in Fourier space causes ringing of up to 0.3
    % of the part that is cut off; with the larger `cut` it is not noticeable. A PSF given by images has a fixed last
    frequency, so the mask is then False everywhere. `left_out` [n] is the size of the Fourier samples that may be
    neglected, as a fraction of the flux; 0 stands for 1e-7, and `cut` is then not increased. `reach_arguments` are
    profiles of the sources: body, fraction, bulge, disk, sersic and row of `fourier.fourier_reach`.
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
        # On stamps with sides above DEEP pixels, more frequencies would need too much memory.
        new_reach[sizes[indices] > DEEP] = np.minimum(new_reach[sizes[indices] > DEEP], transfer.HIGHEST)
        cut[indices] = np.maximum(cut[indices], new_reach)
    return deep


def in_double_precision(sources: Sources, neglected: Float | None) -> Bool:
    """Return the mask [n] of the sources that are drawn in double precision, because single precision would show.

    `neglected` [n] is the fraction of the flux that may be neglected in a Fourier sample. With None, only sources with
    more than BRIGHT electrons are drawn in double precision.
    """
    is_precise = np.zeros(len(sources), bool) if neglected is None else neglected < ROUNDING
    return np.asarray(is_precise | (sources.electrons > BRIGHT))


def split_by_size(sources: Sources, sizes: Int, psf: Psf, size: int, precise: Bool) -> tuple[Int, Int]:
    """Divide the sources with stamps of one size into sources with individual PSFs and sources that share transforms.

    The PSF of a source is a weighted sum of planes (basis images). Either the planes are summed before the transform,
    for each source, or the transforms of all planes are computed once and shared by the sources.

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
        Indices of sources with individual PSFs, and of sources that share the transformed planes; either may be empty.
    """
    of_size = sizes == size
    is_large = psf.planes is not None and size > _SHARED
    pictured = np.zeros(len(sources), bool) if sources.picture is None else sources.picture >= 0
    individual = of_size & (is_large | precise | pictured | stamp_sizes.on_largest(sources.shape, sizes))
    return np.flatnonzero(individual), np.flatnonzero(of_size & ~individual)


def _draw_batch(
    prepared: _PreparedSources,
    chosen: Int,
    psf_transfer: Transfer,
    share: Array,
    frame: Int,
    unread_rows: tuple[int, int],
) -> Float:
    """Draw the stamps of the pieces `chosen`, which have one size, onto the frame.

    `share` [m, planes] are the weights of the transforms in `psf_transfer`, whose weighted sum is the transform of each
    piece's PSF. Returns the electrons [m] of each piece on the frame. Rows that the detector does not read, from
    unread_rows[0] to unread_rows[1] - 1, are not counted.
    """
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
    # A galaxy larger than the largest stamp is alone in its batch, and so is a star with light beyond its PSF images.
    # Aliased light of such a source is removed by a special function.
    outer = prepared.outskirts(first, nx, ny, True) if prepared.largest[first] else None
    if outer is not None:
        outskirts.remove_aliased(outer, stamps[0], float(column[0]) - stamp_x, float(row[0]) - stamp_y)
    elif prepared.has_far_light[first]:
        far_light.remove_aliased(prepared.star(chosen), stamps[0], stamp_x, stamp_y, nx, ny)
    fallen = accumulate(frame, stamps, x0, y0, unread_rows, prepared.unit) / prepared.unit
    if outer is not None:
        fallen[0] += _add_outskirts(prepared, first, outer, frame, unread_rows)
    return np.asarray(fallen)


def _forms(sources: Sources) -> tuple[Shapes, Forms]:
    """Return the parameters of bulges and discs, and their sizes and orientations in pixels.

    Both results have one row for each source that is a galaxy, in the order of the sources.
    """
    body = sources.shape >= 0
    shapes = sources.shapes.take(sources.shape[body])
    return shapes, galaxy_shapes.forms(shapes, sources.jacobian[body])


def _profile_arguments(sources: Sources, shapes: Shapes, form: Forms) -> tuple[Array, ...]:
    """Return the profiles of n sources as arguments of `fourier.nyquist_zones`, with zeros for point sources.

    The arrays have one row per source: body (True for galaxies), fraction (of the light in the bulge), bulge and disk
    (matrices of axes in pixels), thick (vector for the thickness of the disc), row and row_weights (rows of the table
    of Sersic transforms, and their weights). `shapes` and `form` describe the galaxies among the sources, in order.
    """
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
    """Return the light of n sources outside their stamps, as (profiles, distances, upper limits).

    Profiles [n, 11] are rows of `galaxy_shapes.real_space_profile` (central brightness in electrons per pixel, shape
    and orientation of bulge and disc); the brightness is 0 if no light is drawn outside the stamp. Distances [n] are
    those up to which the light is drawn, pixels. Upper limits [n] are the electrons outside the stamp. All are 0 for
    point sources. `shapes` and `form` describe those sources that are galaxies, in order.
    """
    body = sources.shape >= 0
    profile, light_reach, max_electrons = np.zeros((len(sources), 11)), np.zeros(len(sources)), np.zeros(len(sources))
    light_reach[body], outside_fraction = stamp_sizes.light_beyond_stamps(shapes, sizes[body], pixel_scale)
    # The outer light of galaxies that are larger than the largest stamp is drawn by outskirts.py instead.
    light_reach[stamp_sizes.on_largest(sources.shape, sizes)] = 0.0
    sky = galaxy_shapes.real_space_profile(shapes, form)
    sky[:, [BULGE, DISK]] *= np.where(light_reach[body] > 0, sources.electrons[body], 0.0)[:, None]
    profile[body] = sky
    max_electrons[body] = outside_fraction * sources.electrons[body]
    return profile, light_reach, max_electrons
