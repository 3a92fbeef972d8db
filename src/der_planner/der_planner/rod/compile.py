"""How the kernels are compiled and when a cached compilation is stale.

Numba checks only the file of a cached function, not the files of the functions that it calls. The
module therefore drops the caches of a whole part when any of its kernels' sources has changed.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

PARTS = [Path(__file__).resolve().parents[1] / name for name in ("rod", "model", "twin")]
"""Folders of the parts of this package that have compiled kernels."""
_FLAGS = {"contract", "reassoc", "nsz", "arcp"}  # NaN must stay visible: it ends an iteration


def drop_stale_caches(folder: Path) -> None:
    """Delete a part's cached kernels if a source of them is not what they were compiled from."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for source in sorted(folder.rglob("*.py")):
        if b"njit" in source.read_bytes() or source.stem.endswith("_kernel"):
            digest.update(source.read_bytes())
    stamp = folder / "__pycache__" / "kernels.sha256"
    with contextlib.suppress(OSError):  # a read-only install: numba then caches elsewhere by itself
        if stamp.exists() and stamp.read_text() == digest.hexdigest():
            return
        stamp.parent.mkdir(exist_ok=True)
        for index in folder.rglob("__pycache__/*.nbi"):
            index.unlink(missing_ok=True)
        stamp.write_text(digest.hexdigest())


for part in PARTS:
    drop_stale_caches(part)


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function with a cache on disk, without the interpreter lock.

    It may not make arrays, and so need not count references to those that it gets: with tuples of
    arrays the counting costs up to a third of a step. The caller keeps them alive.
    """
    return _compile(function, _nrt=False)


def inlined_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `kernel`, put into its callers: a call with tuples of arrays costs as much as its work."""
    return _compile(function, _nrt=False, inline="always")


def allocating_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `kernel`, for a function that makes arrays of its own."""
    return _compile(function, _nrt=True)


def _compile(function: Callable[..., Any], **options: bool | str) -> Callable[..., Any]:
    compiled: Callable[..., Any] = numba.njit(
        cache=True, fastmath=_FLAGS, nogil=True, boundscheck=False, error_model="numpy", **options
    )(function)
    return compiled
