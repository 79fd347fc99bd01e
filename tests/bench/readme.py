"""Runs the commands of README's table of what was asked, and looks for the words that it promises: `make readme`."""

import os
import re
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from device.clock import SystemClock
from tests.project_files import BIN, ROOT, text

PROMISED_S = 60.0
TIMEOUT_S = 5 * PROMISED_S  # other processes may hold the cores


@dataclass(frozen=True)
class Row:
    """One row: what was asked, its files, the command, the words that its output must have; `serves` until Ctrl-C."""

    asked: str
    where: tuple[str, ...]
    command: str
    promised: tuple[str, ...]
    serves: bool

    def missing(self, log: Path) -> list[str]:
        """Return the promised words that are not in the output."""
        printed = log.read_text(encoding="utf-8", errors="replace")
        # not within a number: 10 violations are not 0 violations
        return [words for words in self.promised if not re.search(rf"(?<!\d){re.escape(words)}", printed)]


def rows() -> list[Row]:
    """Return the rows of the table; ValueError for one without exactly one command."""
    lines = text("README.md").split("\n## What was asked")[1].split("\n## ")[0].splitlines()
    found = []
    for line in [line for line in lines if line.startswith("|")][2:]:
        asked, where, command, seen = line.strip("|").split(" | ")
        (words,) = _spans(command)
        found.append(Row(asked.strip(), _spans(where), words, _spans(seen), "Ctrl-C" in seen))
    return found


def _spans(cell: str) -> tuple[str, ...]:
    return tuple(re.findall(r"`([^`]+)`", cell))


def run(row: Row, folder: Path, log: Path) -> tuple[int, float]:
    """Run a row's command in a folder; return exit code and seconds.

    Enter answers each question. What serves gets Ctrl-C as soon as the promised words are there.
    """
    clock = SystemClock()
    environment = os.environ | {
        "PATH": f"{BIN}:{os.environ['PATH']}",
        "PORT": str(_free_port()),
        "XDG_DATA_HOME": str(folder / "data"),
        "COLUMNS": "200",
    }
    begin_s = clock.now_s()
    with (
        log.open("w") as output,
        subprocess.Popen(
            ["bash", "-c", row.command],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            process_group=0,
        ) as process,
    ):
        assert process.stdin is not None
        process.stdin.write(b"\n" * 20)
        process.stdin.flush()
        while (
            process.poll() is None and clock.now_s() < begin_s + TIMEOUT_S and not (row.serves and not row.missing(log))
        ):
            clock.sleep(0.2)
        seconds, ended = clock.now_s() - begin_s, process.poll() is not None
        if not ended:
            os.killpg(process.pid, signal.SIGINT)
    return (0 if row.serves and not ended else process.returncode), seconds


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def main() -> int:
    """Run all commands, or those with a word of the command line, in a fresh folder with links to this checkout."""
    chosen = [row for row in rows() if not sys.argv[1:] or any(word in row.command for word in sys.argv[1:])]
    failed = 0
    with TemporaryDirectory() as name:
        for entry in ROOT.iterdir():
            if entry.name != "out":
                (Path(name) / entry.name).symlink_to(entry)
        for row in chosen:
            log = Path(name) / "output.log"
            code, seconds = run(row, Path(name), log)
            missing = row.missing(log)
            failed += bool(code or missing)
            slow = f" (more than {PROMISED_S:.0f} s)" if seconds > PROMISED_S else ""
            print(f"exit {code}  {seconds:5.1f} s{slow}  {row.asked}: {row.command}", flush=True)
            print("".join(f"    not in the output: {words}\n" for words in missing), end="")
            if code or missing:
                print(log.read_text(errors="replace")[-2000:])
    print(f"{len(chosen) - failed} of {len(chosen)} commands ended well and printed what README says")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
