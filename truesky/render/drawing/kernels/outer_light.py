"""Compiled loops for the outer light of galaxies that are larger than the largest stamp.

The light is smooth far from the middle of a galaxy. It is therefore evaluated at the nodes of a coarse grid, and pixels
are interpolated between them. The distances of the nodes from the middle of the galaxy are multiples of their spacing.
The light of a pixel is therefore the same in any frame (image of the detector) or window with this spacing. A
cell is the square between four nodes. Where interpolation is not accurate in the middle of a cell, the light of each
pixel in the cell is evaluated.

In all functions `light` [11] (parameters of bulge and disc), `disk` (table of the disc's light), `across` (factor of
the disc's minor axis), `blurred` (change of the light by the PSF at the nodes of another grid), `block` (spacing of
these nodes, pixels) and `first` (position of the first of these nodes) are attributes of `outskirts.Outskirts`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.numerics.compiling import jit
from truesky.render.drawing.kernels.frame import BULGE, BULGE_FORM, DISK, DISK_FORM, POWER

# Spacing of the nodes in the table of an inclined disc's light. Nodes are equally spaced in t = arsinh(u), where u is
# the distance from the middle along the major axis in scale lengths. Along the minor axis, the distance is first
# divided by the factor w of `outskirts.surface_disk`, about the axis ratio.
STEP = 1.0 / 16.0
# Light of a disc is neglected where an estimate of it is below this, electrons per pixel. The estimate is exp(-u) times
# the electrons of the disc per squared scale length, where u is the distance along the major axis in scale lengths. It
# is too large for a face-on disc, but about ten times too small far out along the major axis of an edge-on disc. Errors
# of this size by interpolation between nodes are neglected, too.
NEGLIGIBLE = 1e-4
# Largest error of the light by interpolation in the middle of a cell between four nodes, as a fraction of the light.
_INTERPOLATED = 1e-4
# The same for the light of copies. It is subtracted, so that its error remains also where the galaxy has no light.
_INTERPOLATED_COPIES = 1e-5


@jit
def _light_at(light: Float, disk: Float, across: float, x: float, y: float) -> Any:
    """Return the electrons of a galaxy in a pixel at (x, y) pixels from its middle, without the effect of the PSF.

    `light` [11] (parameters of bulge and disc), `disk` (table of the disc's light) and `across` (factor of the
    coordinate along the disc's minor axis) are attributes of `Outskirts`.
    """
    out = 0.0
    if light[BULGE] > 0.0:
        u = light[BULGE_FORM] * x + light[BULGE_FORM + 1] * y
        v = light[BULGE_FORM + 2] * x + light[BULGE_FORM + 3] * y
        out += light[BULGE] * np.exp(-np.exp(light[POWER] * np.log(u * u + v * v + 1e-300)))
    if light[DISK] > 0.0:
        u = abs(light[DISK_FORM] * x + light[DISK_FORM + 1] * y)
        if light[DISK] * np.exp(-u) > NEGLIGIBLE:
            v = abs(light[DISK_FORM + 2] * x + light[DISK_FORM + 3] * y) / across
            out += light[DISK] * _from_table(disk, np.log(u + np.sqrt(u * u + 1.0)), np.log(v + np.sqrt(v * v + 1.0)))
    return out


@jit
def _from_table(disk: Float, u: float, v: float) -> Any:
    """Return the light of a disc from the table `disk` of its logarithm, by cubic interpolation; 0 beyond the table.

    The nodes of the table are equally spaced in `u` and `v`, both at least 0: sinh u is the distance from the middle
    along the major axis in scale lengths, and sinh v that along the minor axis divided by the factor `across` of
    `Outskirts`. The result is for flux 1, per squared scale length.
    """
    # Coordinate 0 is at node 1 of the table, since cubic interpolation needs a node (node 0) on the other side of it.
    a, b = u / STEP + 1.0, v / STEP + 1.0
    i, j = int(a), int(b)
    if i + 2 >= len(disk) or j + 2 >= len(disk):
        return 0.0
    a, b = a - i, b - j
    total = 0.0
    for r in range(4):
        line = disk[i - 1 + r]
        row_sum = 0.0
        for c in range(4):
            row_sum += _cubic(b, c) * line[j - 1 + c]
        total += _cubic(a, r) * row_sum
    return np.exp(total)


@jit
def _cubic(part: float, node: int) -> Any:
    """Return the weight of `node`, 0 to 3, for cubic interpolation between four values at even spacing.

    The interpolated position is the fraction `part`, 0 to 1, of the way from node 1 to node 2.
    """
    if node == 0:
        return -part * (part - 1.0) * (part - 2.0) / 6.0
    if node == 1:
        return (part + 1.0) * (part - 1.0) * (part - 2.0) / 2.0
    if node == 2:
        return -(part + 1.0) * part * (part - 2.0) / 2.0
    return (part + 1.0) * part * (part - 1.0) / 6.0


@jit
def _bicubic(nodes: Float, x: float, y: float) -> Any:
    """Return a value at (x, y) by cubic interpolation between `nodes` [y, x] at integer coordinates; 0 beyond them."""
    i, j = int(np.floor(y)), int(np.floor(x))
    if i < 1 or j < 1 or i + 2 >= nodes.shape[0] or j + 2 >= nodes.shape[1]:
        return 0.0
    total = 0.0
    for r in range(4):
        row_sum = 0.0
        for c in range(4):
            row_sum += _cubic(x - j, c) * nodes[i - 1 + r, j - 1 + c]
        total += _cubic(y - i, r) * row_sum
    return total


@jit
def sample(light: Float, disk: Float, across: float, x: float, y: float, step: float, out: Float) -> None:
    """Add the light of a galaxy to the nodes of a grid. The effect of the PSF is not included.

    Parameters
    ----------
    light, disk, across
        Attributes of `outskirts.Outskirts`.
    x, y : float
        Position of the middle of the galaxy from the first node, pixels.
    step : float
        Spacing of the nodes, pixels.
    out : float array, shape (r, c)
        Electrons per pixel at the nodes, changed in place.
    """
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] += _light_at(light, disk, across, step * c - x, step * r - y)


@jit
def _light_of_copies(
    light: Float, disk: Float, across: float, blurred: Float, block: int, first: tuple[int, int], copies: Float,
    x: float, y: float,
) -> Any:  # fmt: skip
    """Return the electrons of a galaxy and its copies in a pixel at (x, y), with the effect of the PSF.

    The middles of the copies are at `copies` [m, 2], columns and rows in pixels. A galaxy without copies has one row.
    """
    total = 0.0
    for i in range(len(copies)):
        dx, dy = x - copies[i, 0], y - copies[i, 1]
        total += _light_at(light, disk, across, dx, dy)
        total += _bicubic(blurred, dx / block - first[0], dy / block - first[1])
    return total


@jit
def sample_copies(
    light: Float, disk: Float, across: float, blurred: Float, block: int, first: tuple[int, int], copies: Float,
    step: int, first_node: tuple[int, int], hole: tuple[float, float, float, float], nodes: Float, direct: Bool,
) -> None:  # fmt: skip
    """Evaluate the light of a galaxy and its copies at nodes, and find the cells in which interpolation is inaccurate.

    Parameters
    ----------
    light, disk, across, blurred, block, first
        Attributes of `outskirts.Outskirts`.
    copies : float array, shape (m, 2)
        Positions of the copies, pixels. Node (0, 0) is at the origin, and all copies are on nodes of `blurred`.
    step : int
        Spacing of the nodes, pixels.
    first_node : (int, int)
        Column and row of the first node, counted in nodes from the origin.
    hole : (float, float, float, float)
        First and last column, and first and last row, between which no light is needed.
    nodes : float array, shape (r, c)
        Electrons per pixel at the nodes, filled by this function.
    direct : bool array, shape (r - 3, c - 3)
        True for cells whose pixels must be evaluated directly, filled by this function. Cell (i, j) is between the
        nodes (i + 1, j + 1) and (i + 2, j + 2).
    """
    for r in range(nodes.shape[0]):
        for c in range(nodes.shape[1]):
            x, y, total = float(step * (first_node[0] + c)), float(step * (first_node[1] + r)), 0.0
            for i in range(len(copies)):
                total += _light_at(light, disk, across, x - copies[i, 0], y - copies[i, 1])
            nodes[r, c] = total
    weights = np.array([-0.0625, 0.5625, 0.5625, -0.0625])
    allowed = _INTERPOLATED if len(copies) == 1 else _INTERPOLATED_COPIES
    for r in range(direct.shape[0]):
        for c in range(direct.shape[1]):
            x, y = step * (first_node[0] + c + 1.5), step * (first_node[1] + r + 1.5)
            half, total = 0.5 * step, 0.0
            direct[r, c] = False
            if hole[0] <= x - half and x + half <= hole[1] and hole[2] <= y - half and y + half <= hole[3]:
                continue
            for i in range(len(copies)):
                total += _light_at(light, disk, across, x - copies[i, 0], y - copies[i, 1])
            interpolated = 0.0
            for j in range(4):
                for k in range(4):
                    interpolated += weights[j] * weights[k] * nodes[r + j, c + k]
            direct[r, c] = abs(interpolated - total) > NEGLIGIBLE + allowed * total
    # The change by the PSF is added last, without a check: it is itself interpolated between nodes.
    for r in range(nodes.shape[0]):
        for c in range(nodes.shape[1]):
            x, y = float(step * (first_node[0] + c)), float(step * (first_node[1] + r))
            for i in range(len(copies)):
                dx, dy = (x - copies[i, 0]) / block - first[0], (y - copies[i, 1]) / block - first[1]
                nodes[r, c] += _bicubic(blurred, dx, dy)


@jit
def _fill_line(
    light: Float, disk: Float, across: float, blurred: Float, block: int, first: tuple[int, int], copies: Float,
    step: int, first_node: tuple[int, int], nodes: Float, direct: Bool, x: float, y: float, line: Float,
    node_line: Float,
) -> None:  # fmt: skip
    """Fill a row of pixels with the electrons of a galaxy and its copies, interpolated between nodes.

    The first pixel is at (x, y), and pixels are 1 apart. Parameters of `sample_copies` have the same meaning here. The
    array `node_line`, with one element per column of nodes, is used for intermediate values.
    """
    place = y / step - first_node[1] - 1.0
    r = min(max(int(np.floor(place)), 0), direct.shape[0] - 1)
    part = place - r
    a, b, c, d = _cubic(part, 0), _cubic(part, 1), _cubic(part, 2), _cubic(part, 3)
    for j in range(nodes.shape[1]):
        node_line[j] = a * nodes[r, j] + b * nodes[r + 1, j] + c * nodes[r + 2, j] + d * nodes[r + 3, j]
    start, count = x / step - first_node[0] - 1.0, len(line)
    j = min(max(int(np.floor(start)), 0), direct.shape[1] - 1)
    i = 0
    while i < count:
        # Pixels i to end - 1 are in cell j.
        end = count if j == direct.shape[1] - 1 else min(int(np.ceil((j + 1.0 - start) * step)), count)
        if direct[r, j]:
            for k in range(i, end):
                line[k] = _light_of_copies(light, disk, across, blurred, block, first, copies, x + k, y)
        else:
            a, b, c, d = node_line[j], node_line[j + 1], node_line[j + 2], node_line[j + 3]
            # Polynomial through the four nodes.
            linear = c - a / 3.0 - b / 2.0 - d / 6.0
            square = 0.5 * (a + c) - b
            cube = (d - a) / 6.0 + 0.5 * (b - c)
            for k in range(i, end):
                t = start + k / step - j
                line[k] = b + t * (linear + t * (square + t * cube))
        i, j = max(end, i), j + 1


@jit
def subtract_copies(
    light: Float, disk: Float, across: float, blurred: Float, block: int, first: tuple[int, int], copies: Float,
    step: int, first_node: tuple[int, int], nodes: Float, direct: Bool, x: float, y: float, distant: Float, stamp: Any,
) -> None:  # fmt: skip
    """Subtract the light of the copies of a galaxy, and of farther copies, from its stamp.

    Parameters
    ----------
    light, disk, across, blurred, block, first
        Attributes of `outskirts.Outskirts`.
    copies, step, first_node, nodes, direct
        As for `sample_copies`, which fills the last two.
    x, y : float
        Position of the first pixel of the stamp from the middle of the galaxy, pixels.
    distant : float array, shape (N, N)
        Light of farther copies, electrons.
    stamp : float array, shape (N, N)
        Image of the galaxy, electrons, changed in place.
    """
    size = len(stamp)
    line, node_line = np.empty(size), np.empty(nodes.shape[1])
    for r in range(size):
        _fill_line(
            light, disk, across, blurred, block, first, copies, step, first_node, nodes, direct, x, y + r, line,
            node_line,
        )  # fmt: skip
        for c in range(size):
            stamp[r, c] -= line[c] + distant[r, c]


@jit
def add_galaxy(
    light: Float, disk: Float, across: float, blurred: Float, block: int, first: tuple[int, int], copies: Float,
    step: int, first_node: tuple[int, int], nodes: Float, direct: Bool, x: float, y: float, frame: Int,
    hole: tuple[int, int, int], unread_rows: tuple[int, int], unit: float,
) -> Any:  # fmt: skip
    """Add the light of a galaxy to a frame outside its stamp. Negative light is replaced by 0.

    Parameters
    ----------
    light, disk, across, blurred, block, first
        Attributes of `outskirts.Outskirts`.
    copies, step, first_node, nodes, direct
        As for `sample_copies`, which fills the last two.
    x, y : float
        Column and row of the galaxy, pixels.
    frame, hole, unread_rows, unit
        As for `outskirts.add`.

    Returns
    -------
    int
        Light that was added on read rows, in the integers of the frame.
    """
    ny, nx = frame.shape
    hole_x, hole_y, size = hole
    total = np.int64(0)
    line, node_line = np.empty(nx), np.empty(nodes.shape[1])
    for r in range(ny):
        inside = hole_y <= r < hole_y + size
        read = not unread_rows[0] <= r < unread_rows[1]
        _fill_line(
            light, disk, across, blurred, block, first, copies, step, first_node, nodes, direct, -x, r - y, line,
            node_line,
        )  # fmt: skip
        # Columns from skip_first to skip_end - 1 are inside the stamp.
        skip_first = min(max(hole_x, 0), nx) if inside else nx
        skip_end = min(max(hole_x + size, skip_first), nx) if inside else nx
        row_sum = np.int64(0)
        for start, end in ((0, skip_first), (skip_end, nx)):
            for c in range(start, end):
                units = np.int64(np.rint(max(line[c], 0.0) * unit))
                frame[r, c] += units
                row_sum += units
        if read:
            total += row_sum
    return total
