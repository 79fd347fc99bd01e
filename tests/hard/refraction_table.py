"""Table of the refraction's coverage in CASES.md: `python -m tests.hard.refraction_table OUTPUT...`.

OUTPUT are files with what `make bench-refraction` printed. The rows by light and by object of each group are copied.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

CASES = Path(__file__).parent / "CASES.md"
BEGIN = "<!-- refraction: made by python -m tests.hard.refraction_table from the output of make bench-refraction -->"
END = "<!-- end of refraction -->"
HEAD = (
    "| sensor and field | by | value | frames | refused | RMS M, dpt | below 1 sd | below 2 sd |",
    "|---|---|---|---|---|---|---|---|",
)
GROUP = re.compile(
    r"(?:ok|MISS)\s+(\S+) M: (\d+) frames, RMS (\S+) .*below 2 sd (\S+) .*below 1 sd (\S+) .*refused (\S+)"
)


def rows(output: str) -> Iterator[str]:
    """Yield the rows of the table: of each group of frames the whole, then its rows by light and by object."""
    found: list[str] = []
    for line in output.splitlines():
        if re.match(r"\| (light|object) \|", line):
            found.append(line)
        elif group := GROUP.match(line):
            name, frames, rms, within, near, refused = group.groups()
            yield f"| {name} | all | | {frames} | {refused} | {rms} | {near} | {within} |"
            yield from (f"| {name} {row}" for row in found)
            found = []


def with_table(document: str, output: str) -> str:
    """Return the document with its table replaced."""
    table = "\n".join([BEGIN, *HEAD, *rows(output), END])
    return re.sub(f"{re.escape(BEGIN)}.*{re.escape(END)}", lambda _: table, document, flags=re.S)


if __name__ == "__main__":
    printed = "\n".join(Path(name).read_text(encoding="utf-8") for name in sys.argv[1:])
    CASES.write_text(with_table(CASES.read_text(encoding="utf-8"), printed), encoding="utf-8")
