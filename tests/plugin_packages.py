"""Plug-in packages that are really installed for this process: a module and a dist-info folder on sys.path."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.project_files import ROOT

GALLERY = ROOT / "services" / "research" / "site" / "gallery"
OWN_SOLVER = (GALLERY / "own_solver.py").read_text(encoding="utf-8")
OWN_EFFECT = (GALLERY / "own_effect.py").read_text(encoding="utf-8")


@contextmanager
def installed(folder: Path, module: str, source: str, group: str, **entries: str) -> Iterator[None]:
    """Install a package `module` with entry points NAME = OBJECT of its module; uninstall it at the end."""
    (folder / f"{module}.py").write_text(source, encoding="utf-8")
    info = folder / f"{module}-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module.replace('_', '-')}\nVersion: 0.1\n")
    declared = "".join(f"{name} = {module}:{target}\n" for name, target in entries.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{declared}")
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        sys.modules.pop(module, None)
