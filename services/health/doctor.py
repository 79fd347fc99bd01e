"""Examination of the computer and of a head: what is missing, with the remedy of its cause.

`CHECKS` is the list of checks; each gets the machine and the head's specification, and yields its findings.
"""

import errno
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from pydantic import BaseModel

from device.clock import Clock
from device.config.device_nodes import GPIO, I2C, SPI, STRICT_GPIO, NodeKind
from device.config.head_file import InstrumentSpec
from device.head import probe

CONFIG = "boot/firmware/config.txt"
State = Literal["ok", "warning", "failed"]


class DoctorFinding(BaseModel):
    """Result of one check; `remedy` is "" where nothing is to be done."""

    check: str
    state: State
    reading: str
    remedy: str = ""


class DoctorReport(BaseModel):
    """All findings, in the order of the checks; `version` rises when a key changes its meaning."""

    version: int = 1
    head: str | None = None
    findings: tuple[DoctorFinding, ...]

    @property
    def healthy(self) -> bool:
        """Whether no check failed; warnings do not count."""
        return all(finding.state != "failed" for finding in self.findings)


@dataclass(frozen=True)
class Machine:
    """Computer under examination: its file system below `root`, and the clock for the parts of a head."""

    clock: Clock
    root: Path = Path("/")
    leds: bool = False  # light each LED

    def text(self, path: str) -> str | None:
        """Return a text file without NUL bytes; None if it cannot be read."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").replace("\0", "")
        except OSError:
            return None

    def error_number(self, device: str) -> int | None:
        """Return the error number that opening a device file would give; None if it can be opened."""
        path = self.root / device.lstrip("/")
        if not path.exists():
            return errno.ENOENT
        return None if os.access(path, os.R_OK | os.W_OK) else errno.EACCES

    def is_set(self, line: str) -> bool:
        """Return whether config.txt has this line, such as dtparam=spi=on."""
        return line in [entry.split("#")[0].strip() for entry in (self.text(CONFIG) or "").splitlines()]


Check = Callable[[Machine, InstrumentSpec | None], Iterator[DoctorFinding]]


def computer(machine: Machine, spec: InstrumentSpec | None) -> Iterator[DoctorFinding]:
    """Yield the computer's model: a warning where a head needs a Raspberry Pi and this is none."""
    model = machine.text("proc/device-tree/model")
    if model is not None and "Raspberry Pi" in model:
        yield DoctorFinding(check="computer", state="ok", reading=model.strip())
        return
    needed = spec is None or spec.camera.backend == "picamera2" or bool(_nodes(spec))
    yield DoctorFinding(
        check="computer",
        state="warning" if needed else "ok",
        reading=model or "no Raspberry Pi",
        remedy="Run the doctor on the Raspberry Pi to which the head is connected." if needed else "",
    )


def libraries(_: Machine, spec: InstrumentSpec | None) -> Iterator[DoctorFinding]:
    """Yield one finding per library that the head's drivers import."""
    for name, package in _libraries(spec):
        there = find_spec(name) is not None
        yield DoctorFinding(
            check=f"library {name}",
            state="ok" if there else "failed",
            reading="found" if there else "not found",
            remedy="" if there else f"Install it: sudo apt install {package}, then make pi, so that .venv sees it.",
        )


def buses(machine: Machine, spec: InstrumentSpec | None) -> Iterator[DoctorFinding]:
    """Yield one finding per device file of a bus that the head names: there, and open to this user."""
    for device, kind in _nodes(spec):
        number = machine.error_number(device)
        if number is None:
            yield DoctorFinding(check=device, state="ok", reading="there, and may be opened")
            continue
        reading = "not there" if number == errno.ENOENT else "there, but not for this user"
        remedy = kind.remedy(device, number, machine.root) or ""
        is_on = kind.switch is not None and machine.is_set(kind.switch)
        if number == errno.ENOENT and not kind.others(machine.root) and is_on:
            remedy = f"{kind.switch} is set: restart the computer."
            if kind is I2C:
                remedy += " If it stays away, load the module: echo i2c-dev | sudo tee /etc/modules-load.d/i2c.conf"
        yield DoctorFinding(check=device, state="failed", reading=reading, remedy=remedy)


def gate(machine: Machine, spec: InstrumentSpec | None) -> Iterator[DoctorFinding]:
    """Yield the state of the lamp's gate: a real ring without heartbeat is not for eyes."""
    if spec is None or spec.light.backend not in ("apa102", "tlc5971"):
        return
    if spec.gpio is None or spec.gpio.heartbeat is None:
        yield DoctorFinding(
            check="gate",
            state="warning",
            reading="the head file names no heartbeat: not for eyes",
            remedy="Build the gate (hardware/dead-man.md), then add [gpio] to the head file.",
        )
    elif not machine.is_set(STRICT_GPIO):
        yield DoctorFinding(
            check="gate",
            state="warning",
            reading=f"{STRICT_GPIO} is not set: a line keeps its level after a crash",
            remedy=f"Add the line {STRICT_GPIO} to /boot/firmware/config.txt, and restart the computer.",
        )
    else:
        yield DoctorFinding(check="gate", state="ok", reading=f"heartbeat on GPIO{spec.gpio.heartbeat}")


def parts(machine: Machine, spec: InstrumentSpec | None) -> Iterator[DoctorFinding]:
    """Yield the findings on lamp, camera, black level, mosaic and chips, and on each LED with `--parts`."""
    if spec is None or spec.camera.backend == "replay":
        return
    for found in probe(spec, machine.clock, leds=machine.leds):
        state: State = "failed" if not found.ok else "warning" if found.part == "mosaic" else "ok"
        yield DoctorFinding(check=found.part, state=state, reading=found.reading, remedy=found.remedy)


CHECKS: tuple[Check, ...] = (computer, libraries, buses, gate, parts)


def examine(machine: Machine, spec: InstrumentSpec | None, checks: tuple[Check, ...] = CHECKS) -> DoctorReport:
    """Run the checks one after the other; without a head those of the computer."""
    findings = tuple(found for check in checks for found in check(machine, spec))
    return DoctorReport(head=None if spec is None else spec.name, findings=findings)


def table(report: DoctorReport) -> str:
    """Return the report as text: one line per check, and its remedy below it."""
    lines = []
    for finding in report.findings:
        lines.append(f"{finding.state:<8} {finding.check:<18} {finding.reading}")
        if finding.remedy:
            lines.append(f"{'':<28}{finding.remedy}")
    return "\n".join(lines)


def _nodes(spec: InstrumentSpec | None) -> list[tuple[str, NodeKind]]:
    """Return the device files of a head with their kinds; without a head those of the header's first buses."""
    if spec is None:
        return [("/dev/spidev0.0", SPI), ("/dev/i2c-1", I2C), ("/dev/gpiochip0", GPIO)]
    light = spec.light
    bus = spec.bus
    gpio = spec.gpio
    found = list[tuple[str, NodeKind]]()
    if light.backend == "apa102" and light.chain is not None:
        found.append((light.chain.device, SPI))
    if light.backend == "tlc5971" and light.sinks is not None:
        found.append((light.sinks.device, SPI))
    if bus is not None and bus.backend == "smbus":
        found.append((bus.device, I2C))
    if gpio is not None and gpio.backend == "gpiod":
        found.append((gpio.chip, GPIO))
    return found


def _libraries(spec: InstrumentSpec | None) -> list[tuple[str, str]]:
    """Return the libraries that the drivers of a head import, with their Debian packages."""
    kinds = {kind for _, kind in _nodes(spec)}
    found = [("picamera2", "python3-picamera2"), ("libcamera", "python3-libcamera")]
    if spec is not None and spec.camera.backend != "picamera2":
        found = []
    names = {SPI: ("spidev", "python3-spidev"), I2C: ("smbus2", "python3-smbus2"), GPIO: ("gpiod", "python3-libgpiod")}
    return [*found, *(names[kind] for kind in (SPI, I2C, GPIO) if kind in kinds)]
