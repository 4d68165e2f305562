"""Compiled loop of `band_ratios.ln_ratio`, which interpolates the brightness of template spectra in a passband.

The interpolation is linear in ln(1 + z), and a Lagrange polynomial through the nodes of E(B-V).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit


@exact_jit
def ln_ratios(values: Any, step: Any, nodes: Any, z: Any, template: Any, law: Any, ebv: Any, out: Any) -> None:
    """Interpolate ln(flux in a band at z / rest-frame flux in 0.1r) of template spectra in redshift and E(B-V).

    0.1r is the SDSS r band blueshifted to z = 0.1. This logarithm is called ln(ratio) below.

    Parameters
    ----------
    values : float32 array, shape (z, 4, templates, e)
        ln(ratio) by redshift, extinction law (1 to 4), template and E(B-V).
    step : float
        Step of ln(1 + z) between two redshifts of `values`; the first redshift is 0.
    nodes : float array, shape (e,)
        E(B-V) of the last axis of `values`, mag; the first is 0.
    z : float array, shape (n,)
        Redshift. Values beyond the table are extrapolated linearly.
    template : int array, shape (n,)
        Index of the template.
    law : int array, shape (n,)
        Extinction law, 0 to 4; 0 means no dust, and E(B-V) is then ignored.
    ebv : float array, shape (n,)
        E(B-V), mag.
    out : float array, shape (n,)
        Filled with ln(ratio).

    Notes
    -----
    The interpolation is linear in ln(1 + z), and a Lagrange polynomial through all nodes in E(B-V).
    """
    count = nodes.size
    # scale[i] is the inverse of the denominator of the i-th Lagrange polynomial.
    scale = np.ones(count)
    for i in range(count):
        for j in range(count):
            if i != j:
                scale[i] /= nodes[i] - nodes[j]
    upper_products = np.empty(count)
    for k in range(z.size):
        at = np.log1p(z[k]) / step
        row = min(max(int(at), 0), values.shape[0] - 2)
        part = at - row
        low, high = values[row, max(law[k], 1) - 1, template[k]], values[row + 1, max(law[k], 1) - 1, template[k]]
        if law[k] == 0 or ebv[k] == nodes[0]:
            out[k] = (1.0 - part) * low[0] + part * high[0]
            continue
        # The product of (ebv - nodes[j]) over all j except i is lower_product (j < i) times upper_products[i] (j > i).
        upper_product = 1.0
        for i in range(count - 1, -1, -1):
            upper_products[i] = upper_product
            upper_product *= ebv[k] - nodes[i]
        lower_product, total = 1.0, 0.0
        for i in range(count):
            total += lower_product * upper_products[i] * scale[i] * ((1.0 - part) * low[i] + part * high[i])
            lower_product *= ebv[k] - nodes[i]
        out[k] = total
