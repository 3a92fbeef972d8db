"""Files that are there whole or not at all, and files of YAML that are read or refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml


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


def read_yaml(
    path: str | Path, what: str, refusal: type[Exception], loader: Any = yaml.SafeLoader
) -> Any:
    """Return the content of a YAML file.

    Args:
        path: of the file.
        what: it is, for the message.
        refusal: error to raise.
        loader: of yaml.

    Raises:
        refusal: it cannot be read or is no YAML; the message names the file and the cause.
    """
    try:
        return yaml.load(Path(path).read_text(encoding="utf-8"), loader)
    except OSError as error:
        raise refusal(f"cannot read {what} {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise refusal(f"{what} {path} is not valid YAML: {error}") from error
