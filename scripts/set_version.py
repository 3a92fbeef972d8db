#!/usr/bin/env python3
"""Give all packages a new version: python3 scripts/set_version.py 0.2.0.

`pyproject.toml` says the version of the project. ROS reads it from each package's `package.xml`,
and `setup.py` takes it from there; this writes all of them.
"""

import re
import sys

from workspace_setup.basics import PACKAGES, ROOT

PLACES = {
    ROOT / "pyproject.toml": r'(?m)^version = "([^"]+)"$',
    **{ROOT / "src" / name / "package.xml": r"<version>([^<]+)</version>" for name in PACKAGES},
}


def versions() -> dict[str, str]:
    """Return the version that each file states, by its path inside the repository.

    Raises:
        ValueError: a file states none; names it.
    """
    found = {}
    for path, pattern in PLACES.items():
        match = re.search(pattern, path.read_text())
        if match is None:
            raise ValueError(f"{path} states no version")
        found[str(path.relative_to(ROOT))] = match[1]
    return found


def main() -> int:
    """Write the version; 2 for one that is not of the form 1.2.3."""
    if sys.argv[1:] in (["-h"], ["--help"]):
        print(__doc__)
        return 0
    if len(sys.argv) != 2 or not re.fullmatch(r"\d+\.\d+\.\d+", sys.argv[1]):
        print("usage: set_version.py MAJOR.MINOR.PATCH, e.g. 0.2.0", file=sys.stderr)
        return 2
    versions()  # all of them state one, or none is changed

    def renewed(old: re.Match[str]) -> str:
        return old[0].replace(old[1], sys.argv[1])

    for path, pattern in PLACES.items():
        path.write_text(re.sub(pattern, renewed, path.read_text(), count=1))
    print("the newest entry of CHANGELOG.md must name it, too")
    return 0


if __name__ == "__main__":
    sys.exit(main())
