"""Who beats: the loop that owns the head, and nobody in its stead. Heard on a real socket, as systemd hears it."""

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from services.instrument.serve import handed_over
from services.instrument.watchdog import BEAT_S, Watchdog
from tests.journey.conftest import until


class Ear:
    """The socket that systemd would listen at, always read, as systemd does."""

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        self.heard: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.address)
        self._reader = Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        while (word := self._socket.recv(4096)) != b"enough":
            self.heard.append(word.decode())

    def all_until(self, line: str) -> list[str]:
        """What was heard since this was asked last, once `line` has come."""
        until(lambda: line in self.heard)
        heard, self.heard = self.heard, []
        return heard

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as speaker:
            speaker.sendto(b"enough", self.address)
        self._reader.join()
        self._socket.close()


@pytest.fixture
def ear(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ear]:
    ear = Ear(tmp_path_factory.mktemp("run") / "notify")
    yield ear
    ear.close()


def test_every_word_is_one_datagram_that_systemd_knows(ear: Ear) -> None:
    watchdog = Watchdog(ear.address)
    watchdog.ready()
    watchdog.beat()
    watchdog.status("making\nplans")  # a second line would be a second word
    watchdog.stopping()
    assert ear.all_until("STOPPING=1") == ["READY=1", "WATCHDOG=1", "STATUS=making plans", "STOPPING=1"]


def test_an_abstract_address_is_understood() -> None:
    name = f"diffuscope-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(f"\0{name}")
        Watchdog(f"@{name}").beat()
        assert ear.recv(64) == b"WATCHDOG=1"


def test_where_nobody_listens_nothing_happens(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Watchdog(None).beat()
    assert not caplog.records
    Watchdog(str(tmp_path / "gone")).beat()
    assert "does not hear WATCHDOG=1" in caplog.text


def test_it_is_ready_when_its_plans_are_made_and_says_when_it_ends(make_rig: Any, ear: Ear) -> None:
    rig = make_rig(watchdog=ear.address)
    heard = ear.all_until("STATUS=aim")
    assert heard[:3] == ["STATUS=making plans", "READY=1", "STATUS=aim"]  # and perhaps its first beat
    rig.exam.close()
    ear.all_until("STOPPING=1")


def test_an_idle_owner_beats_all_the_same(make_rig: Any, ear: Ear) -> None:
    make_rig(watchdog=ear.address)
    ear.all_until("STATUS=aim")
    time.sleep(2.5 * BEAT_S)
    assert set(ear.heard) == {"WATCHDOG=1"}
    assert 2 <= len(ear.heard) <= 4


def test_a_picture_in_the_making_beats_between_its_rounds(make_rig: Any, ear: Ear) -> None:
    rig = make_rig(watchdog=ear.address)
    ear.all_until("STATUS=aim")
    kept = rig.exam.press("OD").result(30)
    heard = ear.all_until("STATUS=aim")
    assert heard.count("WATCHDOG=1") > kept.report["rounds"]


def test_a_look_at_a_kept_picture_beats_while_it_lasts(make_rig: Any, ear: Ear) -> None:
    rig = make_rig(watchdog=ear.address)
    ear.all_until("STATUS=aim")
    rig.exam.press("OD").result(30)
    until(lambda: ear.heard.count("STATUS=aim") == 1 and not rig.exam.fitness.due)
    after = ear.heard[ear.heard.index("STATUS=aim") :]
    assert after.count("WATCHDOG=1") > 5  # an idle owner beats once in two seconds


def test_a_hung_owner_beats_no_more_until_it_goes_on(make_rig: Any, ear: Ear) -> None:
    """The web server lives, and so does every other thread: it does not help."""
    rig = make_rig(watchdog=ear.address)
    ear.all_until("STATUS=aim")
    rig.hang()
    answer = rig.exam.press("OD")
    rig.wait_for_hanging()
    heard = len(ear.heard)
    time.sleep(2 * BEAT_S)
    assert len(ear.heard) == heard
    assert rig.request("GET", "/api/status").status_code == 200
    rig.clock.gate.set()
    answer.result(30)
    assert "WATCHDOG=1" in ear.all_until("STATUS=aim")


def test_an_address_handed_over_is_taken_only_by_the_process_that_it_is_meant_for() -> None:
    assert handed_over({}) is None
    assert handed_over({"LISTEN_PID": str(os.getpid() + 1), "LISTEN_FDS": "1"}) is None
    assert handed_over({"LISTEN_PID": str(os.getpid())}) is None
