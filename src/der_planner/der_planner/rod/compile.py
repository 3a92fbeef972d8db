"""How the kernels are compiled and when a cached compilation is stale.

Numba checks only the file of a cached function, not the files of the functions that it calls. The
decorator here therefore drops the caches of the whole package when any kernel source has changed.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_FOLDER = Path(__file__).resolve().parent
_FLAGS = {"contract", "reassoc", "nsz", "arcp"}  # NaN must stay visible: it ends an iteration


def drop_stale_caches() -> None:
    """Delete cached kernels if any kernel source is not the one that they were compiled from."""
    digest = hashlib.sha256()
    for source in sorted(_FOLDER.glob("*_kernel.py")):
        digest.update(source.read_bytes())
    stamp = _FOLDER / "__pycache__" / "kernels.sha256"
    with contextlib.suppress(OSError):  # a read-only install: numba then caches elsewhere by itself
        if stamp.exists() and stamp.read_text() == digest.hexdigest():
            return
        stamp.parent.mkdir(exist_ok=True)
        for index in stamp.parent.glob("*_kernel.*.nbi"):
            index.unlink(missing_ok=True)
        stamp.write_text(digest.hexdigest())


drop_stale_caches()


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function with a cache on disk, without the interpreter lock."""
    compiled: Callable[..., Any] = numba.njit(
        cache=True, fastmath=_FLAGS, nogil=True, boundscheck=False, error_model="numpy"
    )(function)
    return compiled
