"""Update procedure for the power cut tests, with real RAUC: search, install, restart, settle.

Run as a module; its output marks the progress.
"""

import sys
from pathlib import Path

from services.update.updater import Updater
from tests.appliance.bench import Bench
from tests.appliance.instrument import served
from tests.appliance.releases import Workshop


def run_update(bench: Bench) -> None:
    with served() as page:
        first: Updater = bench.updater("1.0", instrument=page.at)
        with bench.service():
            (found,) = first.search()
            first.install_found(found.id)
        print_mark("installed")
        bench.boot()
        with bench.service():
            bench.updater("2.0", instrument=page.at).settle()
        print_mark("committed")


def print_mark(word: str) -> None:
    print(f"<{word}>", flush=True)  # noqa: T201  # read by the tracing test


if __name__ == "__main__":
    here, keys, loop_a, loop_b, bus = sys.argv[1:]
    run_update(Bench(Path(here), Workshop(Path(keys)), {"A": loop_a, "B": loop_b}, bus=bus))
