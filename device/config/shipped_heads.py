"""Head files and light path that come with the program: their folder, and a head by its name.

In a checkout they are at the top level, in a wheel in the package `diffuscope`.
"""

import difflib
from pathlib import Path

from device.errors import SpecError
from device.user_files import files_in

_BESIDE = Path(__file__).parents[2]
_INSTALLED = _BESIDE / "diffuscope"
ROOT = _INSTALLED if _INSTALLED.is_dir() else _BESIDE
HEADS = ROOT / "hardware" / "heads"
LIGHT_PATH = ROOT / "hardware" / "optics.toml"


def head_path(name: str, folder: Path) -> Path:
    """Return the file of the shipped head of that name, or a TOML file, `name` relative to `folder`.

    SpecError for an unknown name, with the closest known one.
    """
    if name.endswith(".toml"):
        return folder / name
    known = [path.stem for path in files_in(HEADS, "*.toml")]
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}, or the path of a .toml file"
        raise SpecError(f"no head is called {name!r}; {hint}")
    return HEADS / f"{name}.toml"
