"""Access control: every endpoint with every role, without a login, and with an ended one; set-up and users."""

import asyncio
import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from copy import copy
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.responses import PlainTextResponse

from device.clock import VirtualClock
from device.sim.chips import SimButton
from device.sim.world import World
from device.values import Calibration
from services.delivery.uploader import HttpsUploader, UploadSettings
from services.errors import AuthenticationError
from services.health.clock_request import REQUEST
from services.http.access import OPERATIONS, Access
from services.http.app import create_app
from services.http.audit_trail import REPEATED
from services.http.authentication import OWN_SCREEN, PRESSED_S, Authenticator, Peer
from services.http.rate_limits import RATES
from services.http.security import SAFE_METHODS
from services.identity.logins import IDLE_LOCK_S
from services.identity.setup_code import SetupCode
from services.identity.ssh_keys import decisions, fingerprint
from services.identity.users import ROLES, Role
from services.records.audit_log import AuditLog
from services.records.capture_journal import CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore
from services.records.patient_keys import ids_in_files
from tests.golden import http_transcript
from tests.journey.conftest import MakeRig, Rig, read_event_stream, until

PIN = "274913"
AWAY, HERE = ("10.42.0.7", 50000), ("127.0.0.1", 50000)
REFUSED = {401: {"access.none", "access.setup", "access.confirm"}, 403: {"access.role"}}


def ask(
    app: Any, method: str, path: str, token: str | None = None, client: tuple[str, int] = AWAY, **options: Any
) -> httpx.Response:
    """Send one request from another address, with a login if there is one."""

    async def send() -> httpx.Response:
        transport = httpx.ASGITransport(app=app, client=client)
        headers = {"X-Controller": "test"} | ({} if token is None else {"Cookie": f"login={token}"})
        async with httpx.AsyncClient(transport=transport, base_url="http://diffuscope.local", timeout=30) as browser:
            return await browser.request(method, path, headers=headers | options.pop("headers", {}), **options)

    return asyncio.run(send())


def is_refused(answer: httpx.Response) -> bool:
    """Return whether access control refused a request; a file or another problem is none of its answers."""
    is_problem = answer.headers.get("content-type", "").startswith("application/json")
    code = answer.json().get("code") if is_problem else None
    return code in REFUSED.get(answer.status_code, set())


@pytest.fixture(scope="module")
def rig(build: Callable[..., Rig], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """An instrument with one user of each role."""
    with ExitStack() as undo:
        rig = build(tmp_path_factory.mktemp("access"), undo, wait=False)
        add_users(rig)
        yield rig


def add_users(rig: Rig) -> None:
    """Add one user of each role, which is the name too; the first user must be an administrator."""
    for role in ("administrator", *ROLES[:3]):
        rig.authenticator.users.add(role, PIN, [role])


def tokens(rig: Rig) -> dict[str, str]:
    """Return a login of each user, which has the name of the role."""
    return {role: rig.authenticator.sign_in(role, PIN, OWN_SCREEN) for role in ROLES}


def filled(path: str) -> str:
    """Return the path with a value for each parameter, of a record that does not exist."""
    for name, value in {"{id}": "none", "{name}": "none.png", "{eye}": "OD", "{name:path}": "none"}.items():
        path = path.replace(name, value)
    return path


def test_every_operation_is_in_the_table_and_nothing_else_is() -> None:
    """The document names each endpoint but itself."""
    served = [*operations(http_transcript.openapi()), ("GET", "/api/openapi.json")]
    assert {operation for operation in OPERATIONS if " /api/" in operation} == {" ".join(one) for one in served}


def operations(document: dict[str, Any]) -> list[tuple[str, str]]:
    """Return method and path of every operation of an OpenAPI document."""
    return [(verb.upper(), path) for path, verbs in document["paths"].items() for verb in verbs]


def test_each_operation_admits_its_roles_and_refuses_all_others(rig: Rig) -> None:
    """Try each operation as each role, without a login, and with a login that was guessed, expired or revoked."""
    signed_in, wrong, tried = tokens(rig), [], 0
    clock = VirtualClock()
    ended = Authenticator(rig.store.folder.parent / "access", clock)
    expired, revoked = (ended.sign_in("screener", PIN, OWN_SCREEN) for _ in range(2))
    ended.logins.end(revoked)
    clock.sleep(IDLE_LOCK_S)
    assert ended.user(expired, OWN_SCREEN) is ended.user(revoked, OWN_SCREEN) is None
    left_out = [("GET", "/api/events"), ("DELETE", "/api/login")]  # a stream; and the end of the login that is tried
    pages = [("GET", path) for path in ("/", "/technician", "/web/{name:path}", "/api/openapi.json")]
    for verb, path in [one for one in operations(rig.app.openapi()) if one not in left_out] + pages:
        rule, _ = OPERATIONS[f"{verb} {path}"]
        others = {"none": None, "guessed": "a" * 43, "expired": expired, "revoked": revoked}
        for name, token in (signed_in | others).items():
            if not admits(rule, name) or name == "administrator" or verb in SAFE_METHODS:
                tried += 1
                at = filled(path) if name == "technician" else filled(path).replace("preview", "preview?visit=none")
                if admits(rule, name) == is_refused(ask(rig.app, verb, at, token, json=body(verb))):
                    wrong.append((verb, path, name))
    assert wrong == []
    assert tried > 350


def body(verb: str) -> Any:
    return None if verb in SAFE_METHODS else {}


def admits(rule: Access, name: str) -> bool:
    return rule.from_anywhere or name in rule.roles


def test_an_operation_without_a_row_is_refused_at_run_time(rig: Rig) -> None:
    rig.app.add_api_route("/api/unknown", lambda: "served", methods=["GET"])
    rig.app.add_route("/api/plain", lambda _: PlainTextResponse("served"))
    rig.app.mount("/api/mounted", PlainTextResponse("served"))
    try:
        for path in ("/api/unknown", "/api/plain", "/api/mounted/"):
            for verb in ("GET", "HEAD"):
                answer = ask(rig.app, verb, path, tokens(rig)["administrator"])
                assert answer.status_code == 403
                assert b"served" not in answer.content
    finally:
        del rig.app.router.routes[-3:]


def test_the_device_itself_reads_status_and_health_and_nothing_else(rig: Rig) -> None:
    for path in ("/api/status", "/api/health"):
        assert ask(rig.app, "GET", path, client=HERE).status_code == 200
        assert is_refused(ask(rig.app, "GET", path))
        assert is_refused(ask(rig.app, "GET", path, client=HERE, headers={"X-Forwarded-For": "10.42.0.7"}))
    assert is_refused(ask(rig.app, "GET", "/api/visits", client=HERE))


def test_captures_are_told_to_users_who_may_read_them(build: Callable[..., Rig], tmp_path: Path) -> None:
    """Interrupted captures and alerts in the status, and events; the device itself reads its status without a login."""
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as store:
        CaptureJournal(store).begin(InterruptedCapture("20260301T120000-OD-ab", "OD"), "0" * 16)
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        add_users(rig)
        rig.event_bus.publish("verdict", id="none", word="poor", code="shot.dark", numbers={})
        rig.event_bus.publish("state", state="making")
        signed_in = tokens(rig)
        shown = {name: bool(ask(rig.app, "GET", "/api/status", signed_in[name]).json()["swept"]) for name in ROLES}
        assert shown == {name: name != "administrator" for name in ROLES}
        for token, is_told in ((None, False), (signed_in["screener"], True)):
            assert bool(ask(rig.app, "GET", "/api/status", token, HERE).json()["swept"]) == is_told
        for name in ROLES:
            headers = {"Cookie": f"login={signed_in[name]}", "Host": "diffuscope.local", "Last-Event-ID": "0"}
            stream = read_event_stream(rig.app, lambda got: got[-1:] and got[-1][2] == {"state": "making"}, headers)
            kinds = {kind for _, kind, _ in asyncio.run(stream)}
            assert ("verdict" in kinds) == (name != "administrator")


def test_the_upload_queue_tells_patient_numbers_to_users_who_may_read_visits(
    build: Callable[..., Rig], tmp_path: Path
) -> None:
    uploader = HttpsUploader(UploadSettings(address="https://127.0.0.1:9/", token=tmp_path / "none"))
    with ExitStack() as undo:
        rig = build(tmp_path, undo, wait=False, carrier=uploader)
        add_users(rig)
        signed_in, keys = tokens(rig), iter("0123")

        def post(path: str, verb: str = "POST", **body: str) -> dict[str, Any]:
            answer = ask(rig.app, verb, path, signed_in["screener"], json={"key": next(keys) * 16, **body})
            return dict(answer.json())

        visit = post("/api/visits")
        post(f"/api/visits/{visit['id']}", "PATCH", field="consent", value="declined")
        post(f"/api/visits/{visit['id']}/finish")
        for name in ROLES:
            (waiting,) = ask(rig.app, "GET", "/api/upload-queue", signed_in[name]).json()["visits"]
            assert waiting["number"] == (visit["number"] if name in ("screener", "reader") else None)
        retried = ask(rig.app, "POST", "/api/upload-queue/retry", signed_in["technician"], json={"key": "9" * 16})
        assert [one["number"] for one in retried.json()["visits"]] == [None]


@pytest.fixture
def fresh(build: Callable[..., Rig], tmp_path: Any) -> Iterator[Rig]:
    with ExitStack() as undo:
        yield build(tmp_path, undo, wait=False)


def test_light_for_a_visit_is_the_screeners_and_a_test_picture_the_technicians(fresh: Rig) -> None:
    add_users(fresh)
    signed_in = tokens(fresh)
    picture: dict[str, Any] = {"eye": "OD", "key": "0" * 16}
    for_visit = picture | {"visit": "none", "slot": "R-centre"}
    for role, body, path in (
        ("screener", picture, "/api/preview"),
        ("technician", for_visit, "/api/preview?visit=none"),
    ):
        assert is_refused(ask(fresh.app, "POST", "/api/captures", signed_in[role], json=body))
        assert is_refused(ask(fresh.app, "GET", path, signed_in[role]))
    assert ask(fresh.app, "POST", "/api/captures", signed_in["screener"], json=for_visit).status_code == 404
    assert fresh.world.illumination is None


def test_the_demonstration_ends_for_good_with_the_first_user(fresh: Rig) -> None:
    state = ask(fresh.app, "GET", "/api/login", client=HERE).json()
    assert (state["user"]["is_demo"], "administrator" in state["user"]["roles"]) == (True, False)
    assert ask(fresh.app, "GET", "/api/visits", client=HERE).status_code == 200
    assert is_refused(ask(fresh.app, "GET", "/api/visits"))
    assert is_refused(ask(fresh.app, "GET", "/api/users", client=HERE))
    fresh.authenticator.users.add("Asha", PIN, ["administrator"])
    (fresh.store.folder.parent / "access" / "users.json").unlink()
    for client in (HERE, AWAY):
        assert ask(fresh.app, "GET", "/api/visits", client=client).status_code in (401, 500)
        assert ask(fresh.app, "GET", "/api/login", client=client).json()["needs_setup"] is False
        answer = ask(fresh.app, "POST", "/api/login", client=client, json={"name": "Asha", "secret": PIN})
        assert (answer.status_code, answer.json()["code"]) == (500, "store.damaged")


def test_set_up_signs_in_the_first_administrator_once(fresh: Rig) -> None:
    code = SetupCode(fresh.store.folder.parent / "access", fresh.clock).create()
    asha = {"name": "Asha", "secret": PIN}
    wrong = ask(fresh.app, "POST", "/api/setup", json=asha | {"code": "AAAA-AAAA"})
    assert (wrong.status_code, wrong.json()["code"]) == (403, "access.wrong")
    early = ask(fresh.app, "POST", "/api/setup", json=asha | {"code": code})
    assert (early.status_code, early.json()["code"], early.headers["Retry-After"]) == (429, "access.wait", "1")
    fresh.clock.sleep(1)
    assert ask(fresh.app, "POST", "/api/setup", json=asha | {"code": code, "secret": "123456"}).status_code == 422
    done = ask(fresh.app, "POST", "/api/setup", json=asha | {"code": code})
    assert done.json()["user"] == {"name": "Asha", "roles": list(ROLES), "is_demo": False}
    cookie = done.headers["set-cookie"].lower()
    assert all(part in cookie for part in ("login=", "httponly", "samesite=strict", "path=/"))
    assert "max-age" not in cookie
    again = ask(fresh.app, "POST", "/api/setup", client=HERE, json=asha | {"code": code})
    assert (again.status_code, again.json()["code"]) == (403, "access.wrong"), "a code is used once"


@pytest.fixture
def handle(template: tuple[World, Calibration]) -> World:
    """The world of a button, which no test of the head changes."""
    return copy(template[0])


def test_a_forgotten_administrator_needs_code_and_button(make_rig: MakeRig, handle: World, tmp_path: Path) -> None:
    rig = make_rig(head=lambda head: replace(head, button=SimButton(handle)))
    add_users(rig)
    earlier, folder = tokens(rig)["administrator"], rig.store.folder.parent / "access"
    log = AuditLog(tmp_path, b"k" * 32, rig.clock)
    app = create_app(rig.arbiter, rig.authenticator, audit_log=log).http
    code, new = SetupCode(folder, rig.clock).create(), {"name": "Administrator", "secret": "918274"}

    def asked(client: tuple[str, int] = AWAY, **more: str) -> tuple[int, str]:
        answer = ask(app, "POST", "/api/setup", client=client, json=new | {"code": code} | more)
        return answer.status_code, answer.json().get("code", "")

    assert [asked(), asked(HERE), asked(code="WRONG")] == [(403, "access.presence")] * 3, "no button was pressed"
    handle.pressed_since_s = rig.clock.now_s()
    until(lambda: rig.arbiter.pressed_s == 0)
    rig.clock.sleep(PRESSED_S + 1)
    assert asked() == (403, "access.presence"), "the press was too long ago"
    handle.pressed_since_s = rig.clock.now_s()
    until(lambda: rig.arbiter.pressed_s == 0)
    assert asked(code="WRONG") == (403, "access.wrong")
    rig.clock.sleep(1)
    assert asked(secret="123456") == (422, "input")
    assert asked(name="reader") == (422, "input"), "a user without administration"
    assert ask(app, "GET", "/api/users", earlier).status_code == 200
    assert asked() == (200, "")
    assert ask(app, "GET", "/api/users", earlier).status_code == 401
    user = rig.authenticator.users.verify("administrator", "918274")
    assert user is not None
    assert user.roles == {"administrator"}
    assert asked(secret="482915") == (403, "access.wrong"), "a code is used once"
    entries = log.entries(100, action="reset-administrator")
    assert [entry.more["status"] for entry in entries].count("200") == 1
    assert len(entries) == 9


@pytest.mark.parametrize("has_button", [True, False])
def test_a_key_for_ssh_is_confirmed_at_the_device_by_an_administrator(
    make_rig: MakeRig, handle: World, tmp_path: Path, has_button: bool
) -> None:
    rig = make_rig(head=lambda head: replace(head, button=SimButton(handle) if has_button else None))
    add_users(rig)
    log, key = AuditLog(tmp_path, b"k" * 32, rig.clock), "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJcPFbe me@laptop"
    (tmp_path / "run/diffuscope-settings").mkdir(parents=True)
    (tmp_path / "run/diffuscope-settings/ssh-keys.json").write_text(json.dumps([key]))
    app, login = create_app(rig.arbiter, rig.authenticator, audit_log=log, system=tmp_path).http, tokens(rig)
    (listed,) = ask(app, "GET", "/api/ssh-keys", login["administrator"]).json()["keys"]
    assert listed == {"fingerprint": fingerprint(key), "comment": "me@laptop", "confirmed": None}

    def decided(client: tuple[str, int], confirmed: bool = True, shown: str = listed["fingerprint"]) -> tuple[int, Any]:
        body = {"fingerprint": shown, "confirmed": confirmed}
        answer = ask(app, "POST", "/api/ssh-keys", login["administrator"], client, json=body).json()
        return answer.get("code"), [one["confirmed"] for one in answer.get("keys", ())]

    assert decided(AWAY) == ("access.presence", [])
    if has_button:
        assert decided(HERE) == ("access.presence", []), "no button was pressed"
        handle.pressed_since_s = rig.clock.now_s()
        until(lambda: rig.arbiter.pressed_s == 0)
    present = AWAY if has_button else HERE
    assert decided(present, shown="SHA256:other") == ("store.unknown", [])
    assert decisions(rig.store.folder) == {}
    assert decided(present) == (None, [True])
    assert decided(present, confirmed=False) == (None, [False])
    assert decisions(rig.store.folder) == {fingerprint(key): False}
    entries = [entry for entry in log.entries(9, action="decide-ssh-key") if entry.more["status"] == "200"]
    assert [(entry.user, entry.record, entry.more["field"]) for entry in entries] == [
        ("administrator", fingerprint(key), "refused"),
        ("administrator", fingerprint(key), "confirmed"),
    ]


def test_without_a_button_the_screen_of_the_device_creates_a_further_administrator(fresh: Rig) -> None:
    add_users(fresh)
    code = SetupCode(fresh.store.folder.parent / "access", fresh.clock).create()
    asha = {"name": "Asha", "secret": PIN, "code": code}
    away = ask(fresh.app, "POST", "/api/setup", json=asha)
    assert (away.status_code, away.json()["code"]) == (403, "access.presence")
    assert "screen of the device" in away.json()["remedy"]
    done = ask(fresh.app, "POST", "/api/setup", client=HERE, json=asha)
    assert done.json()["user"]["roles"] == list(ROLES)
    assert [user.name for user in fresh.authenticator.users.users()][:2] == ["administrator", "Asha"]


def test_a_thousand_wrong_codes_end_the_code_and_are_in_the_audit_log(fresh: Rig, tmp_path: Path) -> None:
    """One each second, from two addresses; the right code is then refused, and a new label is accepted."""
    log = AuditLog(tmp_path, b"k" * 32, fresh.clock)
    app = create_app(fresh.arbiter, fresh.authenticator, audit_log=log).http
    codes = SetupCode(fresh.store.folder.parent / "access", fresh.clock)
    code, asha = codes.create(), {"name": "Asha", "secret": PIN}
    answers: Counter[str] = Counter()
    for number in range(1000):
        if number % 100 == 0:
            code = codes.create()
        answer = ask(app, "POST", "/api/setup", client=(AWAY, HERE)[number % 2], json=asha | {"code": f"WRONG{number}"})
        answers[answer.json()["code"]] += 1
        fresh.clock.sleep(1)
    assert set(answers) == {"access.wrong", "access.wait"}
    assert answers["access.wrong"] < 30, "the wait doubles"
    fresh.clock.sleep(300)
    assert ask(app, "POST", "/api/setup", client=HERE, json=asha | {"code": code}).status_code == 403
    assert len(log.entries(2000, action="set-up")) == 1001
    fresh.clock.sleep(300)
    assert ask(app, "POST", "/api/setup", client=HERE, json=asha | {"code": codes.create()}).status_code == 200


def test_over_tls_the_cookie_is_bound_to_the_host(fresh: Rig) -> None:
    fresh.authenticator.users.add("Asha", PIN, ["administrator"])

    async def cookie() -> str:
        transport = httpx.ASGITransport(app=fresh.app, client=AWAY)
        async with httpx.AsyncClient(transport=transport, base_url="https://diffuscope.local") as browser:
            answer = await browser.post("/api/login", json={"name": "Asha", "secret": PIN})
            return answer.headers["set-cookie"]

    made = asyncio.run(cookie())
    assert made.startswith("__Host-login=")
    assert "Secure" in made


def test_a_user_is_managed_and_signed_out_by_each_change(fresh: Rig) -> None:
    users, app = fresh.authenticator.users, fresh.app
    users.add("Asha", PIN, ["administrator"])
    asha = fresh.authenticator.sign_in("Asha", PIN, OWN_SCREEN)
    ravi: dict[str, Any] = {"name": "Ravi", "secret": PIN, "roles": ["screener"]}
    assert ask(app, "POST", "/api/users", asha, json=ravi).status_code == 201
    assert ask(app, "POST", "/api/users", asha, json=ravi).status_code == 422

    def sign_in(secret: str = PIN) -> str:
        return str(ask(app, "POST", "/api/login", json={"name": "ravi", "secret": secret}).cookies["login"])

    def reads(token: str) -> bool:
        return ask(app, "GET", "/api/visits", token).status_code == 200

    changes: tuple[tuple[Role, ...], ...] = (("reader",), ("technician",))
    for roles in changes:
        token = sign_in()
        assert reads(token)
        assert ask(app, "PATCH", "/api/users/Ravi", asha, json={"roles": roles}).status_code == 200
        assert not reads(token)
    ask(app, "PATCH", "/api/users/Ravi", asha, json={"secret": "918274", "roles": ["reader"]})
    token = sign_in("918274")
    other = sign_in("918274")
    changed = ask(app, "PUT", "/api/login/secret", token, json={"secret": "918274", "new": PIN})
    assert not reads(token)
    assert not reads(other)
    token = changed.cookies["login"]
    assert reads(token)
    assert ask(app, "DELETE", "/api/users/Ravi", asha).json()["users"][0]["name"] == "Asha"
    assert not reads(token)
    assert ask(app, "DELETE", "/api/users/Asha", asha).status_code == 422


def test_a_risk_needs_the_secret_again_and_polling_does_not_extend_a_login(fresh: Rig) -> None:
    users, app = fresh.authenticator.users, fresh.app
    users.add("Asha", PIN, ["administrator", "screener"])
    token = fresh.authenticator.sign_in("Asha", PIN, OWN_SCREEN)
    fresh.clock.sleep(IDLE_LOCK_S - 1)
    assert ask(app, "POST", "/api/login/activity", token).status_code == 200
    fresh.clock.sleep(1)
    late = ask(app, "GET", "/api/users", token)
    assert (late.status_code, late.json()["code"]) == (401, "access.confirm")
    assert ask(app, "POST", "/api/login/confirm", token, json={"secret": "000000"}).status_code == 403
    fresh.clock.sleep(1)
    assert ask(app, "POST", "/api/login/confirm", token, json={"secret": PIN}).status_code == 200
    assert ask(app, "GET", "/api/users", token).status_code == 200
    for _ in range(3):
        fresh.clock.sleep(IDLE_LOCK_S / 3)
        ask(app, "GET", "/api/visits", token)
        ask(app, "POST", "/api/controller", token, json={"key": "0" * 16})
    assert is_refused(ask(app, "GET", "/api/visits", token))


def test_an_event_stream_ends_with_its_login(fresh: Rig) -> None:
    fresh.authenticator.users.add("Asha", PIN, ["reader", "administrator"])
    token = fresh.authenticator.sign_in("Asha", PIN, OWN_SCREEN)
    cookie = {"Cookie": f"login={token}", "Host": "diffuscope.local"}

    def sign_out() -> None:
        fresh.authenticator.logins.end(token)

    received = asyncio.run(read_event_stream(fresh.app, lambda _: False, cookie, begin=sign_out))
    assert len(received) <= 2


def test_a_remote_client_cannot_keep_the_device_locked(fresh: Rig) -> None:
    """1,000 wrong attempts from the network; at the device itself the user waits at most a minute."""
    fresh.authenticator.users.add("Asha", PIN, ["administrator"])
    answers = set()
    for _ in range(1000):
        try:
            fresh.authenticator.sign_in("Asha", "000000", Peer("10.42.0.7", False))
        except AuthenticationError as refused:
            answers.add(refused.code)
        fresh.clock.sleep(1)
    assert answers == {"access.wrong", "access.wait"}
    assert fresh.authenticator.wait_s("Asha", OWN_SCREEN) <= 60
    fresh.clock.sleep(60)
    here = ask(fresh.app, "POST", "/api/login", client=HERE, json={"name": "Asha", "secret": PIN})
    assert here.status_code == 200


@pytest.mark.parametrize("operation", RATES)
def test_operations_are_limited_in_rate(operation: str, fresh: Rig) -> None:
    """Beyond the burst a request waits for its interval; another user, or another address, does not wait."""
    for name in ("Asha", "Ravi"):
        fresh.authenticator.users.add(name, PIN, ROLES)
    tokens = [fresh.authenticator.sign_in(name, PIN, OWN_SCREEN) for name in ("Asha", "Ravi")]
    rate, (verb, path) = RATES[operation], operation.split()
    app = create_app(fresh.arbiter, fresh.authenticator).http

    def ask_as(token: str, client: tuple[str, int] = AWAY) -> tuple[int, float | None]:
        answer = ask(app, verb, path, token, client, json={})  # an empty body is refused after the count
        return answer.status_code, answer.json().get("wait_s")

    assert 429 not in {ask_as(tokens[0])[0] for _ in range(rate.burst)}
    assert ask_as(tokens[0]) == (429, rate.interval_s)
    assert ask_as(tokens[1], HERE)[0] != 429
    fresh.clock.sleep(rate.interval_s)
    assert ask_as(tokens[0])[0] != 429
    assert ask_as(tokens[0])[0] == 429


def test_the_time_of_a_tablet_is_accepted_forward_and_an_administrator_sets_it_back(fresh: Rig, tmp_path: Path) -> None:
    """The request for the unit that sets the clock, and an entry with both times."""
    log, request = AuditLog(tmp_path, b"k" * 32, fresh.clock), tmp_path / REQUEST
    fresh.clock.start += timedelta(days=60)  # after the earliest possible date
    app = create_app(fresh.arbiter, fresh.authenticator, audit_log=log, system=tmp_path).http
    fresh.authenticator.users.add("Asha", PIN, ["administrator"])
    fresh.authenticator.users.add("Ravi", PIN, ["reader"])
    asha, ravi = (fresh.authenticator.sign_in(name, PIN, OWN_SCREEN) for name in ("Asha", "Ravi"))
    request.parent.mkdir(parents=True)
    present = fresh.clock.wall()
    later, earlier = ((present + timedelta(days=days)).isoformat() for days in (9, -9))

    def ask_as(token: str, now: str, path: str = "/api/clock") -> tuple[int, str | None]:
        answer = ask(app, "POST", path, token, json={"key": "0" * 16, "now": now})
        return answer.status_code, answer.json().get("code")

    assert ask_as(ravi, earlier) == (409, "clock.back")
    assert ask_as(ravi, earlier, "/api/clock/back")[0] == 403
    assert not request.exists()
    assert ask_as(ravi, later) == (200, None)
    assert datetime.fromisoformat(request.read_text()) == present + timedelta(days=9)
    assert ask_as(asha, earlier, "/api/clock/back") == (200, None)
    assert request.read_text().startswith("back ")
    fields = [(entry.user, entry.action, entry.more["field"]) for entry in log.entries(2)]
    both = f"{present.isoformat()} "
    assert fields == [("Asha", "set-clock-back", both + earlier), ("Ravi", "set-clock", both + later)]


def test_each_change_of_data_is_recorded() -> None:
    """Without an action: answers of the instrument, the next step of an action, a sign that the user is there."""
    unrecorded = {operation for operation, (_, action) in OPERATIONS.items() if action is None}
    assert {operation for operation in unrecorded if not operation.startswith("GET ")} == {
        "POST /api/login/activity",
        "POST /api/calibration/ready",
        "POST /api/calibration/trial-lenses/ready",
    }
    assert {action for _, action in OPERATIONS.values()} >= REPEATED


def test_actions_enter_the_audit_log_before_their_answer(fresh: Rig, tmp_path: Path) -> None:
    """Sign-in, its failure, view, change, refused light: user, record, field, no value; a stranger fills no disk."""
    log = AuditLog(tmp_path, b"k" * 32, fresh.clock)
    app = create_app(fresh.arbiter, fresh.authenticator, audit_log=log, system=tmp_path).http
    fresh.authenticator.users.add("Asha", PIN, ROLES)
    ask(app, "POST", "/api/login", json={"name": "Asha", "secret": "000000"})
    fresh.clock.sleep(1)
    token = ask(app, "POST", "/api/login", json={"name": "Asha", "secret": PIN}).cookies["login"]
    begun = ask(app, "POST", "/api/visits", token, json={"key": "0" * 16}).json()
    visit, number = begun["id"], begun["number"]
    at = f"/api/visits/{visit}"
    ask(app, "PATCH", at, token, json={"key": "1" * 16, "field": "name", "value": "Meena K."})
    for _ in range(3):
        ask(app, "GET", at, token)
    ask(app, "POST", "/api/captures", token, json={"key": "2" * 16, "eye": "OD", "visit": visit, "slot": "R-centre"})
    for _ in range(3):
        ask(app, "GET", at)
        ask(app, "GET", "/api/visits", token)
        ask(app, "GET", "/api/visits/none", token)
        ask(app, "POST", "/api/visits", token, headers={"Host": "evil.example"})
    found = [(one.user, one.action, one.record, one.more.get("field"), one.more["status"]) for one in log.entries(100)]
    assert found[::-1] == [
        ("Asha", "sign-in", "", None, "403"),
        ("Asha", "sign-in", "", None, "200"),
        ("Asha", "begin-visit", visit, None, "201"),
        ("Asha", "answer", visit, "name", "200"),
        ("Asha", "view", visit, None, "200"),
        ("Asha", "capture", visit, None, "409"),
        ("", "view", visit, None, "401"),
        ("Asha", "list-visits", "", None, "200"),
        ("Asha", "view", "none", None, "404"),
        ("", "refused", "", None, "400"),
    ]
    assert {one.more["clock"] for one in log.entries(100)} == {"not_set"}
    patients = [one.more["patient"] for one in log.entries(100) if one.action in {"begin-visit", "answer"}]
    assert len(patients) == 2
    assert set(patients) <= ids_in_files(fresh.store.folder)[0]
    content = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())  # store and logs
    assert visit.encode() in content
    assert not [text for text in ("Meena", number) if text.encode() in content]
    shown = ask(app, "GET", "/api/audit?action=sign-in", token).json()
    assert ([entry["number"] for entry in shown["entries"]], shown["problem"]) == ([2, 1], None)
    (tmp_path / "audit-log.jsonl").write_bytes(b"")
    assert ask(app, "GET", "/api/audit", token).json()["problem"] is not None


def test_a_second_user_of_one_tablet_ends_the_login_of_the_first(fresh: Rig) -> None:
    """The cookie is replaced, and a copy of the first one is of no use."""
    for name, roles in (("Asha", ROLES), ("Ravi", ROLES[:1])):
        fresh.authenticator.users.add(name, PIN, roles)
    token, used = None, []
    for name in ("Asha", "Ravi"):
        answer = ask(fresh.app, "POST", "/api/login", token, json={"name": name, "secret": PIN})
        used.append(token := answer.cookies["login"])
    assert [ask(fresh.app, "GET", "/api/visits", one).status_code for one in used] == [401, 200]
    assert ask(fresh.app, "GET", "/api/users", token).status_code == 403, "the rights of the second user"


def test_with_a_damaged_audit_log_the_exam_goes_on_and_the_damage_is_shown(fresh: Rig, tmp_path: Path) -> None:
    (tmp_path / "audit-log.jsonl").write_bytes(b"no entry\n")
    (tmp_path / "audit-head.json").write_bytes(b"no head")
    app = create_app(fresh.arbiter, fresh.authenticator, audit_log=AuditLog(tmp_path, b"k" * 32, fresh.clock)).http
    assert ask(app, "POST", "/api/visits", client=HERE, json={"key": "0" * 16}).status_code == 201
    assert ask(app, "POST", "/api/captures", client=HERE, json={"eye": "OD"}).status_code == 201
    fresh.authenticator.users.add("Asha", PIN, ROLES)
    shown = ask(app, "GET", "/api/audit", fresh.authenticator.sign_in("Asha", PIN, OWN_SCREEN)).json()
    assert shown["problem"] is not None
    assert {entry["action"] for entry in shown["entries"]} >= {"begin-visit", "capture"}, "later entries are kept"


def test_without_room_for_the_audit_log_the_exam_goes_on(fresh: Rig, tmp_path: Path) -> None:
    log = AuditLog(tmp_path / "missing", b"k" * 32, fresh.clock)
    app = create_app(fresh.arbiter, fresh.authenticator, audit_log=log).http
    assert ask(app, "POST", "/api/visits", client=HERE, json={"key": "0" * 16}).status_code == 201
    assert ask(app, "POST", "/api/captures", client=HERE, json={"eye": "OD"}).status_code == 201
