"""Compiled loop of band_ratios.ln_ratio: interpolation in redshift, and a polynomial through the nodes of E(B-V)."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit


@exact_jit
def ln_ratios(values: Any, step: Any, nodes: Any, z: Any, template: Any, law: Any, ebv: Any, out: Any) -> None:
    """Fill `out` with ln(ratio), linear in ln(1 + z) and polynomial in E(B-V).

    Parameters
    ----------
    values : float32 array, shape (z, 4, templates, e)
        Values of the table.
    step : float
        Step of ln(1 + z).
    nodes : float array, shape (e,)
        Nodes of E(B-V), mag; the first is 0.
    z : float array, shape (n,)
        Redshift.
    template : int array, shape (n,)
        Index of the template.
    law : int array, shape (n,)
        Extinction law; 0 means no dust.
    ebv : float array, shape (n,)
        E(B-V), mag.
    out : float array, shape (n,)
        Result.
    """
    count = nodes.size
    # Inverse denominators of the Lagrange polynomials.
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
        # The product of all differences except the i-th is the product before it times the product after it.
        upper_product = 1.0
        for i in range(count - 1, -1, -1):
            upper_products[i] = upper_product
            upper_product *= ebv[k] - nodes[i]
        lower_product, total = 1.0, 0.0
        for i in range(count):
            total += lower_product * upper_products[i] * scale[i] * ((1.0 - part) * low[i] + part * high[i])
            lower_product *= ebv[k] - nodes[i]
        out[k] = total
