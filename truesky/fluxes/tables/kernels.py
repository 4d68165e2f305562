"""Compiled loops of the flux tables.

The loops run over rows. No result depends on neighbouring rows, not even in the last bit.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Float32, Int, Int32, UInt32
from truesky.numerics.compiling import exact_jit, jit


@jit
def find_nodes(
    log_z: Float, sed: Int, law: Int, n_law: int, log_first: float, step: float, z_count: int,
    first: Int, z_weights: Float32,
) -> None:  # fmt: skip
    """Find the nodes in redshift of each component, and the weights of cubic interpolation.

    Parameters
    ----------
    log_z : float array, shape (n,)
        ln(1 + z).
    sed, law : int array, shape (2, n)
        Template and extinction law of each component.
    n_law : int
        Number of laws in the table.
    log_first : float
        First node in ln(1 + z).
    step : float
        Distance of nodes in ln(1 + z).
    z_count : int
        Number of nodes.
    first : int array, shape (2, n)
        Output: index of the first of four nodes.
    z_weights : float32 array, shape (n, 4)
        Output: Lagrange weights.
    """
    for i in range(len(log_z)):
        position = (log_z[i] - log_first) / step
        # Interpolation is one-sided at the ends of the table.
        row = min(max(int(np.floor(position)) - 1, 0), z_count - 4)
        t = position - row - 1.0
        for k in range(2):
            first[k, i] = (sed[k, i] * n_law + max(law[k, i] - 1, 0)) * z_count + row
        z_weights[i, 0] = -t * (t - 1.0) * (t - 2.0) / 6.0
        z_weights[i, 1] = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
        z_weights[i, 2] = -(t + 1.0) * t * (t - 2.0) / 2.0
        z_weights[i, 3] = (t + 1.0) * t * (t - 1.0) / 6.0


@jit
def chebyshev_products(
    law: Int, ebv: Float, a_v: Float, ebv_last: float, a_v_last: float, n_ebv: int, n_av: int, basis: Float32
) -> None:
    """Compute products of Chebyshev polynomials in E(B-V) and A(V).

    Parameters
    ----------
    law : int array, shape (2, n)
        Extinction law of each component. Without a law (0) E(B-V) is taken as 0.
    ebv : float array, shape (2, n)
        E(B-V) in mag.
    a_v : float array, shape (n,)
        A(V) of the Milky Way in mag.
    ebv_last, a_v_last : float
        Largest E(B-V) and A(V) of the tables.
    n_ebv, n_av : int
        Number of polynomials in each.
    basis : float32 array, shape (2, n, n_ebv * n_av)
        Output: products.
    """
    # Flat arrays and unsigned positions, here and below, avoid the code for negative indices.
    in_av, flat, n, width = np.empty(n_av, np.float32), basis.ravel(), len(a_v), np.uint64(n_av)
    for i in range(n):
        x = 2.0 * a_v[i] / a_v_last - 1.0
        previous, current = x, 1.0
        for q in range(n_av):
            in_av[q] = current
            previous, current = current, 2.0 * x * current - previous
        for k in range(2):
            # E(B-V) is limited to the table, because a template without flux may have any value.
            x = 2.0 * (min(ebv[k, i], ebv_last) if law[k, i] > 0 else 0.0) / ebv_last - 1.0
            previous, current = x, 1.0
            at = np.uint64((k * n + i) * n_ebv * n_av)
            for _ in range(n_ebv):
                factor = np.float32(current)
                for q in range(width):
                    flat[at + q] = factor * in_av[q]
                at += width
                previous, current = current, 2.0 * x * current - previous


@jit
def log_ratios(table: Float32, first: Int, z_weights: Float32, basis: Float32, out: Float32) -> None:
    """Compute ln(f_nu in the band / f_nu in the reference band at rest) of each component.

    Parameters
    ----------
    table : float32 array, shape (n_template, 4, n_z, n_coefficient)
        Table of the band for laws 1 to 4. Without a law, E(B-V) is 0 in any of them.
    first : int array, shape (2, n)
        Nodes from `find_nodes`.
    z_weights : float32 array, shape (n, 4)
        Weights from `find_nodes`.
    basis : float32 array, shape (2, n, n_coefficient)
        Products from `chebyshev_products`.
    out : float32 array, shape (2, n)
        Output: logarithms.
    """
    flat, polynomials, count, n = table.ravel(), basis.ravel(), np.uint64(table.shape[3]), len(z_weights)
    for k in range(2):
        for i in range(n):
            w0, w1, w2, w3 = z_weights[i, 0], z_weights[i, 1], z_weights[i, 2], z_weights[i, 3]
            node0 = np.uint64(first[k, i]) * count
            node1, node2, node3 = node0 + count, node0 + count + count, node0 + count + count + count
            at = np.uint64(k * n + i) * count
            log_ratio = np.float32(0.0)
            for c in range(count):
                mixed = w0 * flat[node0 + c] + w1 * flat[node1 + c] + w2 * flat[node2 + c] + w3 * flat[node3 + c]
                log_ratio += mixed * polynomials[at + c]
            out[k, i] = log_ratio


@jit
def line_centres(
    fluxes: Float, log_z: Float, a_v: Float, vacuum: Float, ciddor: Float, curve: Float, first: float,
    centre: Float, flux: Float,
) -> None:  # fmt: skip
    """Compute observed wavelengths of lines, and their fluxes behind the Milky Way.

    Parameters
    ----------
    fluxes : float array, shape (n, n_line)
        Fluxes before dust.
    log_z : float array, shape (n,)
        ln(1 + z).
    a_v : float array, shape (n,)
        A(V) of the Milky Way in mag.
    vacuum : float array, shape (n_line,)
        Rest-frame wavelengths in vacuum in A.
    ciddor : float array, shape (2, 2)
        (strength, resonance) of the terms of the refractivity of air.
    curve : float array
        A(lambda) / A(V) in steps of 1 A from `first`. Lines beyond it are in no band.
    first : float
        First wavelength of `curve` in A.
    centre : float array, shape (n, n_line, 2)
        Output: ln of the observed wavelength in A, in vacuum and in air.
    flux : float array, shape (n, n_line, 2)
        Output: flux behind the Milky Way at these wavelengths.
    """
    log_vacuum = np.log(vacuum)
    for i in range(len(log_z)):
        stretch, depth = np.exp(log_z[i]), 0.4 * np.log(10.0) * a_v[i]
        for j in range(len(vacuum)):
            flux[i, j, 0] = flux[i, j, 1] = 0.0
            lam = vacuum[j] * stretch
            position = lam - first
            if fluxes[i, j] == 0.0 or position < 0.0 or position >= len(curve) - 1:
                continue
            square = 1e8 / (lam * lam)
            refractivity = 1e-8 * (ciddor[0, 0] / (ciddor[0, 1] - square) + ciddor[1, 0] / (ciddor[1, 1] - square))
            # ln(1 + refractivity) with an error of 1e-11.
            shift = refractivity * (1.0 - 0.5 * refractivity)
            centre[i, j, 0] = log_vacuum[j] + log_z[i]
            centre[i, j, 1] = centre[i, j, 0] - shift
            low = int(position)
            slope = curve[low + 1] - curve[low]
            flux[i, j, 0] = fluxes[i, j] * np.exp(-depth * (curve[low] + (position - low) * slope))
            # The extinction at the wavelength in air, to first order in a shift of 3e-4.
            flux[i, j, 1] = flux[i, j, 0] * (1.0 + depth * slope * lam * shift)


@jit
def sum_components(
    ratios: Float32, frac: Float, scale: Float, centre: Float, flux: Float, width: Int, share: Float,
    tables: Float32, start: UInt32, last: Int32, medium: UInt32, first: Float, step: float, cells: Int,
    members: UInt32, cell_first: float, cell_step: float, magnification: Float, rows: Int, out: Float,
) -> None:  # fmt: skip
    """Sum components and lines of each galaxy in each band, times magnification.

    Parameters
    ----------
    ratios : float32 array, shape (n_band, 2, n)
        f_nu of each component relative to the reference band at rest.
    frac : float array, shape (2, n)
        Fraction of each component.
    scale : float array, shape (n,)
        Factor of the components.
    centre, flux : float array, shape (n, n_line, 2)
        Results of `line_centres`.
    width : int array, shape (n,)
        Node in width at or below the width of the galaxy's lines.
    share : float array, shape (n,)
        Fraction of the way to the next node in width, 0 to 1.
    tables : float32 array, shape (sum of n_lambda, n_width)
        Line tables of all bands, uniform in ln(lambda): f_nu in the band of a line with unit flux.
    start : uint32 array, shape (n_band,)
        First row of each band in `tables`.
    last : int32 array, shape (n_band,)
        Number of the last row of each band, from its first row.
    medium : uint32 array, shape (n_band,)
        1 for air, 0 for vacuum.
    first : float array, shape (n_band,)
        ln(lambda) of the first row of each band.
    step : float
        Step of `tables` in ln(lambda).
    cells : int array, shape (n_cell + 1,)
        members[cells[c] : cells[c + 1]] are the bands that respond in wavelength cell c.
    members : uint32 array
        Bands that respond in each cell.
    cell_first, cell_step : float
        ln(lambda) at the start of the first wavelength cell, and width of a cell.
    magnification : float array, shape (n,)
        Factor of the sum.
    rows : int array, shape (n,)
        Rows of `out` to fill.
    out : float array, shape (m, n_band)
        Output: fluxes.
    """
    per_row, per_cell, n_band = 1.0 / step, 1.0 / cell_step, len(first)
    flat, widths, unit = tables.ravel(), np.uint32(tables.shape[1]), np.uint32(1)
    total = np.empty(n_band)
    for i in range(len(rows)):
        early, late = frac[0, i] * scale[i], frac[1, i] * scale[i]
        for b in range(n_band):
            total[b] = early * ratios[b, 0, i] + late * ratios[b, 1, i]
        column, wider = np.uint32(width[i]), np.float32(share[i])
        for j in range(flux.shape[1]):
            if flux[i, j, 0] == 0.0:
                continue
            cell = int((centre[i, j, 0] - cell_first) * per_cell)
            for m in range(cells[cell], cells[cell + 1]):
                b = members[m]
                position = (centre[i, j, medium[b]] - first[b]) * per_row
                low = np.int32(position)
                if position < 0.0 or low >= last[b]:
                    continue
                fraction = np.float32(position - np.float64(low))
                blue = (start[b] + np.uint32(low)) * widths + column
                red = blue + widths
                narrow = flat[blue] + fraction * (flat[red] - flat[blue])
                wide = flat[blue + unit] + fraction * (flat[red + unit] - flat[blue + unit])
                total[b] += flux[i, j, medium[b]] * (narrow + wider * (wide - narrow))
        for b in range(n_band):
            out[rows[i], b] = total[b] * magnification[i]


@exact_jit
def mix_stars(table: Float32, sed: Int, frac: Float, basis: Float, scale: Float, out: Float) -> None:
    """Compute the flux of each star as the sum over its templates.

    Parameters
    ----------
    table : float32 array, shape (n_template, m)
        Chebyshev coefficients of ln(f_nu).
    sed : int array, shape (k, n)
        Templates of each star.
    frac : float array, shape (k, n)
        Fraction of each template.
    basis : float array, shape (n, m)
        Chebyshev polynomials.
    scale : float array, shape (n,)
        Factor of the sum.
    out : float array, shape (n,)
        Output: scale times the sum of frac exp(coefficients . basis).
    """
    for i in range(len(out)):
        total = 0.0
        for k in range(len(sed)):
            if frac[k, i] > 0.0:
                log = 0.0
                for c in range(basis.shape[1]):
                    log += table[sed[k, i], c] * basis[i, c]
                total += frac[k, i] * np.exp(log)
        out[i] = total * scale[i]
