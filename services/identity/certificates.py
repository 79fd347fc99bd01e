"""Certificate authority of one device, limited by name constraints (RFC 5280) to that device's own names and networks.

A tablet that trusts the authority trusts this one device only.
"""

from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address, IPv4Network

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from device.clock import Clock

SHARED_HOST_NAME = "diffuscope.local"  # published by avahi on every device
ACCESS_POINT_ADDRESS = IPv4Address("10.42.0.1")  # of the access point: NetworkManager's default
NETWORKS = (IPv4Network("10.42.0.0/24"), IPv4Network("127.0.0.0/8"))
# The clock at the first boot may be years wrong: the authority's validity does not depend on it.
AUTHORITY_BEGIN = datetime(2020, 1, 1, tzinfo=UTC)
AUTHORITY_END = datetime(2060, 1, 1, tzinfo=UTC)
SERVER_CERTIFICATE_DAYS = 390  # validity of a server certificate; browsers refuse more than 825 days


def create_authority(name: str, clock: Clock) -> tuple[bytes, bytes]:
    """Return a new private key and a self-signed authority certificate limited to device `name`, both as PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    permitted = [
        x509.DNSName(SHARED_HOST_NAME),
        x509.DNSName(f"{name}.local"),
        *(x509.IPAddress(network) for network in NETWORKS),
    ]
    subject = _distinguished_name(f"{name} made {clock.wall():%Y-%m-%d}")
    certificate = (
        _builder(subject, subject, key.public_key())
        .not_valid_before(AUTHORITY_BEGIN)
        .not_valid_after(AUTHORITY_END)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.NameConstraints(permitted, None), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return _pem(key), certificate.public_bytes(serialization.Encoding.PEM)


def create_server_certificate(
    authority_key: bytes, authority_crt: bytes, name: str, clock: Clock
) -> tuple[bytes, bytes]:
    """Return a new private key and server certificate, signed by the authority, as PEM.

    Made at every boot, never stored; valid for `SERVER_CERTIFICATE_DAYS`, beginning one day before the current time.
    """
    signer = serialization.load_pem_private_key(authority_key, None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    issuer = x509.load_pem_x509_certificate(authority_crt)
    key = ec.generate_private_key(ec.SECP256R1())
    names = [x509.DNSName(SHARED_HOST_NAME), x509.DNSName(f"{name}.local"), x509.IPAddress(ACCESS_POINT_ADDRESS)]
    start = clock.wall() - timedelta(days=1)  # tolerance for a tablet whose clock is behind
    certificate = (
        _builder(_distinguished_name(name), issuer.subject, key.public_key())
        .not_valid_before(start)
        .not_valid_after(start + timedelta(days=SERVER_CERTIFICATE_DAYS))
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


def _distinguished_name(common: str) -> x509.Name:
    organisation = x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Diffuscope")
    return x509.Name([organisation, x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
