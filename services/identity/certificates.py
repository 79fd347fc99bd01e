"""Certificate authority of one device, limited by name constraints (RFC 5280) to its names and private addresses.

`services/identity/decisions/0003-one-key-two-authorities.md` states why it has a second certificate without them.
"""

import re
import ssl
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address, IPv6Address, ip_address, ip_network
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from device.clock import Clock

Address = IPv4Address | IPv6Address
# avahi publishes the first one on every device, and the next free one if another device in the network has it.
SHARED_HOST_NAMES = ("diffuscope.local", *(f"diffuscope-{number}.local" for number in range(2, 10)))
ACCESS_POINT_ADDRESS = IPv4Address("10.42.0.1")  # of the access point: NetworkManager's default
PRIVATE = "10.0.0.0/8 172.16.0.0/12 192.168.0.0/16 169.254.0.0/16 127.0.0.0/8 fc00::/7 ::1/128"
NETWORKS = tuple(ip_network(network) for network in PRIVATE.split())
# The clock at the first boot may be years wrong: the authority's validity does not depend on it.
AUTHORITY_BEGIN = datetime(2020, 1, 1, tzinfo=UTC)
AUTHORITY_END = datetime(2060, 1, 1, tzinfo=UTC)
VALIDITY = timedelta(days=397)  # browsers refuse server certificates of 399 days or more from public authorities
BUILD_DATE = datetime.fromtimestamp(int(Path(__file__).stat().st_mtime), UTC)  # an image has that of its commit
CLOCK_TOLERANCE = timedelta(days=30)  # of a tablet whose clock is behind


def present_addresses(root: Path = Path("/")) -> tuple[Address, ...]:
    """Return the private addresses of this computer, from the kernel's tables below `root`, those of loopback included.

    Public ones are left out: one name outside of the constraints makes the whole certificate invalid. So are link-local
    ones of IPv6, which no browser opens: they are valid with the name of a network interface only.
    """
    tables = root / "proc/net/fib_trie", root / "proc/net/if_inet6"
    ipv4, ipv6 = (table.read_text() if table.exists() else "" for table in tables)
    found = {ip_address(text) for text in re.findall(r"\|-- (\S+)\n\s+/32 host LOCAL", ipv4)}
    found |= {ip_address(bytes.fromhex(line[:32])) for line in ipv6.splitlines()}
    named = [one for one in found if any(one in network for network in NETWORKS)]
    return tuple(sorted(named, key=lambda one: (one.version, int(one))))


def create_authority(name: str, clock: Clock) -> tuple[bytes, bytes, bytes]:
    """Return a new private key and two self-signed authority certificates of it, as PEM.

    The first certificate is limited to device `name` and private networks, the second one is not.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    permitted = [*_host_names(name), *map(x509.IPAddress, NETWORKS)]
    subject = _distinguished_name(f"{name} made {clock.wall():%Y-%m-%d}")
    constrained = _signed_authority(key, subject, x509.NameConstraints(permitted, None))
    return _pem(key), constrained, _signed_authority(key, subject)


def _signed_authority(key: ec.EllipticCurvePrivateKey, subject: x509.Name, *more: x509.ExtensionType) -> bytes:
    builder = _builder(subject, subject, key.public_key())
    for extension in (x509.BasicConstraints(ca=True, path_length=0), _usage(signs_certificates=True), *more):
        builder = builder.add_extension(extension, critical=True)
    certificate = builder.not_valid_before(AUTHORITY_BEGIN).not_valid_after(AUTHORITY_END).sign(key, hashes.SHA256())
    return certificate.public_bytes(serialization.Encoding.PEM)


def create_server_certificate(
    authority_key: bytes, authority_crt: bytes, name: str, clock: Clock, addresses: Iterable[Address] = ()
) -> bytes:
    """Return a new private key with its server certificate for device `name` and `addresses`, as one PEM text.

    It begins `CLOCK_TOLERANCE` before now, not before the build of this program, and is valid for `VALIDITY`. One text,
    since two files could not be replaced at the same moment.
    """
    signer = serialization.load_pem_private_key(authority_key, None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    issuer = x509.load_pem_x509_certificate(authority_crt)
    key = ec.generate_private_key(ec.SECP256R1())
    named = dict.fromkeys([ACCESS_POINT_ADDRESS, *addresses])  # the access point may start later
    names = [*_host_names(name), *map(x509.IPAddress, named)]
    start = max(_now(clock) - CLOCK_TOLERANCE, BUILD_DATE)
    certificate = (
        _builder(_distinguished_name(name), issuer.subject, key.public_key())
        .not_valid_before(start)
        .not_valid_after(start + VALIDITY)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .sign(signer, hashes.SHA256())
    )
    return _pem(key) + certificate.public_bytes(serialization.Encoding.PEM)


def check_validity(chain: Path, key: Path, clock: Clock) -> None:
    """Raise ValueError for a certificate of another key, an expired one, and files that cannot be read."""
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(chain, key, password="")
    except OSError as error:  # ssl.SSLError is one
        raise ValueError(f"cannot be used with its key: {error}") from error
    if (end := x509.load_pem_x509_certificate(chain.read_bytes()).not_valid_after_utc) <= _now(clock):
        raise ValueError(f"ended on {end:%Y-%m-%d}")
    if not host_names(chain.read_bytes()):
        raise ValueError("has no host name")


def host_names(pem: bytes) -> list[str]:
    """Return the host names of the first certificate of a PEM text."""
    extensions = x509.load_pem_x509_certificate(pem).extensions
    kept = [one.value for one in extensions if isinstance(one.value, x509.SubjectAlternativeName)]
    return [name for value in kept for name in value.get_values_for_type(x509.DNSName)]


def fingerprint(pem: bytes) -> str:
    """Return the SHA-256 fingerprint of a certificate as tablets show it: 32 pairs of hexadecimal digits."""
    return x509.load_pem_x509_certificate(pem).fingerprint(hashes.SHA256()).hex(" ").upper()


def _host_names(name: str) -> list[x509.DNSName]:
    return [x509.DNSName(host) for host in (*SHARED_HOST_NAMES, f"{name}.local")]


def _now(clock: Clock) -> datetime:
    """Return the time, or the date of the build for a clock that is before it."""
    return max(clock.wall(), BUILD_DATE)


def _builder(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
    started = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    own = x509.SubjectKeyIdentifier.from_public_key(key)
    return started.serial_number(x509.random_serial_number()).add_extension(own, critical=False)


def _distinguished_name(common: str) -> x509.Name:
    organisation = x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Diffuscope")
    return x509.Name([organisation, x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    """Return the key usage of an authority, or of a server."""
    others = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        **dict.fromkeys((*others, "encipher_only", "decipher_only"), False),
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
