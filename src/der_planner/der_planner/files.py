"""Files that are there whole or not at all."""

from __future__ import annotations

from pathlib import Path


def write_whole(path: str | Path, text: str) -> None:
    """Write a text file, also in place of an older one, whole or not at all.

    Its folder is made if it is missing.

    Raises:
        OSError: it cannot be written there.
    """
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_name(f".{file.name}.part")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(file)
