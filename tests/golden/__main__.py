"""Command line of the golden records.

python -m tests.golden write [NAME ...]       rewrite these records (all, without a name)
python -m tests.golden mutants [--only N]     apply each seeded mutant to a copy of the tree and run its tests
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from tests.golden import (
    bus,
    command_line,
    error_codes,
    exam,
    files,
    http_transcript,
    mutants,
    reconstructions,
    scenes,
)

RECORDS: dict[str, Callable[[], Path]] = {
    "http": http_transcript.write,
    "cli": command_line.write,
    "errors": error_codes.write,
    "scenes": scenes.write,
    "reconstructions": reconstructions.write,
    "exam": exam.write,
    "bus": bus.write,
    "files": files.write,
}


def main() -> int:
    """Run one of the two commands; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description="Golden records and seeded mutants.")
    commands = parser.add_subparsers(dest="command", required=True)
    write = commands.add_parser("write", help="write records anew")
    write.add_argument("names", nargs="*", choices=[[], *RECORDS], metavar="NAME", help=", ".join(RECORDS))
    mutate = commands.add_parser("mutants", help="run the tests against each seeded mutant")
    mutate.add_argument("--only", type=int, action="append", metavar="N", help="just this mutant; may be repeated")
    words = parser.parse_args()
    if words.command == "mutants":
        return mutants.run(words.only)
    for name in words.names or RECORDS:
        sys.stdout.write(f"{RECORDS[name]()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
