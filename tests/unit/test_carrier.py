"""The way to a receiver, over real TLS: what counts as sent, and what each thing that goes wrong is called."""

import hashlib
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest

from device.errors import (
    Busy,
    DiffuscopeError,
    SendLocked,
    SendRejected,
    SendUnlike,
    SendUnreachable,
    SendUntrusted,
    SpecError,
)
from services.instrument.carrier import Https, Parcel, SendSettings, load_settings
from services.records.outbox import Receipt
from tests.receiver import Receiver, receiving
from tests.site import identity

CONTENT = bytes(range(256)) * 2000  # several pieces
PARCEL = Parcel("A00013-20260301T120000-abcdef", CONTENT)


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return identity(tmp_path_factory.mktemp("tls"))


@pytest.fixture
def receiver(papers: tuple[Path, Path]) -> Iterator[Receiver]:
    with receiving(*papers) as known:
        yield known


def carrier(receiver: Receiver, papers: tuple[Path, Path], folder: Path, **more: object) -> Https:
    said = receiver.settings(folder, authority=papers[0], **more)
    return Https(SendSettings.model_validate(said))


def deliver(way: Https) -> Receipt:
    return way.deliver(PARCEL, lambda: None)


def test_what_arrived_is_whole_under_a_name_that_is_fixed_by_its_content(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    receipt = deliver(carrier(receiver, papers, tmp_path))
    assert receipt == Receipt(hashlib.sha256(CONTENT).hexdigest(), "sha256")
    assert receiver.kept == {f"/inbox/A00013-20260301T120000-abcdef-{receipt.sha256[:16]}.zip": CONTENT}
    assert receiver.asked == ["HEAD", "PUT", "HEAD"]


def test_a_repeat_changes_nothing_and_sends_nothing(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    way = carrier(receiver, papers, tmp_path)
    assert deliver(way) == deliver(way)
    assert receiver.asked == ["HEAD", "PUT", "HEAD", "HEAD"]
    assert len(receiver.kept) == 1


def test_a_lost_answer_is_asked_for_again_and_then_known(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    way = carrier(receiver, papers, tmp_path)
    receiver.mood = "mute"
    with pytest.raises(SendUnreachable):
        deliver(way)
    assert deliver(way).confirmed == "sha256"
    assert receiver.asked == ["HEAD", "PUT", "HEAD"]


def test_another_who_was_quicker_is_as_good(receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path) -> None:
    receiver.answers["PUT"] = 412
    way = carrier(receiver, papers, tmp_path)

    def meanwhile() -> None:
        receiver.kept[f"/inbox/{PARCEL.name}"] = CONTENT

    assert way.deliver(PARCEL, meanwhile).confirmed == "sha256"


def test_without_a_digest_the_length_must_do(receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path) -> None:
    receiver.tells_digest = False
    assert deliver(carrier(receiver, papers, tmp_path)).confirmed == "length"


@pytest.mark.parametrize("tells_digest", [True, False])
def test_half_of_it_is_not_sent(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path, tells_digest: bool
) -> None:
    receiver.mood, receiver.tells_digest = "half", tells_digest
    way = carrier(receiver, papers, tmp_path)
    for _ in range(2):
        with pytest.raises(SendUnlike, match="SHA-256" if tells_digest else "length"):
            deliver(way)
    assert receiver.asked.count("PUT") == 1, "nothing is ever written over"


@pytest.mark.parametrize(
    ("method", "status", "kind"),
    [
        ("HEAD", 401, SendLocked), ("PUT", 401, SendLocked), ("PUT", 403, SendLocked), ("HEAD", 405, SendRejected),
        ("PUT", 413, SendRejected), ("PUT", 302, SendRejected), ("HEAD", 302, SendRejected),
        ("PUT", 429, SendUnreachable),
        ("PUT", 500, SendUnreachable), ("HEAD", 503, SendUnreachable), ("PUT", 507, SendUnreachable),
    ],
)  # fmt: skip
def test_each_refusal_has_its_name(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path, method: str, status: int,
    kind: type[DiffuscopeError],
) -> None:  # fmt: skip
    receiver.answers[method] = status
    with pytest.raises(kind, match=str(status)):
        deliver(carrier(receiver, papers, tmp_path))
    assert receiver.kept == {}


def test_a_link_that_is_lost_in_the_middle_passes(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    receiver.mood = "cut"
    with pytest.raises(SendUnreachable):
        deliver(carrier(receiver, papers, tmp_path))
    assert receiver.kept == {}


def test_a_receiver_that_is_silent_or_dribbles_holds_nobody_for_long(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    receiver.mood = "dribble"
    with pytest.raises(SendUnreachable):
        deliver(carrier(receiver, papers, tmp_path, most_s=0.7))
    receiver.kept.clear()
    receiver.gate.clear()
    with pytest.raises(SendUnreachable, match="timed out"):
        deliver(carrier(receiver, papers, tmp_path, answer_s=0.3))


def test_a_delivery_is_ended_from_outside(receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path) -> None:
    receiver.gate.clear()
    way, ended = carrier(receiver, papers, tmp_path, answer_s=60.0), []

    def story() -> None:
        with pytest.raises(SendUnreachable):
            deliver(way)
        ended.append(True)

    thread = Thread(target=story)
    thread.start()
    end = time.monotonic() + 10
    while not receiver.asked:
        assert time.monotonic() < end
        time.sleep(0.01)
    way.abort()
    thread.join(10)
    assert ended


def test_who_is_examined_goes_first_also_in_the_middle(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    pieces = iter(range(100))

    def pause() -> None:
        if next(pieces) == 3:
            raise Busy("somebody is examined")

    with pytest.raises(Busy):
        carrier(receiver, papers, tmp_path).deliver(PARCEL, pause)
    assert receiver.kept == {}


def test_nobody_there_and_no_such_name(papers: tuple[Path, Path], tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = Receiver(f"https://localhost:{free.getsockname()[1]}")
        with pytest.raises(SendUnreachable, match="refused"):
            deliver(carrier(nobody, papers, tmp_path))
    with pytest.raises(SendUnreachable, match=r"nowhere\.invalid"):
        deliver(carrier(Receiver("https://nowhere.invalid"), papers, tmp_path))


def test_a_stranger_and_an_expired_certificate_are_not_trusted_and_hear_no_key(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(SendUntrusted, match="self-signed"):
        deliver(Https(SendSettings.model_validate(receiver.settings(tmp_path))))
    old = aged(tmp_path)
    with receiving(*old) as expired, pytest.raises(SendUntrusted, match="expired") as told:
        deliver(carrier(expired, old, tmp_path))
    assert "date" in told.value.remedy
    receiver.at = receiver.at.replace("localhost", "127.0.0.1")
    with pytest.raises(SendUntrusted, match="IP address mismatch"):
        deliver(carrier(receiver, papers, tmp_path))
    assert receiver.asked == expired.asked == []


def aged(folder: Path) -> tuple[Path, Path]:
    """A certificate that was good once."""
    crt, key, request = folder / "old.crt", folder / "old.key", folder / "old.csr"
    names = folder / "old.ext"
    names.write_text("subjectAltName=DNS:localhost\n")
    openssl = [
        "openssl",
        "req",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-keyout",
        key,
        "-out",
        request,
        "-subj",
        "/CN=localhost",
    ]
    subprocess.run(openssl, check=True, capture_output=True)
    signing = [
        "openssl",
        "x509",
        "-req",
        "-in",
        request,
        "-signkey",
        key,
        "-out",
        crt,
        "-days",
        "-1",
        "-extfile",
        names,
    ]
    subprocess.run(signing, check=True, capture_output=True)
    return crt, key


@pytest.mark.parametrize("token", [None, "", "two\nlines", "böse"])
def test_a_key_that_is_none_is_the_technicians_care(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path, token: str | None
) -> None:
    way = carrier(receiver, papers, tmp_path)
    (tmp_path / "send.token").unlink()
    if token is not None:
        (tmp_path / "send.token").write_text(token)
    with pytest.raises(SendLocked):
        deliver(way)
    assert receiver.asked == []


def test_a_certificate_of_an_authority_that_is_gone_is_told(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(SendUntrusted, match="cannot be read"):
        deliver(carrier(receiver, (tmp_path / "gone.crt", papers[1]), tmp_path))


def test_it_goes_through_a_socket_where_there_is_no_network(
    receiver: Receiver, papers: tuple[Path, Path], tmp_path: Path
) -> None:
    """As on the device: systemd-socket-proxyd stands between, and sees only what is encrypted."""
    place, port = tmp_path / "out.socket", int(receiver.at.rsplit(":", 1)[1])
    seen: list[bytes] = []
    with socket.socket(socket.AF_UNIX) as door:
        door.bind(str(place))
        door.listen()

        def pump(source: socket.socket, sink: socket.socket) -> None:
            while piece := source.recv(65536):
                seen.append(piece)
                sink.sendall(piece)
            sink.shutdown(socket.SHUT_WR)

        def proxy() -> None:
            for _ in range(3):
                inside, _ = door.accept()
                with inside, socket.create_connection(("127.0.0.1", port)) as outside:
                    back = Thread(target=pump, args=(outside, inside))
                    back.start()
                    pump(inside, outside)
                    back.join()

        thread = Thread(target=proxy)
        thread.start()
        assert deliver(carrier(receiver, papers, tmp_path, through=place)).confirmed == "sha256"
        thread.join(10)
    assert b"Bearer" not in b"".join(seen)
    assert list(receiver.kept.values()) == [CONTENT]
    with pytest.raises(SendUnreachable):
        deliver(carrier(receiver, papers, tmp_path, through=tmp_path / "nothing"))


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('address = "http://reader.example.org"\ntoken = "t"', "https:// only"),
        ('address = "https://user:word@reader.example.org"\ntoken = "t"', "folder of a web server"),
        ('address = "ftp://reader.example.org"\ntoken = "t"', "folder of a web server"),
        ('address = "https://reader.example.org/?to=me"\ntoken = "t"', "folder of a web server"),
        ('address = "https://reader.example.org:99999"\ntoken = "t"', "Port"),
        ('address = "https://reader.example.org"', "token"),
        ('address = "https://reader.example.org"\ntoken = "t"\nretries = 3', "retries"),
        ("address = ", "Invalid value"),
    ],
)
def test_settings_that_cannot_be_are_refused_with_the_reason(lines: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "send.toml"
    path.write_text(lines)
    with pytest.raises(SpecError, match=words):
        load_settings(path)
    with pytest.raises(SpecError, match="No such file"):
        load_settings(tmp_path / "nothing.toml")


def test_settings_that_can_be_are_read(tmp_path: Path) -> None:
    path = tmp_path / "send.toml"
    path.write_text('address = "https://reader.example.org/inbox/"\ntoken = "/etc/diffuscope/send.token"\n')
    assert load_settings(path).address == "https://reader.example.org/inbox"
    path.write_text('address = "http://127.0.0.1:9000"\ntoken = "t"\n')
    assert load_settings(path).there.port == 9000
