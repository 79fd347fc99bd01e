"""The victim of power cuts: an update as a technician does it, with real RAUC, from the stick to the commit.

Run as a module it looks, installs what it finds, and settles after a restart; what it says is how far it is.
"""

import sys
from pathlib import Path

from services.update.updater import Updater
from tests.appliance.bench import Bench
from tests.appliance.instrument import served
from tests.appliance.releases import Workshop


def updated(bench: Bench) -> None:
    with served() as page:
        first: Updater = bench.updater("1.0", instrument=page.at)
        with bench.service():
            (found,) = first.look()
            first.install_found(found.id)
        say("installed")
        bench.boot()
        with bench.service():
            bench.updater("2.0", instrument=page.at).settle()
        say("committed")


def say(word: str) -> None:
    print(f"<{word}>", flush=True)  # noqa: T201  # read by whoever traces it


if __name__ == "__main__":
    here, keys, loop_a, loop_b, bus = sys.argv[1:]
    updated(Bench(Path(here), Workshop(Path(keys)), {"A": loop_a, "B": loop_b}, bus=bus))
