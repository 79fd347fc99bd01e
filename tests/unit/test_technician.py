"""The technician's door: who gets in, who has to wait, and when it shuts by itself. Time is virtual."""

import stat
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import PinTooSoon, PinWrong, StoreDamaged, TechnicianLocked
from services.instrument.technician import IDLE_S, LONGEST_WAIT_S, Door


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def door(tmp_path: Path, clock: VirtualClock) -> Door:
    return Door(tmp_path / "technician.json", clock)


def test_the_first_pin_is_set_by_whoever_comes_first_and_later_ones_from_inside(door: Door) -> None:
    assert not door.has_pin
    with pytest.raises(TechnicianLocked):
        door.unlock("1234")
    token = door.set_pin("1234", None)
    door.touch(token)
    with pytest.raises(TechnicianLocked):
        door.set_pin("9999", None)
    with pytest.raises(TechnicianLocked):
        door.set_pin("9999", "a guess")
    changed = door.set_pin("56789", token)
    assert changed != token
    with pytest.raises(PinWrong):
        door.unlock("1234")


@pytest.mark.parametrize("pin", ["", "123", "1" * 13, "12a4", "12 4", "１２３４", "-1234"])
def test_what_is_no_pin_is_refused(door: Door, pin: str) -> None:
    with pytest.raises(PinWrong, match="cannot be a PIN"):
        door.set_pin(pin, None)
    assert not door.has_pin


def test_only_a_salted_hash_is_kept_for_the_owner_alone(tmp_path: Path, clock: VirtualClock) -> None:
    first, second = (Door(tmp_path / name, clock) for name in ("a.json", "b.json"))
    first.set_pin("1234", None)
    second.set_pin("1234", None)
    kept = [(tmp_path / name).read_bytes() for name in ("a.json", "b.json")]
    assert kept[0] != kept[1]
    assert not any(b"1234" in content for content in kept)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o600


def test_the_pin_outlives_the_process_and_the_way_in_does_not(tmp_path: Path, clock: VirtualClock) -> None:
    token = Door(tmp_path / "pin.json", clock).set_pin("1234", None)
    anew = Door(tmp_path / "pin.json", clock)
    with pytest.raises(TechnicianLocked):
        anew.refuse_strangers(token)
    anew.refuse_strangers(anew.unlock("1234"))


def test_every_wrong_pin_doubles_the_wait_and_a_right_one_ends_it(door: Door, clock: VirtualClock) -> None:
    door.set_pin("1234", None)
    waits_s = []
    for _ in range(11):
        with pytest.raises(PinWrong):
            door.unlock("0000")
        waits_s.append(door.wait_s)
        with pytest.raises(PinTooSoon, match="wait"):
            door.unlock("1234")  # not even looked at
        clock.sleep(door.wait_s)
    assert waits_s == [1, 2, 4, 8, 16, 32, 64, 128, 256, LONGEST_WAIT_S, LONGEST_WAIT_S]
    door.unlock("1234")
    assert door.wait_s == 0
    with pytest.raises(PinWrong):
        door.unlock("0000")
    assert door.wait_s == 1


def test_all_guesses_of_four_digits_would_take_a_month(door: Door, clock: VirtualClock) -> None:
    door.set_pin("1234", None)
    begin_s = clock.now_s()
    for _ in range(20):
        with pytest.raises(PinWrong):
            door.unlock("0000")
        clock.sleep(door.wait_s)
    after_s = clock.now_s() - begin_s
    assert after_s + (10_000 - 20) * LONGEST_WAIT_S > 30 * 86400


def test_it_shuts_when_nobody_does_anything_and_looking_on_is_not_doing(door: Door, clock: VirtualClock) -> None:
    token = door.set_pin("1234", None)
    for _ in range(3):
        clock.sleep(IDLE_S - 1)
        door.touch(token)
    for _ in range(9):
        clock.sleep(IDLE_S / 10)
        door.refuse_strangers(token)
        assert door.knows(token)
    clock.sleep(IDLE_S / 10)
    with pytest.raises(TechnicianLocked):
        door.refuse_strangers(token)
    with pytest.raises(TechnicianLocked):
        door.touch(token)  # it does not open again by itself
    assert not door.knows(token)


def test_the_last_one_in_is_the_only_one_and_who_goes_out_stays_out(door: Door) -> None:
    first = door.set_pin("1234", None)
    second = door.unlock("1234")
    with pytest.raises(TechnicianLocked):
        door.refuse_strangers(first)
    door.refuse_strangers(second)
    door.lock()
    for token in (second, None, ""):
        with pytest.raises(TechnicianLocked):
            door.refuse_strangers(token)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b'{"salt": "00", "hash": 1}', b'{"salt": "xy", "hash": "00"}'])
def test_a_damaged_pin_file_lets_nobody_in_and_says_what_to_do(
    tmp_path: Path, clock: VirtualClock, content: bytes
) -> None:
    (tmp_path / "pin.json").write_bytes(content)
    door = Door(tmp_path / "pin.json", clock)
    with pytest.raises(StoreDamaged) as caught:
        door.unlock("1234")
    assert "pin.json" in caught.value.remedy
    with pytest.raises(TechnicianLocked):
        door.set_pin("1234", None)
