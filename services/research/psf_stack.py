"""Stack of PSFs of `--psf`: files, and folders whose image files are a stack in natural order of their names."""

from collections.abc import Sequence
from pathlib import Path

from device.config.image_files import SUFFIXES
from device.errors import PsfError
from device.user_files import files_in
from services.research.datasets import natural_order
from services.research.reconstruct_inputs import Source


def psf_stack(sources: Sequence[Source]) -> tuple[Source, ...]:
    """Return the sources with its images in place of each folder; PsfError for a folder that holds none.

    Names that begin with a dot are left out: macOS writes a companion of each file on a drive.
    """
    stack: list[Source] = []
    for source in sources:
        stack += _images(source) if isinstance(source, Path) and source.is_dir() else [source]
    return tuple(stack)


def _images(folder: Path) -> list[Path]:
    names = [path.name for path in files_in(folder) if path.suffix.lower() in SUFFIXES]
    if not names:
        raise PsfError(f"the folder {folder} holds no PSF", f"Give a folder of PSFs as {', '.join(SUFFIXES)}.")
    return [folder / name for name in sorted(names, key=natural_order)]
