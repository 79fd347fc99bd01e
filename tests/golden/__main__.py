"""Program of the golden records.

python -m tests.golden write [NAME ...]       write these records anew (all, without a name)
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from tests.golden import collected_tests, command_line, error_codes, http_transcript

RECORDS: dict[str, Callable[[], Path]] = {
    "http": http_transcript.write,
    "cli": command_line.write,
    "errors": error_codes.write,
    "tests": collected_tests.write,
}


def main() -> int:
    """Run one of the commands; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description="Golden records.")
    commands = parser.add_subparsers(dest="command", required=True)
    write = commands.add_parser("write", help="write records anew")
    write.add_argument("names", nargs="*", choices=[[], *RECORDS], metavar="NAME", help=", ".join(RECORDS))
    words = parser.parse_args()
    for name in words.names or RECORDS:
        sys.stdout.write(f"{RECORDS[name]()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
