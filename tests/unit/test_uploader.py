"""Uploader over real TLS: confirmation of an upload, and the error of each failure."""

import hashlib
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest

from device.errors import DiffuscopeError, SpecError
from services.delivery.uploader import HttpsUploader, UploadSettings, VisitArchive, load_settings
from services.errors import (
    Busy,
    ReceiverUnreachable,
    ReceiverUntrusted,
    UploadMismatch,
    UploadRejected,
    UploadUnauthorised,
)
from services.records.upload_queue import UploadReceipt
from tests.receiver import Receiver, receiving
from tests.site import identity

CONTENT = bytes(range(256)) * 2000  # several chunks
PARCEL = VisitArchive("A00013-20260301T120000-abcdef", CONTENT)


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return identity(tmp_path_factory.mktemp("tls"))


@pytest.fixture
def receiver(certificate: tuple[Path, Path]) -> Iterator[Receiver]:
    with receiving(*certificate) as known:
        yield known


def uploader_of(receiver: Receiver, certificate: tuple[Path, Path], folder: Path, **more: object) -> HttpsUploader:
    fields = receiver.settings(folder, authority=certificate[0], **more)
    return HttpsUploader(UploadSettings.model_validate(fields))


def deliver(uploader: HttpsUploader) -> UploadReceipt:
    return uploader.upload(PARCEL, lambda: None)


def test_an_upload_is_complete_and_content_addressed(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    receipt = deliver(uploader_of(receiver, certificate, tmp_path))
    assert receipt == UploadReceipt(hashlib.sha256(CONTENT).hexdigest(), "sha256")
    assert receiver.kept == {f"/inbox/A00013-20260301T120000-abcdef-{receipt.sha256[:16]}.zip": CONTENT}
    assert receiver.asked == ["HEAD", "PUT", "HEAD"]


def test_a_repeated_upload_is_idempotent(receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path) -> None:
    uploader = uploader_of(receiver, certificate, tmp_path)
    assert deliver(uploader) == deliver(uploader)
    assert receiver.asked == ["HEAD", "PUT", "HEAD", "HEAD"]
    assert len(receiver.kept) == 1


def test_a_lost_answer_is_recovered_by_the_next_attempt(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    uploader = uploader_of(receiver, certificate, tmp_path)
    receiver.put_fault = "mute"
    with pytest.raises(ReceiverUnreachable):
        deliver(uploader)
    assert deliver(uploader).confirmed == "sha256"
    assert receiver.asked == ["HEAD", "PUT", "HEAD"]


def test_an_archive_that_was_uploaded_meanwhile_counts_as_confirmed(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    receiver.answers["PUT"] = 412
    uploader = uploader_of(receiver, certificate, tmp_path)

    def meanwhile() -> None:
        receiver.kept[f"/inbox/{PARCEL.name}"] = CONTENT

    assert uploader.upload(PARCEL, meanwhile).confirmed == "sha256"


def test_without_a_digest_the_length_confirms_the_upload(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    receiver.sends_digest = False
    assert deliver(uploader_of(receiver, certificate, tmp_path)).confirmed == "length"


@pytest.mark.parametrize("tells_digest", [True, False])
def test_a_truncated_upload_is_not_confirmed(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path, tells_digest: bool
) -> None:
    receiver.put_fault, receiver.sends_digest = "half", tells_digest
    uploader = uploader_of(receiver, certificate, tmp_path)
    for _ in range(2):
        with pytest.raises(UploadMismatch, match="SHA-256" if tells_digest else "length"):
            deliver(uploader)
    assert receiver.asked.count("PUT") == 1, "no file is overwritten"


@pytest.mark.parametrize(
    ("method", "status", "kind"),
    [
        ("HEAD", 401, UploadUnauthorised),
        ("PUT", 401, UploadUnauthorised),
        ("PUT", 403, UploadUnauthorised),
        ("HEAD", 405, UploadRejected),
        ("PUT", 413, UploadRejected),
        ("PUT", 302, UploadRejected),
        ("HEAD", 302, UploadRejected),
        ("PUT", 429, ReceiverUnreachable),
        ("PUT", 500, ReceiverUnreachable),
        ("HEAD", 503, ReceiverUnreachable),
        ("PUT", 507, ReceiverUnreachable),
    ],
)
def test_each_http_status_has_its_error(
    receiver: Receiver,
    certificate: tuple[Path, Path],
    tmp_path: Path,
    method: str,
    status: int,
    kind: type[DiffuscopeError],
) -> None:
    receiver.answers[method] = status
    with pytest.raises(kind, match=str(status)):
        deliver(uploader_of(receiver, certificate, tmp_path))
    assert receiver.kept == {}


def test_a_connection_lost_during_an_upload_is_retryable(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    receiver.put_fault = "cut"
    with pytest.raises(ReceiverUnreachable):
        deliver(uploader_of(receiver, certificate, tmp_path))
    assert receiver.kept == {}


def test_a_silent_or_slow_receiver_times_out(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    receiver.put_fault = "dribble"
    with pytest.raises(ReceiverUnreachable):
        deliver(uploader_of(receiver, certificate, tmp_path, most_s=0.7))
    receiver.kept.clear()
    receiver.gate.clear()
    with pytest.raises(ReceiverUnreachable, match="timed out"):
        deliver(uploader_of(receiver, certificate, tmp_path, answer_s=0.3))


def test_an_upload_is_aborted_from_another_thread(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    receiver.gate.clear()
    uploader, ended = uploader_of(receiver, certificate, tmp_path, answer_s=60.0), []

    def upload() -> None:
        with pytest.raises(ReceiverUnreachable):
            deliver(uploader)
        ended.append(True)

    thread = Thread(target=upload)
    thread.start()
    end = time.monotonic() + 10
    while not receiver.asked:
        assert time.monotonic() < end
        time.sleep(0.01)
    uploader.abort()
    thread.join(10)
    assert ended


def test_an_abort_before_the_connection_is_not_lost(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    uploader = uploader_of(receiver, certificate, tmp_path)
    with pytest.raises(ReceiverUnreachable, match="aborted"):
        uploader.upload(PARCEL, uploader.abort)
    assert receiver.asked == []


def test_an_exam_interrupts_an_upload(receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path) -> None:
    chunks = iter(range(100))

    def pause() -> None:
        if next(chunks) == 3:
            raise Busy("an exam is active")

    with pytest.raises(Busy):
        uploader_of(receiver, certificate, tmp_path).upload(PARCEL, pause)
    assert receiver.kept == {}


def test_a_closed_port_and_an_unknown_host_are_unreachable(certificate: tuple[Path, Path], tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        unreachable = Receiver(f"https://localhost:{free.getsockname()[1]}")
        with pytest.raises(ReceiverUnreachable, match="refused"):
            deliver(uploader_of(unreachable, certificate, tmp_path))
    with pytest.raises(ReceiverUnreachable, match=r"nowhere\.invalid"):
        deliver(uploader_of(Receiver("https://nowhere.invalid"), certificate, tmp_path))


def test_an_untrusted_certificate_gets_no_token(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(ReceiverUntrusted, match="self-signed"):
        deliver(HttpsUploader(UploadSettings.model_validate(receiver.settings(tmp_path))))
    old = expired_certificate(tmp_path)
    with receiving(*old) as expired, pytest.raises(ReceiverUntrusted, match="expired") as raised:
        deliver(uploader_of(expired, old, tmp_path))
    assert "date" in raised.value.remedy
    receiver.at = receiver.at.replace("localhost", "127.0.0.1")
    with pytest.raises(ReceiverUntrusted, match="IP address mismatch"):
        deliver(uploader_of(receiver, certificate, tmp_path))
    assert receiver.asked == expired.asked == []


def expired_certificate(folder: Path) -> tuple[Path, Path]:
    """Return an expired certificate and its key."""
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
def test_an_invalid_token_file_is_refused(
    receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path, token: str | None
) -> None:
    uploader = uploader_of(receiver, certificate, tmp_path)
    (tmp_path / "send.token").unlink()
    if token is not None:
        (tmp_path / "send.token").write_text(token)
    with pytest.raises(UploadUnauthorised):
        deliver(uploader)
    assert receiver.asked == []


def test_a_missing_ca_file_is_refused(receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ReceiverUntrusted, match="cannot be read"):
        deliver(uploader_of(receiver, (tmp_path / "gone.crt", certificate[1]), tmp_path))


def test_an_upload_through_a_unix_socket(receiver: Receiver, certificate: tuple[Path, Path], tmp_path: Path) -> None:
    """As on the device: systemd-socket-proxyd forwards the connection, and sees encrypted bytes only."""
    socket_path, port = tmp_path / "out.socket", int(receiver.at.rsplit(":", 1)[1])
    seen: list[bytes] = []
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(socket_path))
        listener.listen()

        def pump(source: socket.socket, sink: socket.socket) -> None:
            while chunk := source.recv(65536):
                seen.append(chunk)
                sink.sendall(chunk)
            sink.shutdown(socket.SHUT_WR)

        def proxy() -> None:
            for _ in range(3):
                inside, _ = listener.accept()
                with inside, socket.create_connection(("127.0.0.1", port)) as outside:
                    back = Thread(target=pump, args=(outside, inside))
                    back.start()
                    pump(inside, outside)
                    back.join()

        thread = Thread(target=proxy)
        thread.start()
        assert deliver(uploader_of(receiver, certificate, tmp_path, through=socket_path)).confirmed == "sha256"
        thread.join(10)
    assert b"Bearer" not in b"".join(seen)
    assert list(receiver.kept.values()) == [CONTENT]
    with pytest.raises(ReceiverUnreachable):
        deliver(uploader_of(receiver, certificate, tmp_path, through=tmp_path / "nothing"))


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
def test_invalid_settings_are_refused_with_the_reason(lines: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "send.toml"
    path.write_text(lines)
    with pytest.raises(SpecError, match=words):
        load_settings(path)
    with pytest.raises(SpecError, match="No such file"):
        load_settings(tmp_path / "nothing.toml")


def test_valid_settings_are_read(tmp_path: Path) -> None:
    path = tmp_path / "send.toml"
    path.write_text('address = "https://reader.example.org/inbox/"\ntoken = "/etc/diffuscope/send.token"\n')
    assert load_settings(path).address == "https://reader.example.org/inbox"
    path.write_text('address = "http://127.0.0.1:9000"\ntoken = "t"\n')
    assert load_settings(path).split_address.port == 9000
