"""Server certificate of the device for its present addresses, renewed in the folder from which the server reads it.

`systemd/diffuscope-certificate.service` runs this module as root at each change of an address and once a day: the
server has no access to the key of the authority, and none to the network's addresses.
"""

import sys
from pathlib import Path

from device import atomic_io
from device.clock import Clock, SystemClock
from services.identity.apply_at_boot import Computer
from services.identity.certificates import check_validity, create_server_certificate, present_addresses
from services.identity.provision import Identity, load_or_create_identity

SERVER, AUTHORITY, UNCONSTRAINED = "server.pem", "authority.crt", "authority-unconstrained.crt"
OUTPUT = "run/diffuscope-tls"  # of the device
GROUP_READABLE = 0o640  # the group of the folder is that of the server
REMEDY = "Replace programme.crt and programme.key by a valid pair. Until then the device uses its own certificate."


def renew_certificate(identity: Identity, stored: Path, output: Path, clock: Clock, root: Path = Path("/")) -> str:
    """Write a new server certificate for the present addresses into `output`; return why a programme's one is refused.

    "" if none is. The pair programme.crt and programme.key in the folder `stored` of the identity is used where it is
    valid; then no authority is beside it. `root`: of the kernel's tables of addresses.
    """
    problem, chain, key = "", stored / "programme.crt", stored / "programme.key"
    authority = identity.authority_key, identity.authority_crt
    own = create_server_certificate(*authority, identity.name, clock, present_addresses(root))
    files = {AUTHORITY: identity.authority_crt, UNCONSTRAINED: identity.unconstrained_crt, SERVER: own}
    if chain.exists():
        try:
            check_validity(chain, key, clock)
            files = {SERVER: key.read_bytes() + chain.read_bytes()}
        except ValueError as error:
            problem = f"The certificate {chain} {error}. {REMEDY}"
    atomic_io.make_folder(output)
    for name in (AUTHORITY, UNCONSTRAINED, SERVER):
        if name in files:
            atomic_io.write_atomically(output / name, files[name], GROUP_READABLE)
        else:
            (output / name).unlink(missing_ok=True)
    return problem


if __name__ == "__main__":
    computer = Computer()
    stored = computer.data / "identity"
    identity = load_or_create_identity(stored, computer.serial(), SystemClock())
    sys.stderr.write(renew_certificate(identity, stored, computer.root / OUTPUT, SystemClock()))
