"""Tests of signed calibration exports: only files of trusted signers, unchanged, are accepted."""

import hashlib
import io
import random
import shutil
import stat
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_ssh_private_key,
)

from device.calibration import archive as archive_module
from device.calibration.archive import Archive
from device.calibration.signing import (
    MAX_BYTES,
    Signer,
    create_key_pair,
    export,
    read_export,
    read_signer,
    verify_export,
)
from device.errors import (
    CalibrationDamaged,
    CalibrationError,
    CalibrationFormat,
    CalibrationUntrusted,
    SettingError,
)
from tests.unit.test_archive import WHO, calibration


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    made = Archive(tmp_path / "here")
    made.add_and_activate(calibration(), WHO)
    return made


@pytest.fixture
def trusted_signer(tmp_path: Path) -> Signer:
    return create_key_pair(tmp_path / "key", "Service centre Zürich")


@pytest.fixture
def sent(archive: Archive, trusted_signer: Signer, tmp_path: Path) -> Path:
    file = tmp_path / "sent.calibration"
    export(archive.files(archive.active_id()), file, tmp_path / "key")
    return file


def signed_by(key: Path, head: bytes, packed: bytes) -> bytes:
    """Return a file as another program could sign it."""
    private = load_ssh_private_key(key.read_bytes(), None)
    assert isinstance(private, Ed25519PrivateKey)
    return head + private.sign(head + packed).hex().encode() + b"\n" + packed


def head_of(whole: bytes) -> bytes:
    return b"\n".join(whole.split(b"\n")[:3]) + b"\n"


def test_an_imported_calibration_is_identical_byte_for_byte(archive, trusted_signer, sent, tmp_path):
    files, signer = read_export(sent, (create_key_pair(tmp_path / "other", "Another signer"), trusted_signer))
    assert signer.name == "Service centre Zürich"
    there = Archive(tmp_path / "there")
    id = there.add_files(files)
    assert there.files(id) == archive.files(id)
    assert there.load(id).provenance == WHO


def test_an_imported_calibration_is_not_activated(trusted_signer, sent, tmp_path):
    there = Archive(tmp_path / "there")
    mine = there.add_and_activate(calibration(65.0), WHO)
    there.add_files(read_export(sent, (trusted_signer,))[0])
    assert there.active_id() == mine
    assert len(there.ids()) == 2


def test_every_wrong_byte_of_an_export_raises_calibration_error(trusted_signer, sent):
    """A thousand single-byte errors, half of them in the first 400 bytes, which are not arrays."""
    whole, draw = sent.read_bytes(), random.Random(3)
    for turn in range(1000):
        at = draw.randrange(len(whole) if turn % 2 else 400)
        changed = whole[:at] + bytes([whole[at] ^ draw.randrange(1, 256)]) + whole[at + 1 :]
        with pytest.raises(CalibrationError):
            verify_export(changed, "sent", (trusted_signer,))
    assert verify_export(whole, "sent", (trusted_signer,))


def test_a_truncated_or_extended_file_is_refused(trusted_signer, sent):
    whole, draw = sent.read_bytes(), random.Random(4)
    for length in (0, 1, 24, 100, 300, len(whole) - 1, *(draw.randrange(len(whole)) for _ in range(100))):
        with pytest.raises(CalibrationError):
            verify_export(whole[:length], "sent", (trusted_signer,))
    with pytest.raises(CalibrationUntrusted):
        verify_export(whole + b"\0", "sent", (trusted_signer,))


def test_an_untrusted_signer_is_refused_with_the_claimed_name(sent, tmp_path):
    stranger = create_key_pair(tmp_path / "stranger", "Another signer")
    with pytest.raises(CalibrationUntrusted, match="Service centre Zürich") as caught:
        read_export(sent, (stranger,))
    assert "--trust" in caught.value.remedy


def test_a_forged_signature_with_a_trusted_name_and_fingerprint_is_refused(trusted_signer, sent, tmp_path):
    create_key_pair(tmp_path / "stranger", trusted_signer.name)
    whole = sent.read_bytes()
    packed = whole[whole.index(b"PK") :]
    with pytest.raises(CalibrationUntrusted, match="damaged or changed"):
        verify_export(signed_by(tmp_path / "stranger", head_of(whole), packed), "sent", (trusted_signer,))


def test_another_export_format_is_distinguished_from_damage(trusted_signer, sent):
    whole = sent.read_bytes().replace(b"diffuscope-calibration 1", b"diffuscope-calibration 0")
    with pytest.raises(CalibrationFormat, match="calibration 0"):
        verify_export(whole, "sent", (trusted_signer,))
    with pytest.raises(CalibrationDamaged, match="not an exported calibration"):
        verify_export(b"\n\n\n\n" + whole, "sent", (trusted_signer,))


def test_another_calibration_format_is_distinguished_from_damage(archive):
    files = archive.files(archive.active_id())
    manifest = archive_module.unsealed(files["manifest.toml"]).replace("format = 1", "format = 0")
    with pytest.raises(CalibrationFormat, match="format 0"):
        archive.add_files(files | {"manifest.toml": archive_module.sealed(manifest)})


def test_an_oversized_file_is_refused_before_reading(trusted_signer, tmp_path):
    oversized = tmp_path / "vast"
    with oversized.open("wb") as file:
        file.truncate(MAX_BYTES + 1)  # a sparse file
    with pytest.raises(CalibrationDamaged, match="larger"):
        read_export(oversized, (trusted_signer,))


# Wrong content with a valid signature: a mistake of the signer, or a stolen key

Files = dict[str, bytes]


def zipped(files: Mapping[str, bytes], **options: int) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", **options) as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    return out.getvalue()


def resealed(files: Files, name: str, content: bytes) -> Files:
    """Return the files with one array replaced, and a manifest with its digest."""
    digest = hashlib.sha256(content).hexdigest()
    manifest = archive_module.unsealed(files["manifest.toml"])
    old = hashlib.sha256(files[name]).hexdigest()
    return files | {name: content, "manifest.toml": archive_module.sealed(manifest.replace(old, digest))}


def with_manifest_text(files: Files, old: str, new: str) -> Files:
    """Return the files with other text in the manifest."""
    manifest = archive_module.unsealed(files["manifest.toml"])
    assert old in manifest.replace('"black_dn"', "black_dn")
    return files | {
        "manifest.toml": archive_module.sealed(manifest.replace('"black_dn"', "black_dn").replace(old, new))
    }


def with_declared_shape(shape: str) -> bytes:
    """Return an array file whose header declares more data than it holds."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 64


def with_outside_path(files: Files) -> bytes:
    manifest = archive_module.unsealed(files["manifest.toml"]).replace('"flat.npy"', '"../flat.npy"')
    moved = {("../flat.npy" if name == "flat.npy" else name): content for name, content in files.items()}
    return zipped(moved | {"manifest.toml": archive_module.sealed(manifest)})


def with_duplicate_name(files: Files) -> bytes:
    once = zipped(files)
    out = io.BytesIO(once)
    with zipfile.ZipFile(out, "a") as packed, pytest.warns(UserWarning, match="Duplicate"):
        packed.writestr("flat.npy", b"another")
    return out.getvalue()


HOSTILE: dict[str, Callable[[Files], bytes]] = {
    "a name that leaves the folder": with_outside_path,
    "an absolute name": lambda files: zipped(files | {"/etc/flat.npy": b"x"}),
    "a bomb": lambda files: zipped(files | {"flat.npy": b"\0" * 10**7}, compression=zipfile.ZIP_DEFLATED),
    "a name twice": with_duplicate_name,
    "a thousand files": lambda files: zipped(files | {f"psf{k}.npy": b"" for k in range(1000)}),
    "one file too many": lambda files: zipped(files | {"plans.npy": b"wisdom"}),
    "one file too few": lambda files: zipped({name: files[name] for name in files if name != "flat.npy"}),
    "no files": lambda files: zipped({}),
    "no zip archive": lambda files: b"PK but not really",
    "an array larger than the memory": lambda files: zipped(
        resealed(files, "flat.npy", with_declared_shape("(1000000, 100000000)"))
    ),
    "an array of objects": lambda files: zipped(
        resealed(files, "flat.npy", with_declared_shape("(1,)").replace(b"<f4", b"|O "))
    ),
    "a manifest as deep as the sea": lambda files: zipped(
        files | {"manifest.toml": archive_module.sealed("format = 1\nx = " + "[" * 50000)}
    ),
    "a flat that is no map": lambda files: zipped(resealed(files, "flat.npy", files["psf0.npy"][:-4])),
    "a black level in words": lambda files: zipped(with_manifest_text(files, "black_dn = 64.25", 'black_dn = "dark"')),
    "a signer's joke as serial number": lambda files: zipped(with_manifest_text(files, '"DS-0042"', "[1, 2]")),
    "an unknown origin": lambda files: zipped(with_manifest_text(files, '"measured"', '"found"')),
    "a manifest of something else": lambda files: zipped(
        {"manifest.toml": archive_module.sealed("format = 1\nsha256 = 3\nid = 4")}
    ),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_signed_files_with_wrong_content_are_refused(archive, trusted_signer, sent, tmp_path, what):
    packed = HOSTILE[what](archive.files(archive.active_id()))
    whole = signed_by(tmp_path / "key", head_of(sent.read_bytes()), packed)
    there = Archive(tmp_path / "deep" / "there")
    with pytest.raises(CalibrationDamaged):
        there.add_files(verify_export(whole, "sent", (trusted_signer,))[0])
    assert there.ids() == ()
    assert not [path for path in (tmp_path / "deep").rglob("*") if path.is_file()]


# Keys


def test_a_private_key_has_mode_0600_and_is_never_overwritten(tmp_path):
    create_key_pair(tmp_path / "key", "Ana")
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600
    before = (tmp_path / "key").read_bytes()
    with pytest.raises(SettingError, match="there already"):
        create_key_pair(tmp_path / "key", "Ana")
    assert (tmp_path / "key").read_bytes() == before
    assert read_signer(tmp_path / "key.pub").name == "Ana"


@pytest.mark.parametrize("name", ["", " Ana", "A\nB", "\x1b[2J", "x" * 200])
def test_an_invalid_signer_name_is_refused(tmp_path, name):
    with pytest.raises(SettingError, match="no name"):
        create_key_pair(tmp_path / "key", name)
    assert not list(tmp_path.iterdir())


def test_an_invalid_key_file_is_refused(archive, trusted_signer, tmp_path):
    files, out = archive.files(archive.active_id()), tmp_path / "out"
    ec = generate_private_key(SECP256R1())
    (tmp_path / "ec").write_bytes(ec.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption()))
    (tmp_path / "ec.pub").write_bytes(ec.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH))
    (tmp_path / "empty").write_bytes(b"")
    for wrong in ("ec", "empty", "absent", "key.pub"):
        with pytest.raises(SettingError):
            export(files, out, tmp_path / wrong)
    for wrong in ("ec.pub", "empty", "absent", "key"):
        with pytest.raises(SettingError):
            read_signer(tmp_path / wrong)
    create_key_pair(tmp_path / "other", "Another signer")
    shutil.copy(tmp_path / "other.pub", tmp_path / "key.pub")
    with pytest.raises(SettingError, match="not the public key"):
        export(files, out, tmp_path / "key")
    assert not out.exists()


def test_an_export_that_cannot_be_written_leaves_no_file(archive, trusted_signer, tmp_path):
    with pytest.raises(SettingError, match="cannot be written"):
        export(archive.files(archive.active_id()), tmp_path / "nowhere" / "out", tmp_path / "key")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SettingError, match="cannot be written"):
        export(archive.files(archive.active_id()), tmp_path / "folder", tmp_path / "key")
    assert not list(tmp_path.glob(".*"))
