"""Short names of NumPy array types for annotations, such as Float, and the conversion of NumPy values to Python."""

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
    """Convert a NumPy scalar to a Python number, str or bool, and an array to a nested list; for example for JSON.

    Raises
    ------
    TypeError
        If the value is neither a NumPy scalar nor an array, or its elements are not booleans, integers, floats or str.
    """
    # Allow booleans, integers, floats and str only: tolist() would turn some dates into numbers.
    if isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biufU":
        return value.tolist()
    raise TypeError(f"{value!r} is of type {type(value).__name__}")
