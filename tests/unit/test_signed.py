"""A calibration on its way between two computers: believed only from those who are trusted, and as they signed it."""

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

from device.calibration import archive as kept
from device.calibration.archive import Archive
from device.calibration.signed import MOST_BYTES, Signer, export, new_key, opened, read_export, read_signer
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
    made.keep(calibration(), WHO)
    return made


@pytest.fixture
def centre(tmp_path: Path) -> Signer:
    return new_key(tmp_path / "key", "Service centre Zürich")


@pytest.fixture
def sent(archive: Archive, centre: Signer, tmp_path: Path) -> Path:
    file = tmp_path / "sent.calibration"
    export(archive.files(archive.current()), file, tmp_path / "key")
    return file


def signed_by(key: Path, head: bytes, packed: bytes) -> bytes:
    """A file as a signer could make it who does not use this software."""
    private = load_ssh_private_key(key.read_bytes(), None)
    assert isinstance(private, Ed25519PrivateKey)
    return head + private.sign(head + packed).hex().encode() + b"\n" + packed


def head_of(whole: bytes) -> bytes:
    return b"\n".join(whole.split(b"\n")[:3]) + b"\n"


def test_what_arrives_is_what_was_kept_byte_for_byte(archive, centre, sent, tmp_path):
    files, signer = read_export(sent, (new_key(tmp_path / "other", "Somebody"), centre))
    assert signer.name == "Service centre Zürich"
    there = Archive(tmp_path / "there")
    id = there.adopt(files)
    assert there.files(id) == archive.files(id)
    assert there.load(id).provenance == WHO


def test_what_arrives_is_not_in_force(centre, sent, tmp_path):
    there = Archive(tmp_path / "there")
    mine = there.keep(calibration(65.0), WHO)
    there.adopt(read_export(sent, (centre,))[0])
    assert there.current() == mine
    assert len(there.ids()) == 2


def test_every_wrong_byte_of_the_file_is_noticed_and_none_crashes(centre, sent):
    """A thousand, half of them in the few hundred bytes that are not arrays."""
    whole, draw = sent.read_bytes(), random.Random(3)
    for turn in range(1000):
        at = draw.randrange(len(whole) if turn % 2 else 400)
        changed = whole[:at] + bytes([whole[at] ^ draw.randrange(1, 256)]) + whole[at + 1 :]
        with pytest.raises(CalibrationError):
            opened(changed, "sent", (centre,))
    assert opened(whole, "sent", (centre,))


def test_a_file_that_ends_too_early_or_too_late_is_refused(centre, sent):
    whole, draw = sent.read_bytes(), random.Random(4)
    for length in (0, 1, 24, 100, 300, len(whole) - 1, *(draw.randrange(len(whole)) for _ in range(100))):
        with pytest.raises(CalibrationError):
            opened(whole[:length], "sent", (centre,))
    with pytest.raises(CalibrationUntrusted):
        opened(whole + b"\0", "sent", (centre,))


def test_a_stranger_is_named_as_he_names_himself_and_refused(sent, tmp_path):
    stranger = new_key(tmp_path / "stranger", "Somebody")
    with pytest.raises(CalibrationUntrusted, match="Service centre Zürich") as told:
        read_export(sent, (stranger,))
    assert "--trust" in told.value.remedy


def test_a_stranger_who_takes_the_name_and_mark_of_the_trusted_is_refused(centre, sent, tmp_path):
    new_key(tmp_path / "stranger", centre.name)
    whole = sent.read_bytes()
    packed = whole[whole.index(b"PK") :]
    with pytest.raises(CalibrationUntrusted, match="damaged or changed"):
        opened(signed_by(tmp_path / "stranger", head_of(whole), packed), "sent", (centre,))


def test_another_format_is_told_from_damage(centre, sent):
    whole = sent.read_bytes().replace(b"diffuscope-calibration 1", b"diffuscope-calibration 0")
    with pytest.raises(CalibrationFormat, match="calibration 0"):
        opened(whole, "sent", (centre,))
    with pytest.raises(CalibrationDamaged, match="not an exported calibration"):
        opened(b"\n\n\n\n" + whole, "sent", (centre,))


def test_a_calibration_of_another_format_is_told_from_damage(archive):
    files = archive.files(archive.current())
    said = kept._unsealed(files["manifest.toml"]).replace("format = 1", "format = 0")
    with pytest.raises(CalibrationFormat, match="format 0"):
        archive.adopt(files | {"manifest.toml": kept._sealed(said)})


def test_a_file_larger_than_any_calibration_is_not_even_read(centre, tmp_path):
    vast = tmp_path / "vast"
    with vast.open("wb") as file:
        file.truncate(MOST_BYTES + 1)  # no such bytes are on the disk
    with pytest.raises(CalibrationDamaged, match="larger"):
        read_export(vast, (centre,))


# What a trusted signer could send by mistake, or after a theft of the key

Files = dict[str, bytes]


def zipped(files: Mapping[str, bytes], **options: int) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", **options) as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    return out.getvalue()


def resealed(files: Files, name: str, content: bytes) -> Files:
    """With one array replaced, and a manifest that vouches for it."""
    digest = kept.hashlib.sha256(content).hexdigest()
    said = kept._unsealed(files["manifest.toml"])
    old = kept.hashlib.sha256(files[name]).hexdigest()
    return files | {name: content, "manifest.toml": kept._sealed(said.replace(old, digest))}


def saying(files: Files, old: str, new: str) -> Files:
    """With other words in its manifest."""
    said = kept._unsealed(files["manifest.toml"])
    assert old in said.replace('"black_dn"', "black_dn")
    return files | {"manifest.toml": kept._sealed(said.replace('"black_dn"', "black_dn").replace(old, new))}


def promising(shape: str) -> bytes:
    """An array file whose header promises more than there is."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 64


def outside(files: Files) -> bytes:
    said = kept._unsealed(files["manifest.toml"]).replace('"flat.npy"', '"../flat.npy"')
    moved = {("../flat.npy" if name == "flat.npy" else name): content for name, content in files.items()}
    return zipped(moved | {"manifest.toml": kept._sealed(said)})


def twice(files: Files) -> bytes:
    once = zipped(files)
    out = io.BytesIO(once)
    with zipfile.ZipFile(out, "a") as packed, pytest.warns(UserWarning, match="Duplicate"):
        packed.writestr("flat.npy", b"another")
    return out.getvalue()


HOSTILE: dict[str, Callable[[Files], bytes]] = {
    "a name that leaves the folder": outside,
    "an absolute name": lambda files: zipped(files | {"/etc/flat.npy": b"x"}),
    "a bomb": lambda files: zipped(files | {"flat.npy": b"\0" * 10**7}, compression=zipfile.ZIP_DEFLATED),
    "a name twice": twice,
    "a thousand files": lambda files: zipped(files | {f"psf{k}.npy": b"" for k in range(1000)}),
    "one file too many": lambda files: zipped(files | {"plans.npy": b"wisdom"}),
    "one file too few": lambda files: zipped({name: files[name] for name in files if name != "flat.npy"}),
    "no files": lambda files: zipped({}),
    "no zip archive": lambda files: b"PK but not really",
    "an array larger than the memory": lambda files: zipped(
        resealed(files, "flat.npy", promising("(1000000, 100000000)"))
    ),
    "an array of objects": lambda files: zipped(
        resealed(files, "flat.npy", promising("(1,)").replace(b"<f4", b"|O "))
    ),
    "a manifest as deep as the sea": lambda files: zipped(
        files | {"manifest.toml": kept._sealed("format = 1\nx = " + "[" * 50000)}
    ),
    "a flat that is no map": lambda files: zipped(resealed(files, "flat.npy", files["psf0.npy"][:-4])),
    "a black level in words": lambda files: zipped(saying(files, "black_dn = 64.25", 'black_dn = "dark"')),
    "a signer's joke as serial number": lambda files: zipped(saying(files, '"DS-0042"', "[1, 2]")),
    "an origin that nobody knows": lambda files: zipped(saying(files, '"measured"', '"found"')),
    "a manifest of something else": lambda files: zipped(
        {"manifest.toml": kept._sealed("format = 1\nsha256 = 3\nid = 4")}
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_signature_does_not_open_the_door_to_everything(archive, centre, sent, tmp_path, what):
    packed = HOSTILE[what](archive.files(archive.current()))
    whole = signed_by(tmp_path / "key", head_of(sent.read_bytes()), packed)
    there = Archive(tmp_path / "deep" / "there")
    with pytest.raises(CalibrationDamaged):
        there.adopt(opened(whole, "sent", (centre,))[0])
    assert there.ids() == ()
    assert not [path for path in (tmp_path / "deep").rglob("*") if path.is_file()]


# Keys


def test_a_private_key_is_for_its_owner_only_and_is_never_overwritten(tmp_path):
    new_key(tmp_path / "key", "Ana")
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600
    before = (tmp_path / "key").read_bytes()
    with pytest.raises(SettingError, match="there already"):
        new_key(tmp_path / "key", "Ana")
    assert (tmp_path / "key").read_bytes() == before
    assert read_signer(tmp_path / "key.pub").name == "Ana"


@pytest.mark.parametrize("name", ["", " Ana", "A\nB", "\x1b[2J", "x" * 200])
def test_a_name_that_a_line_cannot_carry_is_refused(tmp_path, name):
    with pytest.raises(SettingError, match="no name"):
        new_key(tmp_path / "key", name)
    assert not list(tmp_path.iterdir())


def test_a_key_that_is_none_is_refused_with_what_to_give(archive, centre, tmp_path):
    files, out = archive.files(archive.current()), tmp_path / "out"
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
    new_key(tmp_path / "other", "Somebody")
    shutil.copy(tmp_path / "other.pub", tmp_path / "key.pub")
    with pytest.raises(SettingError, match="not the public key"):
        export(files, out, tmp_path / "key")
    assert not out.exists()


def test_an_export_that_cannot_be_written_says_so_and_leaves_nothing(archive, centre, tmp_path):
    with pytest.raises(SettingError, match="cannot be written"):
        export(archive.files(archive.current()), tmp_path / "nowhere" / "out", tmp_path / "key")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SettingError, match="cannot be written"):
        export(archive.files(archive.current()), tmp_path / "folder", tmp_path / "key")
    assert not list(tmp_path.glob(".*"))
