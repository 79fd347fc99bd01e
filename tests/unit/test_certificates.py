"""Certificates: names and addresses of a device, validity, renewal, authorities with and without constraints."""

import shutil
import ssl
import stat
import subprocess
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from device.clock import SystemClock, VirtualClock
from services.identity.certificates import (
    BUILD_DATE,
    create_authority,
    create_server_certificate,
    host_names,
    present_addresses,
)
from services.identity.provision import Identity, load_or_create_identity
from services.identity.renewal import AUTHORITY, SERVER, UNCONSTRAINED, renew_certificate

NAME = "diffuscope-b2c3d4"
FIB_TRIE = """\
Main:
  +-- 0.0.0.0/0 3 0 5
     |-- {address}
        /32 host LOCAL
     |-- {address}
        /24 link BROADCAST
     |-- 203.0.113.7
        /32 host LOCAL
Local:
     |-- {address}
        /32 host LOCAL
"""
IF_INET6 = """\
fd000000000000000000000000000002 04 40 00 82     eth0
20010db8000000000000000000000002 04 40 00 82     eth0
fe800000000000000000000000000002 04 40 20 82     eth0
"""
needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")


def networks(root: Path, address: str = "192.168.1.20") -> Path:
    """Write the kernel's tables of a computer with this address."""
    (root / "proc/net").mkdir(parents=True, exist_ok=True)
    (root / "proc/net/fib_trie").write_text(FIB_TRIE.format(address=address))
    (root / "proc/net/if_inet6").write_text(IF_INET6)
    return root


@pytest.fixture
def identity(tmp_path: Path) -> Identity:
    return load_or_create_identity(tmp_path / "identity", "10000000a1b2c3d4", SystemClock())


def renew(identity: Identity, folder: Path, clock: VirtualClock | SystemClock, address: str = "192.168.1.20") -> bytes:
    assert renew_certificate(identity, folder / "identity", folder / "tls", clock, networks(folder, address)) == ""
    return (folder / "tls" / SERVER).read_bytes()


def openssl(authority: bytes, pem: bytes, folder: Path, *more: str) -> "subprocess.CompletedProcess[str]":
    (folder / "ca.crt").write_bytes(authority)
    (folder / "leaf.pem").write_bytes(pem)
    words = ["openssl", "verify", "-x509_strict", "-purpose", "sslserver", "-CAfile", folder / "ca.crt", *more]
    return subprocess.run([*words, folder / "leaf.pem"], capture_output=True, text=True, check=False)


def test_private_addresses_of_every_network_are_found(tmp_path: Path) -> None:
    """A public address is not: the constrained authority may not name it, and the chain would be invalid.

    Nor is a link-local one of IPv6, which a browser cannot open.
    """
    expected = tuple(map(ip_address, ("192.168.1.20", "fd00::2")))
    assert present_addresses(networks(tmp_path)) == expected
    assert present_addresses(tmp_path / "without") == ()


@needs_openssl
@pytest.mark.parametrize("authority", ["authority_crt", "unconstrained_crt"])
def test_openssl_accepts_each_name_and_address_under_both_authorities(
    identity: Identity, tmp_path: Path, authority: str
) -> None:
    pem = renew(identity, tmp_path, SystemClock())
    shared = ("diffuscope.local", "diffuscope-2.local", "diffuscope-9.local")  # avahi's, where others have the first
    names = [("hostname", name) for name in (*shared, f"{NAME}.local")]
    names += [("ip", address) for address in ("192.168.1.20", "fd00::2", "10.42.0.1")]
    for kind, name in names:
        result = openssl(getattr(identity, authority), pem, tmp_path, f"-verify_{kind}", name)
        assert result.returncode == 0, result.stdout + result.stderr
    assert openssl(getattr(identity, authority), pem, tmp_path, "-verify_hostname", "bank.example").returncode != 0


@needs_openssl
def test_the_constrained_authority_is_invalid_for_foreign_names_and_public_addresses(
    identity: Identity, tmp_path: Path
) -> None:
    """A stolen device's key must not give valid certificates for a tablet's bank."""
    asked = ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "9"]
    (tmp_path / "ca.crt").write_bytes(identity.authority_crt)
    sign = ["-CA", tmp_path / "ca.crt", "-CAkey", tmp_path / "identity/authority.key"]
    for name in ("DNS:bank.example", "DNS:other.local", "DNS:diffuscope-10.local", "IP:203.0.113.7"):
        out = ["-keyout", tmp_path / "bank.key", "-out", tmp_path / "bank.crt"]
        more = ["-subj", "/CN=bank", "-addext", f"subjectAltName={name}"]
        subprocess.run(["openssl", *asked, *sign, *more, *out], check=True, capture_output=True)
        result = openssl(identity.authority_crt, (tmp_path / "bank.crt").read_bytes(), tmp_path)
        assert "permitted subtree violation" in result.stdout + result.stderr


@pytest.mark.parametrize("years", [-20, 0, 5])
def test_validity_tolerates_a_wrong_clock_and_is_at_most_397_days(years: int) -> None:
    """A clock before the build of the program counts as the date of the build; a tablet may be 30 days behind."""
    now = datetime.now(UTC) + timedelta(days=365 * years)
    authority = create_authority(NAME, VirtualClock(now))[:2]
    certificate = x509.load_pem_x509_certificate(create_server_certificate(*authority, NAME, VirtualClock(now)))
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    assert begin == max(BUILD_DATE, (now - timedelta(days=30)).replace(microsecond=0))
    assert end - begin == timedelta(days=397)


def test_each_renewal_has_the_present_addresses_and_the_whole_validity(identity: Identity, tmp_path: Path) -> None:
    """Another address, a day later, and a clock that was set back: the certificate has nothing of the one before."""
    clock = VirtualClock(datetime.now(UTC) + timedelta(days=3000))
    for days, address in ((0, "192.168.1.20"), (1, "192.168.1.21"), (-1000, "192.168.1.21")):
        clock.elapsed_s = timedelta(days=days).total_seconds()
        certificate = x509.load_pem_x509_certificate(renew(identity, tmp_path, clock, address))
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        expected = [ip_address(one) for one in ("10.42.0.1", address, "fd00::2")]
        assert names.get_values_for_type(x509.IPAddress) == expected
        assert clock.wall() - certificate.not_valid_before_utc < timedelta(days=30, seconds=1)
    assert stat.S_IMODE((tmp_path / "tls" / SERVER).stat().st_mode) == 0o640


@pytest.fixture
def programme(tmp_path: Path, identity: Identity) -> Path:
    """Folder of the identity, with the certificate and key of a programme."""
    pair(tmp_path / "identity", 30)
    return tmp_path / "identity"


def pair(folder: Path, days: int, name: str = "eye.example.org") -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "eye")])
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(subject).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number()).not_valid_before(datetime(2020, 1, 1, tzinfo=UTC))
    builder = builder.not_valid_after(datetime.now(UTC) + timedelta(days=days))
    if name:
        builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
    pem, encryption = serialization.Encoding.PEM, serialization.NoEncryption()
    (folder / "programme.crt").write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(pem))
    (folder / "programme.key").write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, encryption))


def test_a_valid_programme_certificate_is_used_until_it_is_gone(
    identity: Identity, programme: Path, tmp_path: Path
) -> None:
    assert host_names(renew(identity, tmp_path, SystemClock())) == ["eye.example.org"]
    assert [file.name for file in (tmp_path / "tls").iterdir()] == [SERVER], "no tablet needs the authority"
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(tmp_path / "tls" / SERVER)
    (programme / "programme.crt").unlink()
    assert f"{NAME}.local" in host_names(renew(identity, tmp_path, SystemClock()))
    assert {file.name for file in (tmp_path / "tls").iterdir()} == {SERVER, AUTHORITY, UNCONSTRAINED}


@pytest.mark.parametrize("fault", ["expired", "foreign", "unreadable", "nameless", "no key"])
def test_another_programme_certificate_is_refused_and_the_own_one_used(
    identity: Identity, programme: Path, tmp_path: Path, fault: str
) -> None:
    reasons = {"expired": "ended on", "nameless": "has no host name"}
    if fault == "expired":
        pair(programme, -1)
    elif fault == "nameless":
        pair(programme, 30, "")
    elif fault == "foreign":
        shutil.copy(programme / "authority.key", programme / "programme.key")
    elif fault == "no key":
        (programme / "programme.key").unlink()
    else:
        (programme / "programme.crt").write_bytes(b"no certificate")
    refusal = renew_certificate(identity, programme, tmp_path / "tls", SystemClock(), networks(tmp_path))
    assert reasons.get(fault, "cannot be used with its key") in refusal
    assert "Replace programme.crt and programme.key" in refusal
    assert f"{NAME}.local" in host_names((tmp_path / "tls" / SERVER).read_bytes())
