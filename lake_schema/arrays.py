"""Short names of array types, and the conversion of NumPy values to Python values."""

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
    """Convert a NumPy scalar to a Python number, text or boolean, and an array to a list.

    Raises
    ------
    TypeError
        If the value is neither a scalar nor an array, or has another type, such as a date.
    """
    # tolist() turns some dates into numbers, so only these kinds are allowed.
    if isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biufU":
        return value.tolist()
    raise TypeError(f"{value!r} is of type {type(value).__name__}")
