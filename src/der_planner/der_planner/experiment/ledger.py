"""What of an experiment is done already: one small file a trial, so that a stopped one goes on."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from der_planner.experiment.errors import OptionError
from der_planner.experiment.options import Options, Trial


class Ledger:
    """The finished trials of one experiment folder.

    Args:
        options: of the experiment; a finished trial counts only if it was played with the same.
    """

    def __init__(self, options: Options) -> None:
        self._folder = options.out / "trials"
        self._settings = _settings(options)

    def finished(self, trial: Trial) -> dict[str, Any] | None:
        """Return what `record` kept of this trial, or None if it is still to be played.

        Raises:
            OptionError: the folder holds this trial played with other options.
        """
        path = self._folder / f"{trial.name}.json"
        if not path.exists():
            return None
        kept = json.loads(path.read_text())
        wanted = {**self._settings, "seed": trial.seed}
        for key, value in wanted.items():
            if kept["settings"].get(key, "") != value:
                raise OptionError(
                    f"{path.parent.parent} holds {trial.name} with {key} = "
                    f"{kept['settings'].get(key)}, not {value}: choose another --out"
                )
        return dict(kept["result"])

    def record(self, trial: Trial, result: dict[str, Any]) -> None:
        """Keep the result of a finished trial."""
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"{trial.name}.json"
        unfinished = path.with_suffix(".part")
        settings = {**self._settings, "seed": trial.seed}
        unfinished.write_text(json.dumps({"settings": settings, "result": result}, indent=1))
        os.replace(unfinished, path)


def _settings(options: Options) -> dict[str, Any]:
    return {
        "amplitude": options.amplitude,
        "period": options.period,
        "cycles": options.cycles,
        "limb_sha256": _digest(options.limb),
        "path_sha256": _digest(options.path),
        "mounting": options.mounting,
        "payload": options.payload or "",
        "payload_at": options.payload_at or "",
        "calibrate": options.calibrate,
        "offline": options.offline,
        "hardware": options.hardware.driver.get("port") if options.hardware else "",
    }


def _digest(path: Path | None) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path is not None else ""
