"""Names by content: SHA-256 of files, of the software that computes, and of one result."""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import device
from device.user_files import files_in
from services import archive, research

NUMERICAL_PACKAGES = ("numpy", "scipy", "pyfftw", "numba")
NAME_DIGITS = 32  # hexadecimal digits of the name of a result: 128 bits
_SOURCES = (
    (Path(device.__file__).parent, ("recon/**/*.py", "config/**/*.py", "calibration/**/*.py", "values.py")),
    (Path(research.__file__).parent, ("reconstruct_*.py",)),
    (Path(archive.__file__).parent, ("solve.py", "result.py")),
)


@cache
def software() -> dict[str, str]:
    """Return the versions that decide about the pixels of a result, by name.

    `code` is a digest of the sources of the solvers, because a development version keeps its number.
    """
    digest = hashlib.sha256()
    for folder, patterns in _SOURCES:
        for path in files_in(folder, *patterns):
            digest.update(f"{path.relative_to(folder).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    packages = {name: version(name) for name in NUMERICAL_PACKAGES}
    own = {"diffuscope": version("diffuscope"), "code": digest.hexdigest()[:12]}
    return {**own, "python": platform.python_version(), **packages}


def different_versions(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """Return the differing versions as `name 1 expected, 2 found; ...`; empty if all are equal."""
    names = sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name))
    return "; ".join(f"{name} {expected.get(name, 'none')} expected, {found.get(name, 'none')} found" for name in names)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal; OSError if it cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_of(value: object) -> str:
    """Return the SHA-256 (hexadecimal) of the canonical JSON of a value: sorted keys, no spaces."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def result_name(
    frames: Sequence[Sequence[str]], calibration: str, versions: Mapping[str, str], settings: Mapping[str, object]
) -> str:
    """Return the name of a result, NAME_DIGITS hexadecimal digits.

    `frames`: role, SHA-256 and reason against its use (empty: none) of every frame, with the dark frame;
    `calibration`: digest of its files; `versions` as of `software`; `settings` of the reconstruction. Equal input gives
    the equal name on every machine.
    """
    content = {
        "frames": [list(frame) for frame in frames],
        "calibration": calibration,
        "software": dict(versions),
        "settings": settings,
    }
    return digest_of(content)[:NAME_DIGITS]
