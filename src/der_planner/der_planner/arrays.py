"""The one type of array in signatures: of float64, its shape in the docstring."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
