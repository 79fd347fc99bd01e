"""`diffuscope doctor`: each cause has its own remedy, and every head file of the project can be examined."""

import errno
from pathlib import Path

import pytest
from typer.testing import CliRunner

from device.clock import SystemClock
from device.config.device_nodes import GPIO, I2C, SPI
from device.config.head_file import load_head
from device.drivers.chips import I2cBus
from device.drivers.no_light import NoLight
from device.drivers.spi_bus import SpiBus
from device.errors import HardwareError, LightFault, SpecError
from device.head import is_simulated, kind_of, open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.values import Illumination
from services.cli import app
from services.health.doctor import CONFIG, DoctorReport, Machine, buses, computer, examine, gate, table
from services.imaging.picture_files import read_raw_tiff

HEADS = Path(__file__).parents[2] / "hardware" / "heads"
POWER, BENCH = HEADS / "imx296_power.toml", HEADS / "bench.toml"


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    """Return a Raspberry Pi without any bus."""
    for name, content in (("proc/device-tree/model", "Raspberry Pi 5 Model B\0"), (CONFIG, "# empty\n")):
        (path := tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    (tmp_path / "dev").mkdir()
    return Machine(SystemClock(), tmp_path)


def remedies(machine: Machine) -> dict[str, str]:
    return {finding.check: finding.remedy for finding in buses(machine, load_head(POWER))}


def test_a_bus_that_is_off_is_switched_on_by_its_own_line(machine: Machine) -> None:
    found = remedies(machine)
    assert "dtparam=spi=on" in found["/dev/spidev0.0"]
    assert "dtparam=i2c_arm=on" in found["/dev/i2c-1"]
    assert "without any setting" in found["/dev/gpiochip0"]


def test_a_bus_that_is_switched_on_but_absent_needs_a_restart(machine: Machine) -> None:
    (machine.root / CONFIG).write_text("dtparam=spi=on  # lamp\ndtparam=i2c_arm=on\n")
    found = remedies(machine)
    assert "restart the computer" in found["/dev/spidev0.0"]
    assert "i2c-dev" in found["/dev/i2c-1"]


def test_another_node_than_the_head_files_is_named(machine: Machine) -> None:
    (machine.root / "dev" / "spidev10.0").touch()
    assert "This computer has /dev/spidev10.0" in remedies(machine)["/dev/spidev0.0"]


def test_present_buses_are_well_and_each_kind_names_its_group(machine: Machine) -> None:
    for name in ("spidev0.0", "i2c-1", "gpiochip0"):
        (machine.root / "dev" / name).touch()
    assert {finding.state for finding in buses(machine, load_head(POWER))} == {"ok"}
    for kind in (SPI, I2C, GPIO):
        assert f"usermod -aG {kind.group} " in (kind.remedy("/dev/x", errno.EACCES) or "")
        assert "Another program" in (kind.remedy("/dev/x", errno.EBUSY) or "")
        assert kind.remedy("/dev/x", errno.EIO) is None


def test_a_driver_whose_device_is_missing_names_the_cause() -> None:
    """Not `call the technician` alone, whichever buses this computer has."""
    for open_bus, kind in ((lambda: SpiBus("/dev/spidev9.9"), SPI), (lambda: I2cBus("/dev/i2c-99"), I2C)):
        with pytest.raises(HardwareError, match="cannot be opened") as caught:
            open_bus()
        assert kind.switch is not None
        assert kind.switch in caught.value.remedy or "This computer has" in caught.value.remedy


def test_the_gate_of_a_real_ring_is_asked_for(machine: Machine) -> None:
    (without,) = gate(machine, load_head(HEADS / "imx296.toml"))
    (loose,) = gate(machine, load_head(POWER))
    (machine.root / CONFIG).write_text("dtparam=strict_gpiod\n")
    (well,) = gate(machine, load_head(POWER))
    assert "not for eyes" in without.reading
    assert (without.state, loose.state, well.state) == ("warning", "warning", "ok")
    assert "strict_gpiod" in loose.remedy
    assert [*gate(machine, load_head(BENCH))] == []


def test_the_computer_is_named_and_another_one_is_a_warning(machine: Machine, tmp_path: Path) -> None:
    (found,) = computer(machine, None)
    assert (found.state, found.reading) == ("ok", "Raspberry Pi 5 Model B")
    (other,) = computer(Machine(SystemClock(), tmp_path / "nothing"), None)
    assert (other.state, bool(other.remedy)) == ("warning", True)


@pytest.mark.parametrize("head", sorted(HEADS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_failure_has_a_remedy(machine: Machine, head: Path) -> None:
    spec = load_head(head)
    if spec.camera.backend == "sim":
        pytest.skip("nothing of it is connected")
    report = examine(machine, spec)
    assert [finding.check for finding in report.findings if finding.state == "failed" and not finding.remedy] == []
    assert DoctorReport.model_validate_json(report.model_dump_json()) == report
    assert len(table(report).splitlines()) >= len(report.findings)


def test_the_command_prints_json_and_fails_where_something_is_missing() -> None:
    called = CliRunner().invoke(app, ["doctor", "--head", str(BENCH), "--json"])
    report = DoctorReport.model_validate_json(called.stdout)
    assert called.exit_code == (0 if report.healthy else 1)
    assert report.head == load_head(BENCH).name


def test_the_parts_are_those_of_a_head() -> None:
    called = CliRunner().invoke(app, ["doctor", "--parts"])
    assert (called.exit_code, called.stdout) == (2, "")
    assert "--head" in called.stderr


@pytest.mark.parametrize(
    ("command", "asks"), [("doctor", "Maker, "), ("check", "Technician, "), ("health", "Operator, ")]
)
def test_the_help_of_a_command_about_health_begins_with_its_reader(command: str, asks: str) -> None:
    called = CliRunner().invoke(app, [command, "--help"])
    assert called.stdout.split("[OPTIONS]")[1].strip().startswith(asks)


def test_a_bench_head_is_real_and_has_no_lamp() -> None:
    spec, clock = load_head(BENCH), SystemClock()
    assert (is_simulated(spec), kind_of(spec)) == (False, "real")
    with pytest.raises(LightFault, match="no lamp") as caught:
        NoLight().on(Illumination("green"))
    assert "diffuscope frame" in caught.value.remedy
    with pytest.raises(SpecError, match="no lamp"):
        open_head(spec, clock, MemoryLedger(clock))


def test_a_frame_of_a_simulated_head_says_so(tmp_path: Path) -> None:
    raw = tmp_path / "dark.tiff"
    called = CliRunner().invoke(app, ["frame", "--head", str(HEADS / "sim.toml"), "-o", str(raw), "--count", "2"])
    assert called.exit_code == 0, called.output
    counts, metadata = read_raw_tiff(raw.read_bytes())
    assert metadata.simulated
    assert counts.shape == (1080, 1920)
    assert abs(float(counts.mean()) - load_head(HEADS / "sim.toml").camera.black_dn) < 1  # the sensor's offset noise
