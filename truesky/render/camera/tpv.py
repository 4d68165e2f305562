"""Conversion of world coordinate systems between TAN-SIP and TPV.

SourceExtractor, SCAMP and SWarp read TPV and ignore SIP. SIP distorts pixels (u, v), which the matrix CD maps to the
tangent plane; TPV distorts the tangent plane. With x = CD (u, v), the SIP polynomials are rewritten in x and CD is
applied to them. This is an exact linear map of coefficients, and so is its inverse.

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
# Number of the first PV card of each order. Within an order, numbers increase with the power of the second coordinate.
# The numbers between the orders are radial terms, which are not used.
_FIRST = (0, 1, 4, 7, 12, 17, 24, 31)


def from_sip(header: Sequence[Card]) -> tuple[Card, ...]:
    """Convert the cards of a header from SIP to TPV; a header without SIP is returned unchanged.

    Raises
    ------
    BadInput
        If the order of the polynomial is higher than TPV allows.
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
    """SIP coefficients [n, n] of u^p v^q, for columns and rows, of a header with PV cards."""
    polynomials = [_pv_coefficients(values, axis) for axis in (1, 2)]
    side = max(len(each) for each in polynomials)
    to_x, to_y = (np.pad(each, (0, side - len(each))) for each in polynomials)
    # SIP has no identity term, but the linear terms of TPV include it.
    to_x[1, 0] -= 1.0
    to_y[0, 1] -= 1.0
    return _change_basis(to_x, to_y, _cd(values))


def _change_basis(to_x: Float, to_y: Float, matrix: Float) -> tuple[Float, Float]:
    """Write polynomials that are added to a vector in another basis; matrix [2, 2] maps new to old coordinates."""
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
    """Return True if the card belongs to a SIP distortion."""
    name, *powers = keyword.split("_")
    return name in ("A", "B") and (powers == ["ORDER"] or (len(powers) == 2 and all(p.isdigit() for p in powers)))


def _pv_cards(axis: int, coefficients: Float) -> list[Card]:
    """PV cards of an axis, including the identity, without terms that are 0; the coordinate of the axis comes first."""
    full = np.array(coefficients if axis == 1 else coefficients.T)
    full[1, 0] += 1.0
    first, second = ("xi", "eta") if axis == 1 else ("eta", "xi")
    return [
        (f"PV{axis}_{_FIRST[p + q] + q}", float(full[p, q]), f"coefficient of {first}^{p} {second}^{q}")
        for p, q in sorted(np.argwhere(full).tolist(), key=lambda power: _FIRST[sum(power)] + power[1])
    ]


def _pv_coefficients(values: Mapping[str, Any], axis: int) -> Float:
    """Coefficients [n, n] by the powers of the first and second coordinate."""
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
