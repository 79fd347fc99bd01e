"""PIN authentication: login, lock-out with backoff, idle timeout. Time is virtual."""

import stat
from pathlib import Path

import pytest

from device.clock import VirtualClock
from services.errors import LoginRequired, PinLockedOut, PinWrong, StoreDamaged
from services.http.authentication import IDLE_TIMEOUT_S, MAX_LOCK_OUT_S, PinAuthenticator


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def authenticator(tmp_path: Path, clock: VirtualClock) -> PinAuthenticator:
    return PinAuthenticator(tmp_path / "technician.json", clock)


def test_first_pin_needs_no_login_and_a_change_does(authenticator: PinAuthenticator) -> None:
    assert not authenticator.has_pin
    with pytest.raises(LoginRequired):
        authenticator.log_in("1234")
    token = authenticator.set_pin("1234", None)
    authenticator.renew_login(token)
    with pytest.raises(LoginRequired):
        authenticator.set_pin("9999", None)
    with pytest.raises(LoginRequired):
        authenticator.set_pin("9999", "a guess")
    changed = authenticator.set_pin("56789", token)
    assert changed != token
    with pytest.raises(PinWrong):
        authenticator.log_in("1234")


@pytest.mark.parametrize("pin", ["", "123", "1" * 13, "12a4", "12 4", "１２３４", "-1234"])
def test_invalid_pin_is_refused(authenticator: PinAuthenticator, pin: str) -> None:
    with pytest.raises(PinWrong, match="cannot be a PIN"):
        authenticator.set_pin(pin, None)
    assert not authenticator.has_pin


def test_pin_file_holds_a_salted_hash_readable_by_its_owner_only(tmp_path: Path, clock: VirtualClock) -> None:
    first, second = (PinAuthenticator(tmp_path / name, clock) for name in ("a.json", "b.json"))
    first.set_pin("918273645", None)
    second.set_pin("918273645", None)
    stored = [(tmp_path / name).read_bytes() for name in ("a.json", "b.json")]
    assert stored[0] != stored[1]
    assert not any(b"918273645" in content for content in stored)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o600


def test_pin_survives_a_restart_and_the_login_does_not(tmp_path: Path, clock: VirtualClock) -> None:
    token = PinAuthenticator(tmp_path / "pin.json", clock).set_pin("1234", None)
    restarted = PinAuthenticator(tmp_path / "pin.json", clock)
    with pytest.raises(LoginRequired):
        restarted.require_login(token)
    restarted.require_login(restarted.log_in("1234"))


def test_each_wrong_pin_doubles_the_lock_out_and_a_right_one_resets_it(
    authenticator: PinAuthenticator, clock: VirtualClock
) -> None:
    authenticator.set_pin("1234", None)
    waits_s = []
    for _ in range(11):
        with pytest.raises(PinWrong):
            authenticator.log_in("0000")
        waits_s.append(authenticator.lock_out_s)
        with pytest.raises(PinLockedOut, match="wait"):
            authenticator.log_in("1234")  # the PIN is not checked
        clock.sleep(authenticator.lock_out_s)
    assert waits_s == [1, 2, 4, 8, 16, 32, 64, 128, 256, MAX_LOCK_OUT_S, MAX_LOCK_OUT_S]
    authenticator.log_in("1234")
    assert authenticator.lock_out_s == 0
    with pytest.raises(PinWrong):
        authenticator.log_in("0000")
    assert authenticator.lock_out_s == 1


def test_trying_all_four_digit_pins_takes_a_month(authenticator: PinAuthenticator, clock: VirtualClock) -> None:
    authenticator.set_pin("1234", None)
    begin_s = clock.now_s()
    for _ in range(20):
        with pytest.raises(PinWrong):
            authenticator.log_in("0000")
        clock.sleep(authenticator.lock_out_s)
    after_s = clock.now_s() - begin_s
    assert after_s + (10_000 - 20) * MAX_LOCK_OUT_S > 30 * 86400


def test_login_expires_when_idle_and_reading_does_not_renew_it(
    authenticator: PinAuthenticator, clock: VirtualClock
) -> None:
    token = authenticator.set_pin("1234", None)
    for _ in range(3):
        clock.sleep(IDLE_TIMEOUT_S - 1)
        authenticator.renew_login(token)
    for _ in range(9):
        clock.sleep(IDLE_TIMEOUT_S / 10)
        authenticator.require_login(token)
        assert authenticator.is_logged_in(token)
    clock.sleep(IDLE_TIMEOUT_S / 10)
    with pytest.raises(LoginRequired):
        authenticator.require_login(token)
    with pytest.raises(LoginRequired):
        authenticator.renew_login(token)  # an expired login is not renewed
    assert not authenticator.is_logged_in(token)


def test_new_login_ends_the_previous_one_and_logout_ends_all(authenticator: PinAuthenticator) -> None:
    first = authenticator.set_pin("1234", None)
    second = authenticator.log_in("1234")
    with pytest.raises(LoginRequired):
        authenticator.require_login(first)
    authenticator.require_login(second)
    authenticator.log_out()
    for token in (second, None, ""):
        with pytest.raises(LoginRequired):
            authenticator.require_login(token)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b'{"salt": "00", "hash": 1}', b'{"salt": "xy", "hash": "00"}'])
def test_damaged_pin_file_refuses_login_with_a_remedy(tmp_path: Path, clock: VirtualClock, content: bytes) -> None:
    (tmp_path / "pin.json").write_bytes(content)
    authenticator = PinAuthenticator(tmp_path / "pin.json", clock)
    with pytest.raises(StoreDamaged) as caught:
        authenticator.log_in("1234")
    assert "pin.json" in caught.value.remedy
    with pytest.raises(LoginRequired):
        authenticator.set_pin("1234", None)
