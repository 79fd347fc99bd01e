"""Tests of the calibration archive: atomic writes, and detection of any single wrong byte."""

import random
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance, sealed, unsealed
from device.errors import CalibrationDamaged, CalibrationError, CalibrationMissing, StoreError
from device.values import Calibration, Geometry, Psf, RefractionOffset, Sensor
from tests.scenes import speckle

WHEN = datetime(2026, 11, 21, 9, 30, tzinfo=UTC)
WHO = Provenance("DS-0042", WHEN, "Ana \u201cthe technician\u201d\nÅ", "0.1.0", 24.5, (("prnu", 0.004), ("hot", 3.0)))


def calibration(black_dn: float = 64.25) -> Calibration:
    shape = (24, 32)
    flat = np.random.default_rng(0).uniform(0.9, 1.1, shape).astype(np.float32)
    return Calibration(
        (Psf(speckle((17, 19)), "0 dpt"), Psf(speckle((17, 19), 3), "2 dpt", "red")),
        Sensor(black_dn, 5.7, 1.03, 4095.0),
        Geometry(5.04, 6000, 0.75),
        33.4,
        np.full(shape, 64.5, np.float32),
        flat,
        flat > 1.09,
        True,
        soft_edge_deg=(30.2, 21.8),
    )


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    kept = Archive(tmp_path / "calibrations")
    kept.add_and_activate(calibration(), WHO)
    return kept


def test_a_stored_calibration_is_loaded_unchanged(archive):
    found, expected = archive.load(), calibration()
    assert found.calibration.id == expected.id
    assert found.provenance == WHO
    assert [(psf.name, psf.colour) for psf in found.calibration.psfs] == [("0 dpt", None), ("2 dpt", "red")]
    assert found.calibration.simulated
    assert found.calibration.soft_edge_deg == (30.2, 21.8)
    assert np.array_equal(found.calibration.bad, expected.bad)
    assert not found.calibration.flat.flags.writeable


def test_a_psf_without_further_values_is_stored_without_them(tmp_path):
    plain = Calibration((Psf(speckle((9, 9))),), Sensor())
    kept = Archive(tmp_path)
    kept.add_and_activate(plain, replace(WHO, temperature_c=None, figures=()))
    found = kept.load()
    assert found.calibration.geometry is None
    assert found.calibration.field_deg is None
    assert found.calibration.flat is None
    assert found.provenance.temperature_c is None


def test_an_earlier_calibration_can_be_activated_again(archive):
    first = archive.active_id()
    second = archive.add_and_activate(calibration(65.0), WHO)
    assert archive.active_id() == second != first
    archive.activate(first)
    assert archive.load().calibration.sensor.black_dn == 64.25
    assert archive.ids() == (first, second)


def test_an_unwritable_folder_raises_store_error_and_changes_nothing(archive, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StoreError, match="cannot be written") as caught:
        Archive(tmp_path / "file").add_and_activate(calibration(), WHO)
    assert "as before" in caught.value.remedy
    with pytest.raises(StoreError):
        Archive(tmp_path / "file" / "below").add_and_activate(calibration(), WHO)


def test_an_empty_archive_raises_calibration_missing(tmp_path):
    with pytest.raises(CalibrationMissing) as caught:
        Archive(tmp_path / "nothing").load()
    assert "Calibrate" in caught.value.remedy


def test_every_wrong_byte_raises_calibration_error(archive):
    """A thousand single-byte errors, spread over all files."""
    files = [path for path in sorted(archive.root.rglob("*")) if path.is_file() and path.name != ".lock"]
    draw = random.Random(1)
    for _ in range(1000):
        path = draw.choice(files)
        whole = path.read_bytes()
        at = draw.randrange(len(whole))
        path.write_bytes(whole[:at] + bytes([whole[at] ^ draw.randrange(1, 256)]) + whole[at + 1 :])
        with pytest.raises(CalibrationError):
            archive.load()
        path.write_bytes(whole)
    assert archive.load().calibration.id == calibration().id


@pytest.mark.parametrize("name", ["manifest.toml", "psf1.npy", "flat.npy"])
def test_a_missing_or_truncated_file_raises_calibration_damaged(archive, name):
    path = archive.root / archive.active_id() / name
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CalibrationDamaged):
        archive.load()
    path.unlink()
    with pytest.raises(CalibrationError):
        archive.load()


OFFSET = RefractionOffset(0.25, -0.1, 0.05, 0.03, 0.02, 0.02)


def test_a_refraction_offset_is_stored_and_part_of_the_identity(archive):
    plain = archive.active_id()
    with_offset = replace(calibration(), refraction_offset=OFFSET)
    assert with_offset.id == archive.add_and_activate(with_offset, WHO) != plain
    assert archive.load().calibration.refraction_offset == OFFSET
    assert archive.load(plain).calibration.refraction_offset is None


@pytest.mark.parametrize("value", ["nan", "true", '"0.25"'])
def test_a_refraction_offset_that_is_no_number_is_refused(archive, value):
    files = archive.files(archive.add(replace(calibration(), refraction_offset=OFFSET), WHO))
    text = unsealed(files["manifest.toml"])
    assert text.count("m_dpt = 0.25") == 1
    files["manifest.toml"] = sealed(text.replace("m_dpt = 0.25", f"m_dpt = {value}"))
    with pytest.raises(CalibrationDamaged):
        archive.add_files(files)


@pytest.mark.parametrize(
    "edge", [(np.nan, 21.8), (30.2, np.inf), (30.2, -1.0), (0.0, 21.8), (True, 21.8), ("30.2", 21.8), (30.2,)]
)
def test_a_soft_edge_that_is_no_angle_is_refused(archive, edge):
    with pytest.raises(CalibrationDamaged) as caught:
        archive.add(replace(calibration(), soft_edge_deg=edge), WHO)
    assert "import it again" in caught.value.remedy
