"""`make bench-frames`: bursts and colours of photographs that move behind the field, by wave optics."""

import sys
from pathlib import Path

from tests.bench.bursts import bursts, dim_bursts, displaced, splits
from tests.bench.colours import colours

PARTS = {"bursts": bursts, "dim": dim_bursts, "displaced": displaced, "splits": splits, "colours": colours}


def main(words: list[str]) -> None:
    """Run the named parts, by default all, on the photographs of the folder that comes first."""
    if not words or not (Path(words[0]) / "fundus").is_dir():
        sys.exit("say where the real data are: DATA=folder, which holds fundus/")
    for name in words[1:] or list(PARTS):
        PARTS[name](Path(words[0]) / "fundus")


if __name__ == "__main__":
    main(sys.argv[1:])
