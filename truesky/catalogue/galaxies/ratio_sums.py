"""The loop of band_ratios.ln_ratio: a table read at a redshift, and a polynomial through its nodes of E(B-V)."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit


@exact_jit
def ln_ratios(values: Any, step: Any, nodes: Any, z: Any, template: Any, law: Any, ebv: Any, out: Any) -> None:
    """Fills out, float64[n], linear in ln(1 + z), polynomial in E(B-V); law 0 has no dust.

    values : float32[z, 4, template, e];  step : of ln(1 + z);  nodes : float64[e], the first 0
    z, ebv : float64[n];  template, law : int64[n]
    """
    count = nodes.size
    # Of Lagrange's polynomials: what they are divided by.
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
        # The product of all differences but one: those before it times those after it.
        upper_product = 1.0
        for i in range(count - 1, -1, -1):
            upper_products[i] = upper_product
            upper_product *= ebv[k] - nodes[i]
        lower_product, total = 1.0, 0.0
        for i in range(count):
            total += lower_product * upper_products[i] * scale[i] * ((1.0 - part) * low[i] + part * high[i])
            lower_product *= ebv[k] - nodes[i]
        out[k] = total
