"""Table of the users, set-up code, lock-out and logins. Time is virtual."""

import stat
from math import inf
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import InputError, StoreReadOnly
from services import cli
from services.errors import ConfirmationRequired, LoginRequired, RecordNotFound, StoreDamaged
from services.identity.lock_out import MAX_OWN_SCREEN_WAIT_S, MAX_WAIT_S, LockOut
from services.identity.logins import CONFIRMED_S, IDLE_LOCK_S, MAX_LOGIN_S, MAX_LOGINS, Logins
from services.identity.setup_code import SetupCode
from services.identity.users import UserTable

PIN, PASSPHRASE = "274913", "a blue boat in May"


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def users(tmp_path: Path) -> UserTable:
    table = UserTable(tmp_path / "access")
    table.add("Asha", PIN, ["administrator", "screener"])
    return table


def test_a_user_is_found_by_name_and_secret_and_by_nothing_else(users: UserTable, tmp_path: Path) -> None:
    users.add("Ravi Kumar", PASSPHRASE, ["reader"])
    found = users.verify(" ravi kumar ", PASSPHRASE)
    assert found is not None
    assert (found.name, found.roles) == ("Ravi Kumar", {"reader"})
    for name, secret in (("Ravi Kumar", PIN), ("Asha", PASSPHRASE), ("Unknown", PIN), ("Asha", "")):
        assert users.verify(name, secret) is None
    content = (tmp_path / "access/users.json").read_text()
    assert PASSPHRASE not in content
    assert "$argon2id$" in content
    assert {stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "access").iterdir()} == {0o600}


@pytest.mark.parametrize("weak", ["12345", "000000", "123456", "987654", "890123", "short", "aaaaaaaaaaaa", "x" * 201])
def test_a_weak_secret_is_refused(users: UserTable, weak: str) -> None:
    with pytest.raises(InputError, match="too easy"):
        users.add("Ravi", weak, ["reader"])
    with pytest.raises(InputError, match="too easy"):
        users.change("Asha", secret=weak)


@pytest.mark.parametrize("name", ["", "  ", "x" * 41, "a\nb", "asha", "ASHA"])
def test_a_name_that_is_invalid_or_used_is_refused(users: UserTable, name: str) -> None:
    with pytest.raises(InputError):
        users.add(name, PIN, ["reader"])


def test_there_is_always_an_administrator(tmp_path: Path, users: UserTable) -> None:
    with pytest.raises(InputError, match="administrator"):
        UserTable(tmp_path / "new").add("Ravi", PIN, ["screener"])
    for change in (lambda: users.remove("Asha"), lambda: users.change("Asha", roles=["screener"])):
        with pytest.raises(InputError, match="administrator"):
            change()
    assert not UserTable(tmp_path / "new").has_begun


def test_a_copy_in_memory_takes_no_change(users: UserTable, tmp_path: Path) -> None:
    """Of a disk that takes no changes: they would be gone after the next start."""
    copy = UserTable(tmp_path / "access", refusal=StoreReadOnly("the disk is read-only"))
    assert copy.verify("Asha", PIN) is not None
    for change in (
        lambda: copy.add("Ravi", PIN, ["reader"]),
        lambda: copy.change("Asha", secret=PASSPHRASE),
        lambda: copy.remove("Asha"),
    ):
        with pytest.raises(StoreReadOnly, match="read-only"):
            change()
    assert users.verify("Asha", PIN) is not None


def test_an_unknown_user_cannot_be_changed(users: UserTable) -> None:
    for change in (lambda: users.remove("Ravi"), lambda: users.change("Ravi", secret=PIN)):
        with pytest.raises(RecordNotFound):
            change()


@pytest.mark.parametrize("damage", ["bit", "half", "gone"])
def test_a_damaged_table_admits_nobody_and_opens_no_set_up(users: UserTable, tmp_path: Path, damage: str) -> None:
    file = tmp_path / "access/users.json"
    content = bytearray(file.read_bytes())
    file.unlink()
    if damage == "bit":
        content[len(content) // 2] ^= 1
    if damage != "gone":
        file.write_bytes(content[: len(content) // 2] if damage == "half" else content)
    for table in (users, UserTable(tmp_path / "access")):
        assert table.has_begun
        with pytest.raises(StoreDamaged):
            table.verify("Asha", PIN)
        with pytest.raises(StoreDamaged):
            table.add("Eve", PIN, ["administrator"])


def test_a_set_up_code_is_valid_for_two_minutes_in_any_spelling(tmp_path: Path, clock: VirtualClock) -> None:
    page, label = SetupCode(tmp_path / "tls", clock), SetupCode(tmp_path / "tls", clock)
    assert not page.is_valid("")
    code = label.create()
    assert stat.S_IMODE((tmp_path / "tls/setup-code").stat().st_mode) == 0o640
    clock.sleep(119.0)
    assert page.is_valid(f" {code[:4].lower()}-{code[4:]} ")
    assert not page.is_valid(code[:-1])
    assert not page.is_valid("")
    clock.sleep(1.0)
    assert not page.is_valid(code)
    newer = label.create()
    assert page.is_valid(newer)
    assert not page.is_valid(code)


def test_a_set_up_code_ends_with_the_fifth_wrong_try_and_with_the_boot(tmp_path: Path, clock: VirtualClock) -> None:
    codes = SetupCode(tmp_path, clock)
    code = codes.create()
    assert [codes.is_valid(wrong) for wrong in ("AAAAAAAA", "", "1", code[:-1])] == [False] * 4
    assert codes.is_valid(code)
    assert not codes.is_valid("BBBBBBBB")
    assert not codes.is_valid(code)
    assert codes.is_valid(codes.create())
    (tmp_path / "setup-code").write_text(f"{code} another-boot {clock.now_s() + 60}")
    assert not codes.is_of_this_boot
    assert not codes.is_valid(code)


def test_a_used_set_up_code_stays_ended_in_a_restarted_server(tmp_path: Path, clock: VirtualClock) -> None:
    console, server = SetupCode(tmp_path / "tls", clock), SetupCode(tmp_path / "tls", clock, tmp_path)
    code = console.create(inf)
    assert server.is_valid(code)
    server.end()
    for restarted in (server, SetupCode(tmp_path / "tls", clock, tmp_path)):
        assert not restarted.is_valid(code)
    assert server.is_valid(console.create())


def test_the_code_of_the_console_is_valid_until_a_label_replaces_it(tmp_path: Path, clock: VirtualClock) -> None:
    codes = SetupCode(tmp_path, clock)
    assert not codes.is_of_this_boot
    of_console = codes.create(inf)
    clock.sleep(86_400.0)
    assert codes.is_of_this_boot
    assert codes.is_valid(of_console)
    codes.create()
    assert not codes.is_valid(of_console)


def test_each_wrong_attempt_doubles_the_wait_of_account_and_address(tmp_path: Path, clock: VirtualClock) -> None:
    lock_out = LockOut(tmp_path, clock)
    waits_s = []
    for _ in range(11):
        lock_out.record_failure("asha", "10.0.0.7")
        waits_s.append(lock_out.wait_s("asha", "10.0.0.7", False))
        clock.sleep(waits_s[-1])
    assert waits_s == [1, 2, 4, 8, 16, 32, 64, 128, 256, MAX_WAIT_S, MAX_WAIT_S]
    lock_out.record_failure("asha", "10.0.0.7")
    assert lock_out.wait_s("asha", "10.0.0.8", False) == MAX_WAIT_S  # the account
    assert lock_out.wait_s("ravi", "10.0.0.7", False) == MAX_WAIT_S  # the address
    assert lock_out.wait_s("ravi", "10.0.0.8", False) == 0
    assert lock_out.wait_s("asha", "own screen", True) == MAX_OWN_SCREEN_WAIT_S


def test_the_wait_survives_a_restart_and_damage_is_a_full_wait(tmp_path: Path, clock: VirtualClock) -> None:
    lock_out = LockOut(tmp_path, clock)
    for _ in range(7):
        lock_out.record_failure("asha", "10.0.0.7")
    restarted = LockOut(tmp_path, VirtualClock())
    assert restarted.wait_s("asha", "10.0.0.9", False) == 64
    restarted.record_success("asha", "10.0.0.7")
    assert LockOut(tmp_path, VirtualClock()).wait_s("asha", "10.0.0.7", False) == 0
    (tmp_path / "lock-out.json").write_bytes(b"{}")
    assert LockOut(tmp_path, VirtualClock()).wait_s("ravi", "10.0.0.9", False) == MAX_WAIT_S


def test_wrong_attempts_of_others_are_no_wait_where_a_user_signed_in_before(
    tmp_path: Path, clock: VirtualClock
) -> None:
    """Also after a restart. Own wrong attempts count there, and those of others count on at all other addresses."""
    LockOut(tmp_path, clock).record_success("asha", "10.0.0.9")
    lock_out = LockOut(tmp_path, clock)
    for number in range(1000):
        lock_out.record_failure("asha", f"10.0.0.{number % 8}")
    assert lock_out.wait_s("asha", "10.0.0.9", False) == 0
    assert lock_out.wait_s("asha", "10.0.0.10", False) == MAX_WAIT_S
    lock_out.record_success("asha", "10.0.0.9")
    assert lock_out.wait_s("asha", "10.0.0.10", False) == MAX_WAIT_S, "a sign-in gives others no further guesses"
    lock_out.record_failure("asha", "10.0.0.9")
    assert lock_out.wait_s("asha", "10.0.0.9", False) == 1


def test_a_thousand_guesses_take_three_days(tmp_path: Path, clock: VirtualClock) -> None:
    lock_out, begun_s = LockOut(tmp_path, clock), clock.now_s()
    for number in range(1000):
        address = f"10.0.0.{number % 250}"
        clock.sleep(lock_out.wait_s("asha", address, False))
        lock_out.record_failure("asha", address)
    assert clock.now_s() - begun_s > 3 * 86_400


def test_a_login_ends_idle_by_age_by_sign_out_and_with_a_change_of_its_user(
    users: UserTable, clock: VirtualClock
) -> None:
    logins = Logins(users, clock)
    asha = users.find("Asha")
    assert asha is not None
    idle, used, ended, changed = (logins.begin(asha) for _ in range(4))
    assert logins.user("a guess") is None
    assert logins.user(None) is None
    logins.end(ended)
    clock.sleep(IDLE_LOCK_S / 2)
    assert logins.user(idle) == logins.user(used, acts=True) == logins.user(changed, acts=True) == asha
    clock.sleep(IDLE_LOCK_S / 2)
    assert logins.user(idle) is None
    assert logins.user(ended) is None
    assert logins.user(used) == asha
    users.change("Asha", roles=["administrator"])
    assert logins.user(changed) is None
    lasting = logins.begin(users.users()[0])
    for _ in range(int(MAX_LOGIN_S / IDLE_LOCK_S) * 2 - 1):
        clock.sleep(IDLE_LOCK_S / 2)
        assert logins.user(lasting, acts=True) is not None
    clock.sleep(IDLE_LOCK_S / 2)
    assert logins.user(lasting, acts=True) is None


def test_a_login_of_a_removed_user_stays_ended_when_the_name_is_given_again(
    users: UserTable, clock: VirtualClock
) -> None:
    logins = Logins(users, clock)
    token = logins.begin(users.add("Ravi", PIN, ["reader"]))
    users.remove("Ravi")
    users.add("Ravi", PASSPHRASE, ["technician"])
    assert logins.user(token) is None


def test_a_reset_by_an_administrator_is_not_overwritten_by_the_users_own_change(users: UserTable) -> None:
    """The reset comes between the check of the old PIN and the change to the new one."""
    asha = users.verify("Asha", PIN)
    assert asha is not None
    users.change("Asha", secret=PASSPHRASE)
    with pytest.raises(LoginRequired):
        users.change("Asha", secret="567390", generation=asha.generation)
    assert users.verify("Asha", PASSPHRASE) is not None


def test_many_logins_of_one_user_end_none_of_another(users: UserTable, clock: VirtualClock) -> None:
    logins = Logins(users, clock)
    asha, ravi = users.users()[0], users.add("Ravi", PIN, ["reader"])
    kept = logins.begin(asha)
    tokens = [logins.begin(ravi) for _ in range(150)]
    assert logins.user(kept) == asha
    assert [logins.user(token) for token in (tokens[0], tokens[-MAX_LOGINS])] == [None, ravi]


def test_a_risk_needs_the_secret_of_the_last_minutes(users: UserTable, clock: VirtualClock) -> None:
    logins = Logins(users, clock)
    token = logins.begin(users.users()[0])
    logins.require_confirmed(token)
    clock.sleep(CONFIRMED_S / 2)
    logins.user(token, acts=True)
    clock.sleep(CONFIRMED_S / 2)
    with pytest.raises(ConfirmationRequired):
        logins.require_confirmed(token)
    logins.confirm(token)
    logins.require_confirmed(token)
    logins.end(token)
    with pytest.raises(LoginRequired):
        logins.require_confirmed(token)


def test_the_command_adds_lists_and_resets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secret = tmp_path / "secret"
    secret.write_text(f"{PIN}\n")
    data = ["--data", str(tmp_path)]

    def run(*words: str) -> tuple[object, str]:
        with pytest.raises(SystemExit) as ended:
            cli.main(["users", *words, *data])
        shown = capsys.readouterr()
        return ended.value.code, shown.out + shown.err

    assert "`diffuscope label`" in run("list")[1]
    assert run("add", "Asha", "--role", "reader", "--secret-file", str(secret))[0] == 2
    assert run("add", "Asha", "--role", "pilot", "--secret-file", str(secret))[0] == 2
    assert run("add", "Asha", "--role", "administrator", "--secret-file", str(secret))[0] == 0
    assert run("list") == (0, "Asha: administrator\n")
    secret.write_text(PASSPHRASE)
    running = UserTable(tmp_path / "access")
    assert running.verify("Asha", PIN) is not None
    assert run("reset", "Asha", "--secret-file", str(secret))[0] == 0
    assert running.verify("Asha", PIN) is None
    assert running.verify("Asha", PASSPHRASE) is not None
    assert run("reset", "Ravi", "--secret-file", str(secret))[0] == 2
