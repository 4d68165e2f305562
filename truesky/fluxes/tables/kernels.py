"""Compiled loops that interpolate tables of band fluxes for many galaxies or stars.

The loops run over sources. The result of a source does not depend on the other sources, not even in the last bit.
A galaxy has two components: spectral templates, each with its own extinction law and E(B-V).
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
    """Find the four redshift nodes of a flux table around each galaxy, and the weights of cubic interpolation.

    Parameters
    ----------
    log_z : float array, shape (n,)
        ln(1 + z) of each galaxy. Redshifts beyond the table are extrapolated.
    sed, law : int array, shape (2, n)
        Indices of each galaxy's two templates, and codes of their extinction laws. Code 0 (no dust) uses the nodes of
        law 1.
    n_law : int
        Number of laws in the table.
    log_first : float
        First node in ln(1 + z).
    step : float
        Distance of nodes in ln(1 + z).
    z_count : int
        Number of nodes, at least 4.
    first : int array, shape (2, n)
        Output: index of the first of four nodes in the table, whose axes (template, law, node) are flattened.
    z_weights : float32 array, shape (n, 4)
        Output: Lagrange weights of the four nodes.
    """
    for i in range(len(log_z)):
        position = (log_z[i] - log_first) / step
        # Near the ends of the table the four nodes are not centred on the galaxy.
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
    """Compute products of Chebyshev polynomials in E(B-V) and A(V), at which a flux table is evaluated.

    Parameters
    ----------
    law : int array, shape (2, n)
        Code of the extinction law of each galaxy's two templates. Without a law (0) E(B-V) is taken as 0.
    ebv : float array, shape (2, n)
        E(B-V) of each template's dust in mag. Larger values than `ebv_last` are replaced by `ebv_last`.
    a_v : float array, shape (n,)
        A(V) of the Milky Way in mag, 0 to `a_v_last`, which is not checked.
    ebv_last, a_v_last : float
        Largest E(B-V) and A(V) of the tables in mag.
    n_ebv, n_av : int
        Number of polynomials in E(B-V) and in A(V).
    basis : float32 array, shape (2, n, n_ebv * n_av)
        Output: T_p(x) T_q(y) at index p n_av + q. x and y are E(B-V) and A(V), scaled from [0, largest] to [-1, 1].
    """
    # Use flat arrays and unsigned positions, here and in other loops of this file. Numba then omits its code for
    # negative indices.
    in_av, flat, n, width = np.empty(n_av, np.float32), basis.ravel(), len(a_v), np.uint64(n_av)
    for i in range(n):
        x = 2.0 * a_v[i] / a_v_last - 1.0
        previous, current = x, 1.0
        for q in range(n_av):
            in_av[q] = current
            previous, current = current, 2.0 * x * current - previous
        for k in range(2):
            # Limit E(B-V) to the range of the table with `min`, because a template without flux may have any E(B-V).
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
    """Compute ln(f_nu in a band / rest-frame f_nu in the reference band) of each galaxy's two templates behind dust.

    Parameters
    ----------
    table : float32 array, shape (n_template, 4, n_z, n_coefficient)
        Chebyshev coefficients of the band for extinction laws 1 to 4. A template without dust uses law 1 with E(B-V) 0.
    first : int array, shape (2, n)
        Indices of the first redshift nodes, from `find_nodes`.
    z_weights : float32 array, shape (n, 4)
        Interpolation weights of the redshift nodes, from `find_nodes`.
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
    """Compute observed wavelengths of emission lines, and their fluxes after Milky Way extinction.

    Parameters
    ----------
    fluxes : float array, shape (n, n_line)
        Flux of each line before Milky Way extinction; 0 for a galaxy without this line.
    log_z : float array, shape (n,)
        ln(1 + z) of each galaxy.
    a_v : float array, shape (n,)
        A(V) of the Milky Way in mag.
    vacuum : float array, shape (n_line,)
        Rest-frame wavelengths in vacuum in A.
    ciddor : float array, shape (2, 2)
        (strength, resonance) of the two terms of the refractivity of air; see `lines.refractivity_terms`.
    curve : float array, shape (n_lambda,)
        A(lambda) / A(V) of the Milky Way in steps of 1 A from `first`. Lines outside its wavelengths get flux 0.
    first : float
        First wavelength of `curve` in A.
    centre : float array, shape (n, n_line, 2)
        Output: ln of the observed wavelength in A, in vacuum and in air. Not written for lines whose flux is 0.
    flux : float array, shape (n, n_line, 2)
        Output: flux after extinction at the wavelengths in vacuum and in air, in the unit of `fluxes`.
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
            # ln(1 + refractivity) to second order, with an error of 1e-11.
            shift = refractivity * (1.0 - 0.5 * refractivity)
            centre[i, j, 0] = log_vacuum[j] + log_z[i]
            centre[i, j, 1] = centre[i, j, 0] - shift
            low = int(position)
            slope = curve[low + 1] - curve[low]
            flux[i, j, 0] = fluxes[i, j] * np.exp(-depth * (curve[low] + (position - low) * slope))
            # Extinction at the wavelength in air, to first order in the relative shift from vacuum to air (3e-4).
            flux[i, j, 1] = flux[i, j, 0] * (1.0 + depth * slope * lam * shift)


@jit
def sum_components(
    ratios: Float32, frac: Float, scale: Float, centre: Float, flux: Float, width: Int, share: Float,
    tables: Float32, start: UInt32, last: Int32, medium: UInt32, first: Float, step: float, cells: Int,
    members: UInt32, cell_first: float, cell_step: float, magnification: Float, rows: Int, out: Float,
) -> None:  # fmt: skip
    """Sum the flux of both templates and of all lines of each galaxy in each band, and multiply by the magnification.

    Parameters
    ----------
    ratios : float32 array, shape (n_band, 2, n)
        f_nu of each of the two templates in each band, relative to its rest-frame f_nu in the reference band.
    frac : float array, shape (2, n)
        Fraction of each template in the rest-frame flux in the reference band.
    scale : float array, shape (n,)
        Factor that scales the mixture of templates to the galaxy's apparent magnitude.
    centre, flux : float array, shape (n, n_line, 2)
        ln(wavelength) and flux of each line, from `line_centres`.
    width : int array, shape (n,)
        Column of `tables` for the largest tabulated line width that is not above the width of the galaxy's lines, but
        not the last column, because the next one is read, too.
    share : float array, shape (n,)
        Fraction of the way to the next tabulated width in the square of the width, 0 to 1.
    tables : float32 array, shape (sum of n_lambda, n_width)
        Line tables of all bands, uniform in ln(lambda): f_nu in the band of a line with unit flux.
    start : uint32 array, shape (n_band,)
        First row of each band in `tables`.
    last : int32 array, shape (n_band,)
        Index of the last row of each band, counted from the first row of the band.
    medium : uint32 array, shape (n_band,)
        1 for air, 0 for vacuum.
    first : float array, shape (n_band,)
        ln(lambda) of the first row of each band.
    step : float
        Step of `tables` in ln(lambda).
    cells : int array, shape (n_cell + 1,)
        members[cells[c] : cells[c + 1]] are the bands that respond in wavelength cell c.
    members : uint32 array
        Indices of the bands that respond in each wavelength cell, one cell after the other.
    cell_first, cell_step : float
        ln(lambda) at the start of the first wavelength cell, and width of a cell in ln(lambda).
    magnification : float array, shape (n,)
        Factor of the sum: lensing magnification, which may include a conversion of units.
    rows : int array, shape (n,)
        Row of `out` for each galaxy.
    out : float array, shape (m, n_band)
        Output: fluxes. Other rows stay unchanged.
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
    """Compute the flux of each star in a band as the sum over the templates that are mixed.

    Parameters
    ----------
    table : float32 array, shape (n_template, m)
        Chebyshev coefficients in A(V) of ln(f_nu) of each template in the band.
    sed : int array, shape (k, n)
        Indices of the k templates of each star.
    frac : float array, shape (k, n)
        Fraction of each template. Templates with 0 are skipped.
    basis : float array, shape (n, m)
        Chebyshev polynomials at each star's A(V).
    scale : float array, shape (n,)
        Factor that scales the mixture to the star's magnitude.
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
