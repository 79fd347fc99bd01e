"""`diffuscope run` after SIGTERM or SIGINT: clean shutdown with a checkpointed write-ahead log (WAL)."""

import signal
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from tests.journey.test_cli_server import Server


def stop(process: subprocess.Popen[bytes], number: signal.Signals) -> int:
    process.send_signal(number)
    return process.wait(30)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_sigterm_and_sigint_exit_with_0_and_checkpoint_the_database(
    served_head: Path, environment: dict[str, str], tmp_path: Path, number: signal.Signals
) -> None:
    server, data = Server(served_head, tmp_path / "data", environment), tmp_path / "data"
    with server.running() as process:
        visit = server.ask("POST", "/api/visits", {"key": "0" * 16})["id"]
        server.ask("PATCH", f"/api/visits/{visit}", {"key": "f" * 16, "field": "consent", "value": "agreed"})
        press = {"eye": "OD", "key": "1" * 16, "visit": visit, "slot": "R-centre"}
        kept = server.ask("POST", "/api/captures", press)["id"]
        assert stop(process, number) == 0, server.output()
    assert sorted(path.name for path in data.glob("store.sqlite*")) == ["store.sqlite"]
    with closing(sqlite3.connect(f"file:{data / 'store.sqlite'}?mode=ro&immutable=1", uri=True)) as tables:
        assert tables.execute("SELECT id FROM captures").fetchall() == [(kept,)]
        assert tables.execute("SELECT visit FROM capture_slots").fetchall() == [(visit,)]
    with server.running():
        assert server.listed() == [kept]
        assert server.ask("GET", f"/api/visits/{visit}")["slots"]["R-centre"]["capture"] == kept
    assert "Traceback" not in server.output()
