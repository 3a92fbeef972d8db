"""Files that are there whole or not at all; YAML, written, and read or refused by name."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray


class _Dumper(yaml.SafeDumper):
    """Writes numbers of numpy as numbers."""


_Dumper.add_multi_representer(np.floating, lambda dumper, n: dumper.represent_float(float(n)))


def write_whole(path: str | Path, text: str) -> None:
    """Write a text file, also in place of an older one, whole or not at all.

    Its folder is made if it is missing.

    Raises:
        OSError: it cannot be written there.
    """
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_name(f".{file.name}.part")
    try:
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(file)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(file)) from error


def write_columns(path: str | Path, columns: Mapping[str, NDArray[np.float64]]) -> None:
    """Write a table (CSV), as `write_whole` does: under each name its column (K,)."""
    text, table = io.StringIO(), np.column_stack(list(columns.values()))
    np.savetxt(text, table, delimiter=",", header=",".join(columns), comments="", fmt="%.10g")
    write_whole(path, text.getvalue())


def yaml_text(content: Any, **style: Any) -> str:
    """Return content as YAML, keys in their order; ``style`` is that of `yaml.dump`."""
    text: str = yaml.dump(content, Dumper=_Dumper, sort_keys=False, **style)
    return text


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
