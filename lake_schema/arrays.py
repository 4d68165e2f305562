"""Names of array types, and numpy's values as Python's."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex128]
Complex64 = npt.NDArray[np.complex64]
Int = npt.NDArray[np.int64]
Int32 = npt.NDArray[np.int32]
UInt32 = npt.NDArray[np.uint32]
Bool = npt.NDArray[np.bool_]
Array = npt.NDArray[Any]


def as_python(value: object) -> Any:
    """Convert a numpy scalar to a number, text or boolean of Python, and an array to a list.

    Raises
    ------
    TypeError
        If it is neither, or holds other values.
    """
    # Dates would become numbers.
    if isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biufU":
        return value.tolist()
    raise TypeError(f"{value!r} is of type {type(value).__name__}")
