"""Compare what is installed with .ci/requirements.txt: versions of packages, and files with the hashes of their wheels.

Asks nobody. What is not pinned is listed; a version or a file that differs ends it with exit code 1. Known
vulnerabilities are another matter: `pip-audit -r .ci/requirements.txt` asks a database for those.
"""

import sys
from base64 import urlsafe_b64encode
from collections.abc import Iterator
from hashlib import file_digest
from importlib.metadata import Distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_PINS = Path(__file__).with_name("requirements.txt")
_OWN = {"sliplens", "uv", "pip", "setuptools"}
"""This project, and what a virtual environment begins with."""


def pinned() -> dict[str, str]:
    """Versions by package, of this machine and Python."""
    lines = (line.removesuffix("\\").strip() for line in _PINS.read_text(encoding="utf-8").splitlines())
    wanted = (Requirement(line) for line in lines if line and not line.startswith(("#", "--hash")))
    return {
        canonicalize_name(one.name): str(one.specifier).removeprefix("==")
        for one in wanted
        if one.marker is None or one.marker.evaluate()
    }


def changed_files(package: Distribution) -> Iterator[str]:
    """Files that are not as their wheel had them; compiled and generated ones have no hash there."""
    for file in package.files or []:
        path = Path(str(file.locate()))
        if file.hash is None:
            continue
        if not path.is_file():
            yield f"{path} is missing"
            continue
        with path.open("rb") as stream:
            found = urlsafe_b64encode(file_digest(stream, file.hash.mode).digest()).rstrip(b"=").decode()
        if found != file.hash.value:
            yield f"{path} is not as it was installed"


def main() -> int:
    """Print what differs."""
    pins, troubles = pinned(), list[str]()
    installed = {canonicalize_name(one.name): one for one in distributions()}
    for name, version in pins.items():
        if name not in installed:
            troubles.append(f"{name} {version} is not installed")
        elif installed[name].version != version:
            troubles.append(f"{name} is {installed[name].version}, pinned is {version}")
    for package in installed.values():
        troubles += changed_files(package)
    others = sorted(set(installed) - set(pins) - _OWN)
    print("\n".join(troubles) or f"{len(pins)} packages are as they are pinned, and their files as they were installed")
    if others:
        print(f"not pinned: {', '.join(others)}")
    return 1 if troubles else 0


if __name__ == "__main__":
    sys.exit(main())
