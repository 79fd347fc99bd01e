"""`python -m hardware.parts`: write the printed parts and the plate of lenslets, or the pictures of the guides."""

import argparse
from pathlib import Path

from hardware.parts.dimensions import OPTICS, dimensions
from hardware.parts.export import export
from hardware.parts.lens_plate import HEAD, export_plate, lens_plate


def main() -> None:
    """What `make parts` and `make part-pictures` call."""
    words = argparse.ArgumentParser(prog="python -m hardware.parts", description=__doc__)
    words.add_argument("what", choices=("export", "pictures"))
    words.add_argument("folder", type=Path)
    words.add_argument("--optics", type=Path, default=OPTICS, help="another light path")
    words.add_argument("--lenslets", type=Path, default=HEAD, help="another head with a plate of lenslets")
    asked = words.parse_args()
    d = dimensions(asked.optics)
    if asked.what == "export":
        files = export(d, asked.folder) + export_plate(lens_plate(d, asked.lenslets), asked.folder)
    else:
        from hardware.parts.pictures import pictures

        files = pictures(d, asked.folder)
    print(f"{len(files)} files in {asked.folder}, for {d.path.name}")  # noqa: T201


if __name__ == "__main__":
    main()
