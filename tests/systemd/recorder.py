"""Prefix of the text of device/drivers/blank.py: run as root, it records time, arguments and reason, and ends."""

import os
import sys
import time

if __name__ == "__main__" and "--guard" not in sys.argv:
    with open("/run/blanked", "a", encoding="utf-8") as record:
        why = os.environ.get("SERVICE_RESULT", "-")
        record.write(f"{time.clock_gettime(time.CLOCK_MONOTONIC):.6f} {why} {' '.join(sys.argv[1:])}\n")
    sys.exit(0)
