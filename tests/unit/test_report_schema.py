"""The JSON schema of report.json: equal to the code, complete, and valid for reports that the program has written."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields
from pathlib import Path

import jsonschema_rs
import pytest

from device.values import ONLY_FRAME, ChannelUse, Report, SimulatedEffects
from services.records.capture import CaptureReport, CaptureVersion, EyeConfirmation, EyeCorrection, RecordOrigin
from services.research import report_schema
from services.research.reconstruct_file import FileReport
from tests.stored_captures import kept_content

GOLDEN = Path(__file__).parents[1] / "golden"
KEPT = sorted(GOLDEN.glob("kept/data/captures/*/report.json"))
NESTED = {
    "seconds": report_schema.SECONDS,
    "quality": report_schema.QUALITY,
    "regularisation": report_schema.REGULARISATION,
    "refraction_dpt": report_schema.REFRACTION,
}


def described(schema: Mapping[str, object], at: str = "") -> Iterator[str]:
    """Yield the properties without a description, at any depth."""
    parts = schema.get("properties")
    for name, part in (parts if isinstance(parts, dict) else {}).items():
        if not part.get("description"):
            yield f"{at}/{name}"
        yield from described(part, f"{at}/{name}")
        yield from described(part.get("items", {}), f"{at}/{name}")


def test_file_is_the_schema_of_the_code() -> None:
    written = report_schema.FILE.read_text(encoding="utf-8")
    assert written == report_schema.schema_text(), ".venv/bin/python -m services.research.report_schema"


def test_every_key_of_every_report_has_a_description() -> None:
    """Also those that a command adds for files, and the instrument for a capture."""
    schema = report_schema.report_schema()
    assert list(described(schema)) == []
    full = CaptureReport(
        frames=(ONLY_FRAME,),
        channels=(ChannelUse("green", (0.0, 0.0)),),
        psf_cylinder={"j0_dpt": 0.5},
        refraction_scatter={"chi2": 3.0},
        limits_unchecked=("photochemical_dose",),
        moved=(EyeCorrection("OD", "R-centre"),),
        confirmed=EyeConfirmation(),
        device=RecordOrigin(),
        versions=(CaptureVersion(1, "a"),),
        from_read_out_s=1.0,
        from_tap_s=2.0,
        effects=SimulatedEffects(("shot",), 29),
    )
    properties = schema["properties"]
    assert isinstance(properties, dict)
    files = {field.name for field in fields(FileReport)}
    assert set(properties) == files | {*full.as_json(), "simulated"}
    assert schema["required"] == [field.name for field in fields(Report) if field.name in CaptureReport().as_json()]


@pytest.mark.parametrize("file", KEPT, ids=lambda path: path.parent.name)
def test_report_of_a_kept_capture_is_valid(file: Path) -> None:
    """Every key is described."""
    report = json.loads(kept_content(file))
    jsonschema_rs.validator_for(report_schema.report_schema()).validate(report)
    for name, words in NESTED.items():
        assert set(report[name] or {}) <= set(words), name
    assert set(report["verdict"]["numbers"]) <= set(report_schema.VERDICT)


def test_reports_of_every_method_have_described_keys_only() -> None:
    """The golden records hold the report of each method and of the default schedule."""
    reports = json.loads((GOLDEN / "records" / "reconstructions.json").read_text(encoding="utf-8"))
    assert len(reports) >= 6
    for report in reports.values():
        for name in ("quality", "regularisation", "refraction_dpt"):
            assert set(report[name] or {}) <= set(NESTED[name]), name


def test_report_of_files_is_valid() -> None:
    """As `diffuscope reconstruct --report` writes it, tuples as lists."""
    made = FileReport("variation", solved=(270, 480), given={"bin": 2, "settings": {"tau": 0.1}}, bayer="rggb")
    jsonschema_rs.validator_for(report_schema.report_schema()).validate(json.loads(json.dumps(asdict(made))))


def test_wrong_type_is_found() -> None:
    """A schema that accepts everything would pass the tests above."""
    report = json.loads(kept_content(KEPT[0]))
    valid = jsonschema_rs.validator_for(report_schema.report_schema())
    assert not valid.is_valid(report | {"noise_dn": "9.6"})
    assert not valid.is_valid(report | {"quality": report["quality"] | {"structure_nats": "high"}})
    assert not valid.is_valid({name: value for name, value in report.items() if name != "method"})
