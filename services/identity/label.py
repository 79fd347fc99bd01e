"""Text of `diffuscope label`: how a tablet is paired with this device, and a set-up code."""

import re
from pathlib import Path

from device.clock import Clock
from services.identity.apply_at_boot import Computer, qr_code
from services.identity.certificates import fingerprint, host_names, present_addresses
from services.identity.provision import load_or_create_identity
from services.identity.renewal import AUTHORITY, SERVER, renew_certificate
from services.identity.setup_code import SetupCode
from services.identity.users import FOLDER, UserTable


def pairing_label(data: Path, stored: Path, tls: Path, port: int, clock: Clock) -> str:
    """Return the label of the device whose identity is in `stored`, which is created if it is missing.

    The certificate in `tls` is renewed for the present addresses. `port`: of the pairing page. The new set-up code ends
    an earlier one; with users in `data` the label says what it is for.
    """
    identity = load_or_create_identity(stored, Computer().serial(), clock)
    problem = renew_certificate(identity, stored, tls, clock)
    code = SetupCode(tls, clock).create()
    lines = [f"{identity.name}   serial {identity.serial}", problem]
    if (tls / AUTHORITY).exists():
        shown = fingerprint((tls / AUTHORITY).read_bytes())
        hosts = [f"[{one}]" if one.version == 6 else str(one) for one in present_addresses() if not one.is_loopback]
        urls = [f"http://{host}{'' if port == 80 else f':{port}'}/" for host in hosts or ["127.0.0.1"]]
        lines += [qr_code(f"{urls[0]}#code={code}").decode() or "For a QR code install qrencode."]
        lines += [f"To pair a tablet, open one of: {'  '.join(urls)}", "SHA-256 fingerprint of the authority:"]
        lines += re.findall(r"(?:\S\S ?){8}", shown)  # eight pairs in a line, as on the pairing page
    else:
        lines.append(f"Open https://{host_names((tls / SERVER).read_bytes())[0]}/")
    if UserTable(data / FOLDER).has_begun:
        lines.append("If an administrator forgot the PIN: press Forgotten PIN in the sign-in, and type this code.")
    lines.append(f"Set-up code, for two minutes and five tries: {code[:4]}-{code[4:]}")
    return "\n".join(line for line in lines if line)
