"""A small authority per device, which can vouch for that device's own addresses and for nothing else.

A tablet that trusts it trusts this one device: its names and networks are written into it (RFC 5280, name constraints).
"""

from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address, IPv4Network

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from device.clock import Clock

SHARED = "diffuscope.local"  # avahi publishes this name, whichever device it is
ADDRESS = IPv4Address("10.42.0.1")  # of the access point, by NetworkManager's custom
NETWORKS = (IPv4Network("10.42.0.0/24"), IPv4Network("127.0.0.0/8"))
# The first start may think it is 2020 or 2035: the authority must not depend on that.
BEGIN, END = datetime(2020, 1, 1, tzinfo=UTC), datetime(2060, 1, 1, tzinfo=UTC)
DAYS = 390  # of a server's certificate: browsers refuse those of more than 825


def authority(name: str, clock: Clock) -> tuple[bytes, bytes]:
    """A new key and the certificate of its own that says for what it may speak, as PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    permitted = [x509.DNSName(SHARED), x509.DNSName(f"{name}.local"), *(x509.IPAddress(one) for one in NETWORKS)]
    whose = _named(f"{name} made {clock.wall():%Y-%m-%d}")
    certificate = (
        _builder(whose, whose, key.public_key())
        .not_valid_before(BEGIN)
        .not_valid_after(END)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.NameConstraints(permitted, None), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return _pem(key), certificate.public_bytes(serialization.Encoding.PEM)


def server(authority_key: bytes, authority_crt: bytes, name: str, clock: Clock) -> tuple[bytes, bytes]:
    """A new key and certificate for this device's server, as PEM: made at every boot, and never kept."""
    signer = serialization.load_pem_private_key(authority_key, None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    issuer = x509.load_pem_x509_certificate(authority_crt)
    key = ec.generate_private_key(ec.SECP256R1())
    names = [x509.DNSName(SHARED), x509.DNSName(f"{name}.local"), x509.IPAddress(ADDRESS)]
    start = clock.wall() - timedelta(days=1)  # for a tablet whose clock is a little behind
    certificate = (
        _builder(_named(name), issuer.subject, key.public_key())
        .not_valid_before(start)
        .not_valid_after(start + timedelta(days=DAYS))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .sign(signer, hashes.SHA256())
    )
    return _pem(key), certificate.public_bytes(serialization.Encoding.PEM)


def _builder(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
    started = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    own = x509.SubjectKeyIdentifier.from_public_key(key)
    return started.serial_number(x509.random_serial_number()).add_extension(own, critical=False)


def _named(common: str) -> x509.Name:
    organisation = x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Diffuscope")
    return x509.Name([organisation, x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates, key_cert_sign=signs_certificates, crl_sign=signs_certificates,
        content_commitment=False, key_encipherment=False, data_encipherment=False, key_agreement=False,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
