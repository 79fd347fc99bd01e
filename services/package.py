"""Diffuscope: image reconstruction for a lensless funduscope, from one raw frame to a picture of the retina.

    import diffuscope
    scene = diffuscope.simulate("healthy")
    made = diffuscope.reconstruct(scene.raw, scene.psf, head=scene)
    made.picture, made.report

The wheel installs this module as `diffuscope/__init__.py`; the packages `device` and `services` hold the program.
`__version__` is the installed version. A name is imported at its first use, so that `import diffuscope` is fast.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from device.errors import DiffuscopeError, FrameError, PsfError, SettingError, SpecError
    from device.recon.methods import Method
    from services.research.dataset_pairs import Dataset, Pair
    from services.research.datasets import open_dataset
    from services.research.frontier_result import Frontier
    from services.research.python_api import (
        ForwardModel,
        ReconstructionOptions,
        Reconstructor,
        SimulatedScene,
        frontier,
        methods,
        reconstruct,
        simulate,
    )
    from services.research.reconstruct_file import FileReconstruction, FileReport

__all__ = [
    "Dataset",
    "DiffuscopeError",
    "FileReconstruction",
    "FileReport",
    "ForwardModel",
    "FrameError",
    "Frontier",
    "Method",
    "Pair",
    "PsfError",
    "ReconstructionOptions",
    "Reconstructor",
    "SettingError",
    "SimulatedScene",
    "SpecError",
    "__version__",
    "frontier",
    "methods",
    "open_dataset",
    "reconstruct",
    "simulate",
]
__version__ = version("diffuscope")

_MODULES = {
    "device.errors": ("DiffuscopeError", "FrameError", "PsfError", "SettingError", "SpecError"),
    "device.recon.methods": ("Method",),
    "services.research.dataset_pairs": ("Dataset", "Pair"),
    "services.research.datasets": ("open_dataset",),
    "services.research.frontier_result": ("Frontier",),
    "services.research.python_api": (
        "ForwardModel",
        "ReconstructionOptions",
        "Reconstructor",
        "SimulatedScene",
        "frontier",
        "methods",
        "reconstruct",
        "simulate",
    ),
    "services.research.reconstruct_file": ("FileReconstruction", "FileReport"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> object:
    """Import a public name at its first use."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'diffuscope' has no attribute {name!r}")
    found: object = vars(import_module(_MODULE_OF[name]))[name]
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
