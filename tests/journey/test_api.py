"""HTTP API in one process: endpoints, status codes, problem responses, security headers, live pictures and events."""

import asyncio
import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from threading import Event, Thread, current_thread
from typing import Any

import httpx
import pytest
from PIL import Image
from sqlalchemy import event

from device.errors import DiffuscopeError
from services.http.problem_responses import HTTP_STATUS, problem_response
from services.records.capture_versions import NewVersion
from tests.journey.asking import live_picture

CHOSEN = {  # expected HTTP status of each error class
    "SpecError": 422,
    "FrameError": 422,
    "PsfError": 422,
    "SettingError": 422,
    "CameraMissing": 503,
    "CameraStalled": 503,
    "CameraMismatch": 503,
    "CameraPacked": 503,
    "LightFault": 423,
    "DailyLightLimit": 423,
    "MemoryDamaged": 503,
    "HeadMismatch": 423,
    "TooHot": 423,
    "PowerLow": 423,
    "CalibrationMissing": 423,
    "CalibrationDamaged": 423,
    "CalibrationRefused": 423,
    "CalibrationFormat": 423,
    "CalibrationUntrusted": 423,
    "CalibrationExpired": 423,
    "CalibrationStale": 423,
    "CalibrationModeMismatch": 423,
    "CalibrationStopped": 423,
    "LoginRequired": 401,
    "SetupRequired": 401,
    "ConfirmationRequired": 401,
    "AccessDenied": 403,
    "SecretWrong": 403,
    "SignInLockedOut": 429,
    "Busy": 409,
    "StoreFull": 507,
    "StoreDamaged": 500,
    "RecordNotFound": 404,
}
OD = {"eye": "OD"}


def leaves(kind: type[DiffuscopeError]) -> Iterator[type[DiffuscopeError]]:
    below = kind.__subclasses__()
    if not below:
        yield kind
    for child in below:
        yield from leaves(child)


def refused(answer: httpx.Response, status: int, code: str) -> dict[str, str]:
    """Check status, shape and code of a problem response; return its body."""
    assert answer.status_code == status, answer.text
    problem: dict[str, str] = answer.json()
    assert set(problem) == {"code", "message", "remedy"}
    assert problem["code"] == code
    assert all(problem.values())
    return problem


def test_each_error_class_has_its_status_code_and_remedy() -> None:
    ours = [leaf for leaf in leaves(DiffuscopeError) if leaf.__module__ in ("device.errors", "services.errors")]
    assert {leaf.__name__ for leaf in ours} >= set(CHOSEN)
    for leaf in ours:
        answer = problem_response(leaf("what happened"))
        problem = json.loads(bytes(answer.body))
        assert problem == {"code": leaf.code, "message": "what happened", "remedy": leaf.default_remedy}
        assert answer.status_code == CHOSEN.get(leaf.__name__, answer.status_code)
        assert 400 <= answer.status_code < 600
    assert len({leaf.code for leaf in ours}) == len(ours)
    assert DiffuscopeError in HTTP_STATUS  # fallback for new classes


def test_a_press_reads_the_database_beside_the_event_loop(old_rig: Any) -> None:
    """A slow disk must not delay the answers to the other requests."""
    readers = set[Thread]()

    def note(*_: object) -> None:
        readers.add(current_thread())

    async def scenario(client: httpx.AsyncClient) -> Thread:
        assert (await client.post("/api/captures", json=OD | {"key": "0123456789abcdef"})).status_code == 201
        return current_thread()

    event.listen(old_rig.store.engine, "before_cursor_execute", note)
    try:
        loop = old_rig.ask(scenario)
    finally:
        event.remove(old_rig.store.engine, "before_cursor_execute", note)
    assert readers
    assert loop not in readers


def test_capture_request_answers_201_with_working_links(old_rig: Any) -> None:
    async def scenario(client: httpx.AsyncClient) -> None:
        answer = await client.post("/api/captures", json=OD)
        assert answer.status_code == 201
        made = answer.json()
        assert made["eye"] == "OD"
        assert made["simulated"] is True
        assert (await client.get(f"/api/captures/{made['id']}")).json() == made
        media = {
            "picture": "image/png",
            "colour": "image/png",
            "raw": "image/tiff",
            "quick": "image/jpeg",
            "report": "application/json",
        }
        assert set(made["links"]) == set(media)
        for name, link in made["links"].items():
            file = await client.get(link)
            assert file.status_code == 200
            assert file.headers["content-type"] == media[name]
            assert file.content == old_rig.store.read(made["id"], link.rsplit("/", 1)[1])
        assert (await client.get(made["links"]["report"])).json() == made["report"] | {"simulated": True}

    old_rig.ask(scenario)


def test_capture_request_while_busy_is_409_with_a_remedy(rig: Any) -> None:
    async def scenario(client: httpx.AsyncClient) -> None:
        rig.block_exposures()
        first = asyncio.create_task(client.post("/api/captures", json=OD))
        await asyncio.to_thread(rig.wait_for_blocked_exposure)
        assert (await client.get("/api/status")).json()["state"] == "busy"
        words = refused(await client.post("/api/captures", json={"eye": "OS"}), 409, "busy")
        assert "Wait" in words["remedy"]
        rig.clock.gate.set()
        assert (await first).status_code == 201
        assert len((await client.get("/api/captures")).json()["captures"]) == 1

    rig.ask(scenario)


def test_repeated_idempotency_key_makes_one_capture(rig: Any) -> None:
    async def scenario(client: httpx.AsyncClient) -> None:
        press = OD | {"key": "0123456789abcdef"}
        rig.block_exposures()
        first = asyncio.create_task(client.post("/api/captures", json=press))
        await asyncio.to_thread(rig.wait_for_blocked_exposure)
        second = asyncio.create_task(client.post("/api/captures", json=press))
        await asyncio.sleep(0.05)
        rig.clock.gate.set()
        answers = [await first, await second, await client.post("/api/captures", json=press)]
        assert [answer.status_code for answer in answers] == [201] * 3
        assert len({answer.json()["id"] for answer in answers}) == 1
        assert len((await client.get("/api/captures")).json()["captures"]) == 1

    rig.ask(scenario)


@pytest.mark.parametrize(("fault", "status"), [("camera.missing", 503), ("camera.stalled", 503), ("light.fault", 423)])
def test_hardware_fault_is_answered_with_its_code(old_rig: Any, fault: str, status: int) -> None:
    old_rig.world.faults.add(fault)
    refused(old_rig.request("POST", "/api/captures", json=OD), status, fault)
    assert old_rig.world.illumination is None


def test_full_disk_is_507_and_no_capture_is_listed(make_rig: Any) -> None:
    rig = make_rig(store={"free_bytes": lambda _: 0})
    words = refused(rig.request("POST", "/api/captures", json=OD), 507, "store.full")
    assert "Nothing that was saved is lost" in words["remedy"]
    assert rig.request("GET", "/api/captures").json() == {"captures": []}


def test_captures_are_listed_newest_first_in_pages(rig: Any) -> None:
    ids = [rig.exam.press("OD").result(30).id for _ in range(3)][::-1]

    async def scenario(client: httpx.AsyncClient) -> None:
        async def listed(query: str) -> list[str]:
            answer = await client.get(f"/api/captures{query}")
            assert answer.status_code == 200
            return [capture["id"] for capture in answer.json()["captures"]]

        assert await listed("") == ids
        assert await listed("?limit=2") == ids[:2]
        assert await listed(f"?limit=2&before={ids[1]}") == ids[2:]
        assert await listed(f"?before={ids[2]}") == []
        refused(await client.get("/api/captures?limit=0"), 422, "input")
        refused(await client.get("/api/captures?limit=501"), 422, "input")
        refused(await client.get("/api/captures?before=unknown"), 404, "store.unknown")

    rig.ask(scenario)


@pytest.mark.parametrize(
    "path",
    ["/api/captures/unknown", "/api/captures/unknown/picture.png", "/api/captures/..%2f..%2fetc", "/api/captures/%00"],
)
def test_unknown_capture_is_404(old_rig: Any, path: str) -> None:
    answer = old_rig.request("GET", path)
    assert answer.status_code == 404
    assert set(answer.json()) == {"code", "message", "remedy"}


def test_unknown_file_is_404_and_invalid_file_name_is_422(old_rig: Any) -> None:
    stored = old_rig.exam.press("OD").result(30)
    refused(old_rig.request("GET", f"/api/captures/{stored.id}/other.png"), 404, "store.unknown")
    for name in ("store.sqlite", "..%5c..%5cpasswd", "RAW.TIFF", "raw.tiff.bak"):
        refused(old_rig.request("GET", f"/api/captures/{stored.id}/{name}"), 422, "input")


def test_damaged_file_is_500_and_the_other_files_are_served(old_rig: Any) -> None:
    stored = old_rig.exam.press("OD").result(30)
    (old_rig.store.folder / "captures" / stored.id / "picture.png").write_bytes(b"not what was kept")
    refused(old_rig.request("GET", f"/api/captures/{stored.id}/picture.png"), 500, "store.damaged")
    assert old_rig.request("GET", f"/api/captures/{stored.id}/raw.tiff").status_code == 200


@pytest.mark.parametrize(
    "body", [{}, {"eye": "left"}, {"eye": None}, {"eye": "OD", "lamp": 1}, {"eye": "OD", "key": "short"}, [], "OD"]
)
def test_invalid_capture_request_is_422_and_names_the_field(old_rig: Any, body: Any) -> None:
    before = old_rig.store.captures()
    words = refused(old_rig.request("POST", "/api/captures", json=body), 422, "input")
    assert words["message"].startswith("body")
    assert old_rig.store.captures() == before


def test_invalid_eye_is_422_and_lists_the_valid_ones(old_rig: Any) -> None:
    words = refused(old_rig.request("POST", "/api/captures", json={"eye": "left"}), 422, "input")
    assert "body.eye" in words["message"]
    assert "OD" in words["message"]
    assert "OS" in words["message"]
    refused(old_rig.request("POST", "/api/captures", content=b"{not json"), 422, "input")


def test_body_too_large_is_refused_unread(old_rig: Any) -> None:
    before = old_rig.store.captures()
    words = refused(old_rig.request("POST", "/api/captures", content=b" " * 20_000 + b'{"eye": "OD"}'), 422, "input")
    assert "too large" in words["message"]

    async def drip() -> Any:  # of unknown length: read as far as the limit of 10 kB only
        for _ in range(3):
            yield b" " * 5_000
        raise AssertionError("the body must not be read on")

    words = refused(old_rig.request("POST", "/api/captures", content=drip()), 422, "input")
    assert "too large" in words["message"]
    refused(old_rig.request("POST", "/api/captures", content=b"{}", headers={"Content-Length": "-1"}), 422, "input")
    assert old_rig.store.captures() == before


UNKNOWN = [
    ("GET", "/nowhere", 404),
    ("GET", "/api/nowhere", 404),
    ("GET", "/web/nowhere.js", 404),
    ("GET", "/web/../services/cli.py", 404),
    ("DELETE", "/api/captures", 405),
    ("POST", "/", 405),
]


@pytest.mark.parametrize(("method", "path", "status"), UNKNOWN)
def test_unknown_path_or_method_gives_a_problem_response(old_rig: Any, method: str, path: str, status: int) -> None:
    answer = old_rig.request(method, path)
    refused(answer, status, f"http.{status}")
    assert ("allow" in answer.headers) == (status == 405)


def test_every_kind_of_answer_has_the_security_headers(rig: Any) -> None:
    stored = rig.exam.press("OD").result(30)

    def broken(_: Any) -> None:
        raise ZeroDivisionError

    rig.app.add_route("/api/broken", broken)  # an unexpected exception in an endpoint
    quiet = {"raise_app_exceptions": False}
    answers = {
        "page": rig.request("GET", "/"),
        "script": rig.request("GET", script_of(rig)),
        "json": rig.request("GET", "/api/status"),
        "file": rig.request("GET", f"/api/captures/{stored.id}/picture.png"),
        "preview": rig.request("GET", "/api/preview"),
        "unknown": rig.request("GET", "/nowhere"),
        "not kept": rig.request("GET", "/api/captures/unknown"),
        "wrong": rig.request("POST", "/api/captures", json={}),
        "too large": rig.request("POST", "/api/captures", content=b" " * 20_000),
        "unforeseen": rig.ask(lambda client: client.get("/api/broken?_=1"), **quiet),
    }
    assert {name: answer.status_code for name, answer in answers.items()} == {
        "page": 200,
        "script": 200,
        "json": 200,
        "file": 200,
        "preview": 200,
        "unknown": 404,
        "not kept": 404,
        "wrong": 422,
        "too large": 422,
        "unforeseen": 500,
    }
    for name, answer in answers.items():
        assert "default-src 'none'" in answer.headers["content-security-policy"], name
        assert answer.headers["x-content-type-options"] == "nosniff", name
        assert answer.headers["referrer-policy"] == "no-referrer", name
        keep = {"page": "no-cache", "script": "public, max-age=31536000, immutable", "unknown": None}
        assert answer.headers.get("cache-control") == keep.get(name, "no-store"), name
    refused(answers["unforeseen"], 500, "fault")


def script_of(rig: Any) -> str:
    """Return the cache-busting URL of the page's module."""
    return re.findall(r'src="(/web/[0-9a-f]{12}/app/app[.]js)"', rig.request("GET", "/").text)[0]


def test_page_and_scripts_are_served_with_gzip(old_rig: Any) -> None:
    page = old_rig.request("GET", "/")
    assert page.headers["content-type"].startswith("text/html")
    at = script_of(old_rig)
    compressed = old_rig.request("GET", at, headers={"Accept-Encoding": "gzip"})
    plain = old_rig.request("GET", at, headers={"Accept-Encoding": "identity"})
    assert "javascript" in plain.headers["content-type"]
    assert compressed.headers["content-encoding"] == "gzip"
    assert "content-encoding" not in plain.headers
    assert compressed.text == plain.text
    assert int(compressed.headers["content-length"]) < 0.5 * int(plain.headers["content-length"])
    assert "technician.js" in old_rig.request("GET", "/technician").text


def test_status_and_health_follow_a_camera_fault(old_rig: Any, wait_until: Callable[..., None]) -> None:
    status = old_rig.request("GET", "/api/status").json()
    assert status["kind"] == "simulated"
    assert status["state"] == "aim"
    assert status["shape"] == [135, 240]
    assert status["problem"] is None
    assert status["field_px"] == pytest.approx(33.4 * 1.9478, rel=0.01)
    assert (
        old_rig.request("POST", "/api/captures", json=OD).status_code == 201
    )  # captures of earlier tests were damaged
    health = old_rig.request("GET", "/api/health").json()
    assert not [check for check in health["checks"] if not check["ok"]]
    assert health["ok"] is True
    old_rig.world.faults.add("camera.missing")
    live_picture(old_rig.exam, 0, wait_s=0.0)
    wait_until(lambda: old_rig.exam.problem is not None)
    assert old_rig.request("GET", "/api/status").json()["problem"]["code"] == "camera.missing"
    assert old_rig.request("GET", "/api/health").json()["ok"] is False
    old_rig.world.faults.clear()
    assert old_rig.request("POST", "/api/captures", json=OD).status_code == 201
    assert old_rig.request("GET", "/api/health").json()["ok"] is True


def test_openapi_lists_every_endpoint(old_rig: Any) -> None:
    document = old_rig.request("GET", "/api/openapi.json").json()
    assert document["openapi"].startswith("3.")
    fixed = {
        "/api/captures": {"get", "post"},
        "/api/captures/{id}": {"get"},
        "/api/captures/{id}/{name}": {"get"},
        "/api/events": {"get"},
        "/api/preview": {"get"},
        "/api/health": {"get"},
        "/api/status": {"get"},
        "/api/captures/{id}/accept": {"post"},
        "/api/captures/{id}/eye": {"post"},
        "/api/controller": {"post"},
        "/api/programme": {"get"},
        "/api/visits": {"get", "post"},
        "/api/visits/{id}": {"get", "patch"},
        "/api/visits/{id}/changes": {"get"},
        "/api/visits/{id}/not-possible": {"post"},
        "/api/visits/{id}/slots": {"post"},
        "/api/visits/{id}/finish": {"post"},
        "/api/visits/{id}/reopen": {"post"},
        "/api/upload-queue": {"get"},
        "/api/upload-queue/retry": {"post"},
        "/api/visits/{id}/montage/{eye}": {"get"},
        "/api/visits/{id}/montage/{eye}/picture.png": {"get"},
        "/api/exports": {"get"},
        "/api/visits/{id}/export.zip": {"get"},
        "/api/visits/{id}/export": {"post"},
    }
    served = {path: set(verbs) for path, verbs in document["paths"].items()}
    own = (
        "/api/technician",
        "/api/calibration",
        "/api/login",
        "/api/setup",
        "/api/users",
        "/api/audit",
        "/api/ssh-keys",
        "/api/clock",
    )  # test_access.py
    assert {path: verbs for path, verbs in served.items() if not path.startswith(own)} == fixed
    press = document["paths"]["/api/captures"]["post"]["responses"]
    assert "201" in press
    assert press["4XX"]["content"]["application/json"]["schema"]["$ref"].endswith("/ProblemResponse")
    assert set(document["components"]["schemas"]["ProblemResponse"]["properties"]) == {
        "code",
        "message",
        "remedy",
        "n",
        "wait_s",
    }
    assert "HTTPValidationError" not in document["components"]["schemas"]  # never answered


# Live pictures and events


def test_preview_frames_have_rising_numbers_and_an_age(old_rig: Any) -> None:
    async def scenario(client: httpx.AsyncClient) -> None:
        number = 0
        for _ in range(3):
            answer = await client.get(f"/api/preview?after={number}")
            assert answer.status_code == 200
            assert int(answer.headers["x-frame"]) > number
            assert int(answer.headers["x-age-ms"]) >= 0
            number = int(answer.headers["x-frame"])
            with Image.open(BytesIO(answer.content)) as picture:
                assert picture.format == "JPEG"
        refused(await client.get("/api/preview?after=-1"), 422, "input")

    old_rig.ask(scenario)


def test_preview_without_a_frame_is_204_after_two_seconds(rig: Any) -> None:
    rig.block_exposures()
    before = time.monotonic()
    answer = rig.request("GET", "/api/preview?after=0")
    assert answer.status_code == 204
    assert answer.content == b""
    assert 1.9 < time.monotonic() - before < 6


def test_events_of_a_capture_are_ordered_and_their_links_work(old_rig: Any, read_events: Any) -> None:
    def enough(events: list[Any]) -> bool:
        return bool(events[-1][1:] == ("state", {"state": "aim"}))

    events = read_events(old_rig.app, enough, begin=lambda: old_rig.exam.press("OS"))
    assert events[0][:2] == (None, "beat")
    news = [event for event in events if event[1] != "beat"]
    sequence = [(kind, data.get("state") or data.get("stage") or data.get("word")) for _, kind, data in news]
    assert sequence == [
        ("state", "busy"),
        ("stage", "expose"),
        ("stage", "expose"),
        ("verdict", "good"),
        ("state", "making"),
        ("stage", "quick"),
        ("stage", "keep"),
        ("kept", None),
        ("state", "aim"),
    ]
    numbers = [number for number, _, _ in news]
    assert numbers == list(range(numbers[0], numbers[0] + 9))
    fractions = [data["fraction"] for _, kind, data in news if kind == "stage"]
    assert fractions == sorted(fractions)
    stored = news[7][2]
    assert stored == old_rig.request("GET", f"/api/captures/{stored['id']}").json()
    assert {data["id"] for _, kind, data in news if kind == "stage"} == {stored["id"]}
    first, last = news[3][2], stored["verdict"]
    assert (first["id"], first["word"], first["code"]) == (stored["id"], last["word"], last["code"])
    assert first["numbers"].items() < last["numbers"].items()  # figures of the reconstructed picture are added later
    first_look, look = news[2][2]["url"], news[5][2]["url"]  # while the next frame is exposed, and after the last one
    assert first_look == look
    assert old_rig.request("GET", look).status_code == 200


def test_reconnected_stream_resumes_after_the_last_event_id(rig: Any, read_events: Any) -> None:
    stored = rig.exam.press("OD").result(30)
    news = read_events(rig.app, lambda events: len(events) == 11, {"Last-Event-ID": "0"})[1:]
    assert [number for number, _, _ in news] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]
    assert news[8][2]["id"] == stored.id
    later = read_events(rig.app, lambda events: len(events) == 3, {"Last-Event-ID": "8"})[1:]
    assert [number for number, _, _ in later] == [9, 10]
    fresh = read_events(rig.app, lambda events: len(events) == 1)
    assert fresh[0][1:] == ("beat", {"number": 10})
    refused(rig.request("GET", "/api/events", headers={"Last-Event-ID": "yesterday"}), 422, "input")


def test_event_id_of_an_earlier_process_replays_all_events(rig: Any, read_events: Any) -> None:
    rig.exam.press("OD").result(30)
    news = read_events(rig.app, lambda events: len(events) == 11, {"Last-Event-ID": "500"})[1:]
    assert [number for number, _, _ in news] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]


def test_damaged_capture_does_not_stop_the_event_stream(rig: Any, read_events: Any) -> None:
    stored = rig.exam.press("OD").result(30)
    (rig.store.folder / "captures" / stored.id).rename(rig.store.folder / "gone")
    news = read_events(rig.app, lambda events: events[-1][0] == 10, {"Last-Event-ID": "0"})[1:]
    assert [number for number, _, _ in news] == [1, 2, 3, 4, 5, 6, 7, 8, 10]


def test_event_stream_has_a_heartbeat_every_second(old_rig: Any, read_events: Any) -> None:
    before = time.monotonic()
    events = read_events(old_rig.app, lambda events: len(events) == 3)
    assert [(number, kind) for number, kind, _ in events] == [(None, "beat")] * 3
    assert 1.9 < time.monotonic() - before < 6


def test_event_stream_ends_when_the_event_bus_closes(rig: Any, read_events: Any) -> None:
    never = Event()
    events = read_events(rig.app, lambda _: never.is_set(), begin=rig.event_bus.close)
    assert [kind for _, kind, _ in events] == ["beat"]


def test_versions_of_a_capture_are_listed_with_working_links(old_rig: Any) -> None:
    kept = old_rig.exam.press("OD").result(30)
    at, frames = f"/api/captures/{kept.id}", {name: file for name, file in kept.files.items() if name.endswith(".tiff")}
    taken = old_rig.request("GET", at).json()
    assert "versions" not in taken
    new = NewVersion(kept.id, "a" * 32, frames, "", "variation", "1.2", b"new", b'{"method": "variation"}')
    for version in (new, replace(new, result="b" * 32, colour=b"new in colour")):
        old_rig.store.versions.adopt(version, old_rig.clock.wall())
    capture = old_rig.request("GET", at).json()
    assert capture["links"] == taken["links"]
    first, second = capture["versions"]
    assert first == {
        "number": 1,
        "result": "a" * 32,
        "at": old_rig.clock.wall().isoformat(),
        "method": "variation",
        "software": "1.2",
        "picture": f"{at}/picture-1.png",
        "report": f"{at}/report-1.json",
    }
    picture, colour, report = (old_rig.request("GET", second[name]) for name in ("picture", "colour", "report"))
    assert (picture.content, picture.headers["content-type"]) == (b"new", "image/png")
    assert (colour.content, report.json()) == (b"new in colour", {"method": "variation"})
    assert old_rig.request("GET", taken["links"]["picture"]).content == old_rig.store.read(kept.id, "picture.png")
    refused(old_rig.request("GET", f"{at}/picture-3.png"), 404, "store.unknown")
