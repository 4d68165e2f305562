"""Conversion of the distortion in FITS headers between the conventions TAN-SIP and TPV.

SourceExtractor, SCAMP and SWarp read TPV and ignore SIP. SIP distorts pixel coordinates (u, v), which the matrix CD
then maps to the tangent plane. TPV distorts coordinates on the tangent plane. With x = CD (u, v), the SIP polynomials
are rewritten as polynomials of x, and CD is applied to them. This is an exact linear map of the coefficients, and so is
its inverse.

References
----------
Shupe et al. 2005 (SIP); Shupe et al. 2012 (TPV).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from truesky.numerics import matrices
from truesky.render.camera import distortion

Card = tuple[str, Any, str]

CONVENTIONS = ("sip", "tpv")
# Number of the first PV card of each order of the polynomial, 0 to 7. Within an order, the numbers increase with the
# power of the second coordinate. Numbers between the orders are radial terms, which are not used.
_FIRST = (0, 1, 4, 7, 12, 17, 24, 31)


def from_sip(header: Sequence[Card]) -> tuple[Card, ...]:
    """Convert the FITS cards (keyword, value, comment) of a header with SIP distortion to TPV.

    A header without SIP is returned unchanged.

    Raises
    ------
    BadInput
        If the order of the SIP polynomials is more than 7, the highest order of TPV.
    """
    values = {keyword: value for keyword, value, _ in header}
    if not str(values.get("CTYPE1", "")).endswith("-SIP"):
        return tuple(header)
    inverse = matrices.inverse(_cd(values))
    tpv_terms = _change_basis(_sip_coefficients(values, "A"), _sip_coefficients(values, "B"), inverse)
    order = len(tpv_terms[0]) - 1
    if order >= len(_FIRST):
        raise BadInput(f"the distortion is of order {order}: TPV has orders up to {len(_FIRST) - 1}, use SIP instead")
    out: list[Card] = []
    for keyword, value, comment in header:
        if keyword in ("CTYPE1", "CTYPE2"):
            out.append((keyword, f"{str(value)[:5]}TPV", "gnomonic projection, distortion as PV"))
        elif not is_sip(keyword):
            out.append((keyword, value, comment))
        elif keyword == "A_ORDER":
            out += [card for axis in (1, 2) for card in _pv_cards(axis, tpv_terms[axis - 1])]
    return tuple(out)


def to_sip(values: Mapping[str, Any]) -> tuple[Float, Float]:
    """Return the SIP coefficients of a header with TPV distortion, two arrays [n, n] for columns and rows.

    `values` are the values of the header's cards by keyword. Index [p, q] is the coefficient of u^p v^q, with columns u
    and rows v in pixels from the reference pixel (CRPIX).
    """
    polynomials = [_pv_coefficients(values, axis) for axis in (1, 2)]
    side = max(len(each) for each in polynomials)
    to_x, to_y = (np.pad(each, (0, side - len(each))) for each in polynomials)
    # Subtract 1 from the linear terms: TPV polynomials include the identity, SIP polynomials are added to it.
    to_x[1, 0] -= 1.0
    to_y[0, 1] -= 1.0
    return _change_basis(to_x, to_y, _cd(values))


def _change_basis(to_x: Float, to_y: Float, matrix: Float) -> tuple[Float, Float]:
    """Return a distortion (a vector as a polynomial of the position) in other coordinates of the plane.

    `to_x` and `to_y` contain the coefficients of x^p y^q, at index [p, q], of the two components of the distortion.
    `matrix` [2, 2] maps new coordinates to the old ones (x, y). The result are two arrays of coefficients of the new
    coordinates, for the components of the distortion along the new axes.
    """
    terms = tuple(
        (int(p), int(q), float(to_x[p, q]), float(to_y[p, q])) for p, q in np.argwhere((to_x != 0) | (to_y != 0))
    )
    return distortion.sip(terms, matrix) if terms else (np.zeros((2, 2)), np.zeros((2, 2)))


def _cd(values: Mapping[str, Any]) -> Float:
    return np.array([[values["CD1_1"], values["CD1_2"]], [values["CD2_1"], values["CD2_2"]]], float)


def _sip_coefficients(values: Mapping[str, Any], name: str) -> Float:
    side = max(int(values[f"{other}_ORDER"]) for other in "AB") + 1
    return np.array([[float(values.get(f"{name}_{p}_{q}", 0.0)) for q in range(side)] for p in range(side)])


def is_sip(keyword: str) -> bool:
    """Return True if a FITS keyword belongs to a SIP distortion: A_ORDER, B_ORDER, A_p_q or B_p_q."""
    name, *powers = keyword.split("_")
    return name in ("A", "B") and (powers == ["ORDER"] or (len(powers) == 2 and all(p.isdigit() for p in powers)))


def _pv_cards(axis: int, coefficients: Float) -> list[Card]:
    """Return the PV cards (keyword, value, comment) of one axis of a TPV distortion, without coefficients that are 0.

    `axis` is 1 (xi) or 2 (eta). xi and eta are the coordinates on the tangent plane in degrees. `coefficients` [p, q]
    belong to xi^p eta^q in the distortion of this axis. The undistorted coordinate itself is added, because TPV
    polynomials give the whole position.
    """
    full = np.array(coefficients if axis == 1 else coefficients.T)
    full[1, 0] += 1.0
    first, second = ("xi", "eta") if axis == 1 else ("eta", "xi")
    return [
        (f"PV{axis}_{_FIRST[p + q] + q}", float(full[p, q]), f"coefficient of {first}^{p} {second}^{q}")
        for p, q in sorted(np.argwhere(full).tolist(), key=lambda power: _FIRST[sum(power)] + power[1])
    ]


def _pv_coefficients(values: Mapping[str, Any], axis: int) -> Float:
    """Return the coefficients of a header's PV cards for an axis of TPV, 1 or 2, float[n, n]; 0 for missing cards.

    Index [p, q] belongs to xi^p eta^q, with the coordinates xi and eta on the tangent plane in degrees.
    """
    terms = {
        (order - q, q): float(values[key])
        for order, first in enumerate(_FIRST)
        for q in range(order + 1)
        if (key := f"PV{axis}_{first + q}") in values
    }
    side = max((sum(power) for power in terms), default=1) + 1
    out = np.zeros((max(side, 2), max(side, 2)))
    for (p, q), value in terms.items():
        out[p, q] = value
    return out if axis == 1 else np.array(out.T)
