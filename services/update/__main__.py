"""Entry point `python -m services.update`: the subcommands of `diffuscope update` without the rest of the program.

The systemd units run it. It commits a new version only if that version is healthy, so it must not depend on the
checked parts: numerics, drivers and server are not imported.
"""

from services.update.command import main

main()
