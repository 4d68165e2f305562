"""The compiled loops of the flux tables.

place         where galaxies lie in the tables of a step in redshift
products      their polynomials in E(B-V) and A_V
log_ratios    what their two components give in one band
line_centres  where lines are seen, and what the Milky Way leaves of them
add_up        components and lines together, in all bands

Plain loops over rows: no source depends on its neighbours, not in the last bit.
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
    """Fills first, int64[2, n], the first of four nodes of each component, and z_weights, float32[n, 4]: Lagrange's.

    sed, law : int64[2, n];  log_z = ln(1 + z)
    n_law     : laws of the table;  log_first, step, z_count : its first node in ln(1 + z), their distance and number
    """
    for i in range(len(log_z)):
        position = (log_z[i] - log_first) / step
        # One-sided at the ends.
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
    """Fills basis, float32[2, n, n_ebv * n_av]: products of Chebyshev polynomials in E(B-V), [2, n], and A_V, [n].

    law, ebv, a_v         : int64[2, n], float64[2, n], float64[n]; without a law E(B-V) is 0
    ebv_last, a_v_last    : where the tables end;  n_ebv, n_av : polynomials in each
    """
    # Flat arrays and unsigned positions, here and below: nothing is looked up from the end.
    in_av, flat, n, width = np.empty(n_av, np.float32), basis.ravel(), len(a_v), np.uint64(n_av)
    for i in range(n):
        x = 2.0 * a_v[i] / a_v_last - 1.0
        previous, current = x, 1.0
        for q in range(n_av):
            in_av[q] = current
            previous, current = current, 2.0 * x * current - previous
        for k in range(2):
            # A component without flux may have any E(B-V).
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
    """Fills out, float32[2, n]: ln(f_nu in the band / f_nu in the reference band at rest) of each component.

    table : float32[n_template, 4, n_z, n_coefficient], laws 1 .. 4; without a law E(B-V) is 0 in any of them
    first, z_weights, basis : of `place` and `products`
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
    """Fills centre, ln of the observed wavelength in A in a vacuum and in air, and flux, behind the Milky Way.

    ciddor : float64[2, 2] (strength, resonance) of the refractivity of air
    curve  : A(lambda) / A(V) in steps of 1 A from `first`; lines beyond it are in no band
    centre, flux : float64[n, n_line, 2]
    fluxes, vacuum : float64[n, n_line] before dust, and float64[n_line] wavelengths at rest, A
    log_z, a_v     : float64[n] ln(1 + z), and A(V) of the Milky Way, mag
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
            # ln(1 + part), to 1e-11.
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
    """Fills out[rows[i], b]: the sum of the components, times scale, and of the lines in band b; times magnification.

    ratios       : float32[n_band, 2, n] of each component;  frac : float64[2, n] its share
    width, share : [n] node of the lines' width below the galaxy's, and how far towards the next, 0 .. 1
    tables       : float32[sum of n_lambda, n_width] of all bands, uniform in ln(lambda) by `step`: what the band
                   makes of a line of that width there
    start, last  : [n_band] first row of a band in `tables`, and its last counted from there
    medium       : [n_band] 1 for air;  first : [n_band] ln(lambda) of a band's first row
    cells        : int64[n_cell + 1]: members[cells[c] : cells[c + 1]] are the bands that see wavelength cell c
    centre, flux : of `line_centres`
    cell_first, cell_step : ln(lambda) where the first wavelength cell begins, and the width of a cell
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
    """Fills out[n]: the sum over a star's templates of share times exp(coefficients . basis), times scale.

    table : float32[n_template, m] coefficients;  sed, frac : [k, n];  basis : [n, m];  scale, out : [n]
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
