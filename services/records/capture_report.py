"""JSON of a capture's report: one reader and one writer.

The writer returns every entry that the reader was given: entries that this release does not read, or whose type it does
not know, are in the `others` of the typed values. Missing entries have their default.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar, get_args

from device.light_safety.dose_report import DoseReport
from device.values import EYES, ChannelUse, Colour, FrameUse, Report
from services.records.capture import (
    BUDGET_S,
    NO_METHOD,
    CaptureReport,
    CaptureVersion,
    EyeConfirmation,
    EyeCorrection,
    LateralityEstimate,
    PictureVerdict,
    RecordOrigin,
)
from services.records.json_values import JsonObject, JsonValue
from services.records.row_validation import one_of, parsed_json, text

Value = TypeVar("Value")
ORIGIN = ("uuid", "serial", "software", "head", "calibration_id", "calibrated_at", "clock")


# Writer


def report_as_json(report: CaptureReport) -> dict[str, JsonValue]:
    """Return the report as a JSON object, with the keys of `report.json`.

    numpy numbers of the reconstruction stay as they are; the writers of files and rows convert them.
    """
    return _known_entries(report) | dict(report.others)


def verdict_as_json(verdict: PictureVerdict) -> dict[str, JsonValue]:
    """Return a verdict as a JSON object."""
    known: dict[str, JsonValue] = {"word": verdict.word, "code": verdict.code, "numbers": dict(verdict.numbers)}
    return known | dict(verdict.others)


def _known_entries(report: CaptureReport) -> dict[str, JsonValue]:
    made = report.reconstruction
    light = report.light
    entries: dict[str, JsonValue] = {
        **vars(made),
        "warnings": list(made.warnings),
        "frames": [_frame_as_json(one) for one in made.frames],
        "channels": [_channel_as_json(one) for one in made.channels],
        **vars(light),
        "dose_high": list(light.dose_high),
        "limits_unchecked": list(light.limits_unchecked),
        "visit": report.visit,
        "slot": report.slot,
        "test": report.is_test,
        "verdict": None if report.verdict is None else verdict_as_json(report.verdict),
        "laterality": None if report.laterality is None else _laterality_as_json(report.laterality),
        "budget_s": report.budget_s,
    }
    if not made.frames:
        del entries["frames"]
    if not made.channels:
        del entries["channels"]
    for name in ("psf_cylinder", "refraction_scatter"):
        if entries[name] is None:
            del entries[name]
    if not light.limits_unchecked:
        del entries["limits_unchecked"]
    if report.moved:
        entries["moved"] = [_correction_as_json(one) for one in report.moved]
    if report.confirmed is not None:
        entries["confirmed"] = _confirmation_as_json(report.confirmed)
    if report.device is not None:
        entries["device"] = origin_as_json(report.device)
    if report.versions:
        entries["versions"] = [_version_as_json(one) for one in report.versions]
    return entries


def origin_as_json(origin: RecordOrigin) -> dict[str, JsonValue]:
    """Return the origin of a record as a JSON object: the block `device` of reports, exports and uploads."""
    known: dict[str, JsonValue] = {name: getattr(origin, name) for name in ORIGIN}
    return known | dict(origin.others)


def _version_as_json(one: CaptureVersion) -> dict[str, JsonValue]:
    known: dict[str, JsonValue] = {
        "number": one.number,
        "result": one.result,
        "at": one.at,
        "method": one.method,
        "software": one.software,
    }
    return known | dict(one.others)


def _frame_as_json(one: FrameUse) -> JsonValue:
    shift: JsonValue = None if one.shift_px is None else list(one.shift_px)
    return {"index": one.index, "used": one.used, "shift_px": shift, "weight": one.weight, "reason": one.reason}


def _channel_as_json(one: ChannelUse) -> JsonValue:
    shift: JsonValue = None if one.shift_px is None else list(one.shift_px)
    entries = {"name": one.name, "shift_px": shift, "predicted": one.predicted, "reason": one.reason}
    known = {"white_ratio": one.white_ratio, "code": one.code}
    return entries | {name: value for name, value in known.items() if value is not None}


def _laterality_as_json(seen: LateralityEstimate) -> dict[str, JsonValue]:
    disc: JsonValue = None if seen.disc is None else list(seen.disc)
    return {"eye": seen.eye, "confidence": seen.confidence, "disc": disc} | dict(seen.others)


def _correction_as_json(one: EyeCorrection) -> dict[str, JsonValue]:
    known: dict[str, JsonValue] = {
        "from_eye": one.from_eye,
        "from_slot": one.from_slot,
        "eye": one.eye,
        "at": one.at,
        "by": one.by,
    }
    return known | dict(one.others)


def _confirmation_as_json(one: EyeConfirmation) -> dict[str, JsonValue]:
    known: dict[str, JsonValue] = {"eye": one.eye, "at": one.at, "by": one.by}
    return known | dict(one.others)


# Reader


def parse_report(stored: object) -> CaptureReport:
    """Return the report of a database row; `stored` is its JSON text. Errors as in `read_report`."""
    return read_report(parsed_json(stored))


def read_report(content: object) -> CaptureReport:
    """Return the report with this JSON content.

    ValueError or KeyError if the content is no JSON object, or if an entry on which the program acts has a wrong type:
    durations, budget, refraction, verdict, corrections, `dose_j_per_cm2`, visit and slot. A wrong type of another entry
    gives the default, and the stored entry stays in `others`.
    """
    entries = _object(content)
    verdict = entries.get("verdict")
    moved = entries.get("moved")
    confirmed = entries.get("confirmed")
    device = entries.get("device")
    report = CaptureReport(
        reconstruction=_reconstruction(entries),
        light=_dose_report(entries),
        visit=_checked(entries, "visit", text, None),
        slot=_checked(entries, "slot", text, None),
        verdict=None if verdict is None else read_verdict(verdict),
        laterality=_lenient(entries, "laterality", _laterality, None),
        budget_s=_checked(entries, "budget_s", _number, BUDGET_S),
        moved=() if moved is None else _moves(moved),
        confirmed=_confirmation(confirmed) if isinstance(confirmed, Mapping) else None,
        device=_origin(device) if isinstance(device, Mapping) else None,
        versions=_lenient(entries, "versions", _versions, ()),
    )
    return replace(report, others=_unwritten(entries, _known_entries(report)))


def read_verdict(content: object) -> PictureVerdict:
    """Return the verdict with this JSON content; ValueError if it is no object, or if its `word` is no text."""
    entries = _object(content)
    verdict = PictureVerdict(
        _checked(entries, "word", text, None),
        _lenient(entries, "code", text, None),
        _lenient(entries, "numbers", _object, {}),
    )
    return replace(verdict, others=_unwritten(entries, verdict_as_json(verdict)))


def _reconstruction(entries: JsonObject) -> Report:
    return Report(
        method=_lenient(entries, "method", text, NO_METHOD),
        bin=_lenient(entries, "bin", _whole, 1),
        rounds=_lenient(entries, "rounds", _whole, 1),
        stopped=_lenient(entries, "stopped", text, "done"),
        seconds=_checked(entries, "seconds", _numbers, {}),
        psf_index=_lenient(entries, "psf_index", _whole, 0),
        psf_scale=_lenient(entries, "psf_scale", _number, 1.0),
        psf_cylinder=_lenient(entries, "psf_cylinder", _figures, None),
        refraction_dpt=_checked(entries, "refraction_dpt", _refraction, None),
        refraction_scatter=_lenient(entries, "refraction_scatter", _numbers, None),
        regularisation=_lenient(entries, "regularisation", _copied, {}),
        noise_dn=_lenient(entries, "noise_dn", _number, None),
        residual=_lenient(entries, "residual", _number, None),
        quality=_lenient(entries, "quality", _copied, {}),
        warnings=_lenient(entries, "warnings", _texts, ()),
        frames=_lenient(entries, "frames", _frames, ()),
        channels=_lenient(entries, "channels", read_channels, ()),
    )


def _frames(value: object) -> tuple[FrameUse, ...]:
    if not isinstance(value, list):
        raise ValueError("frames that are no list")
    return tuple(_frame(_object(one)) for one in value)


def _frame(entries: JsonObject) -> FrameUse:
    index = _checked(entries, "index", _whole, 0)
    used = entries.get("used") is True
    shift_px = _checked(entries, "shift_px", _position, None)
    weight = _checked(entries, "weight", _number, 0.0)
    return FrameUse(index, used, shift_px, weight, _checked(entries, "reason", text, None))


def read_channels(value: object) -> tuple[ChannelUse, ...]:
    """Return the channels of a report with this JSON content; ValueError for a wrong type."""
    if not isinstance(value, list):
        raise ValueError("channels that are no list")
    return tuple(_channel(_object(one)) for one in value)


def _channel(entries: JsonObject) -> ChannelUse:
    name = one_of(entries.get("name"), *get_args(Colour))
    shift_px = _checked(entries, "shift_px", _position, None)
    predicted = entries.get("predicted") is True
    reason = _checked(entries, "reason", text, None)
    white_ratio = _checked(entries, "white_ratio", _number, None)
    return ChannelUse(name, shift_px, predicted, reason, white_ratio, _checked(entries, "code", text, None))


def _dose_report(entries: JsonObject) -> DoseReport:
    return DoseReport(
        _checked(entries, "dose_j_per_cm2", _number, None),
        _lenient(entries, "dose_24h_j_per_cm2", _numbers, {}),
        _lenient(entries, "dose_stop_j_per_cm2", _number, None),
        _lenient(entries, "dose_high", _texts, ()),
        _lenient(entries, "limits_unchecked", _texts, ()),
    )


def _laterality(content: object) -> LateralityEstimate:
    entries = _object(content)
    seen = LateralityEstimate(
        _lenient(entries, "eye", lambda eye: one_of(eye, *EYES), None),
        _lenient(entries, "confidence", _number, 0.0),
        _lenient(entries, "disc", _position, None),
    )
    return replace(seen, others=_unwritten(entries, _laterality_as_json(seen)))


def _moves(content: object) -> tuple[EyeCorrection, ...]:
    if not isinstance(content, list):
        raise ValueError("moves that are no list")
    return tuple(_correction(_object(one)) for one in content)


def _correction(entries: JsonObject) -> EyeCorrection:
    from_eye = one_of(entries["from_eye"], *EYES)
    from_slot = text(entries["from_slot"])
    eye, at, by = (_lenient(entries, name, text, None) for name in ("eye", "at", "by"))
    move = EyeCorrection(from_eye, from_slot, eye, at, by)
    return replace(move, others=_unwritten(entries, _correction_as_json(move)))


def _confirmation(entries: JsonObject) -> EyeConfirmation:
    eye, at, by = (_lenient(entries, name, text, None) for name in ("eye", "at", "by"))
    confirmed = EyeConfirmation(eye, at, by)
    return replace(confirmed, others=_unwritten(entries, _confirmation_as_json(confirmed)))


def _origin(entries: JsonObject) -> RecordOrigin:
    uuid, serial, software, head, id, calibrated_at, clock = (_lenient(entries, name, text, None) for name in ORIGIN)
    origin = RecordOrigin(uuid, serial, software, head, id, calibrated_at, clock)
    return replace(origin, others=_unwritten(entries, origin_as_json(origin)))


def _versions(content: object) -> tuple[CaptureVersion, ...]:
    if not isinstance(content, list):
        raise ValueError("versions that are no list")
    return tuple(_version(_object(one)) for one in content)


def _version(entries: JsonObject) -> CaptureVersion:
    number = _whole(entries.get("number"))
    result = text(entries.get("result"))
    at, method, software = (_lenient(entries, name, text, None) for name in ("at", "method", "software"))
    version = CaptureVersion(number, result, at, method, software)
    return replace(version, others=_unwritten(entries, _version_as_json(version)))


def _unwritten(entries: JsonObject, written: JsonObject) -> JsonObject:
    """Return the stored entries that the writer would lose or change."""
    return {
        name: value
        for name, value in entries.items()
        if name not in written or type(written[name]) is not type(value) or written[name] != value
    }


def _checked(entries: Mapping[str, object], name: str, read: Callable[[object], Value], default: Value) -> Value:
    """Return an entry as `read` returns it; the default if it is missing or null; ValueError for a wrong type."""
    value = entries.get(name)
    return default if value is None else read(value)


def _lenient(entries: Mapping[str, object], name: str, read: Callable[[object], Value], default: Value) -> Value:
    """Return an entry as `read` returns it; the default if it is missing, null or of a wrong type."""
    try:
        return _checked(entries, name, read, default)
    except ValueError:
        return default


def _object(value: object) -> JsonObject:
    if not isinstance(value, Mapping):
        raise ValueError(f"{type(value).__name__} where names and values were kept")
    return value


def _copied(value: object) -> dict[str, JsonValue]:
    return dict(_object(value))


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{type(value).__name__} where a number was kept")
    return value


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{type(value).__name__} where a whole number was kept")
    return value


def _numbers(value: object) -> dict[str, float]:
    """Return the numbers of an object by name; null is no number and omitted, ValueError for another type."""
    return {name: _number(one) for name, one in _object(value).items() if one is not None}


def _figures(value: object) -> dict[str, float | None]:
    """Return the numbers and nulls of an object by name; ValueError for another type."""
    return {name: None if one is None else _number(one) for name, one in _object(value).items()}


def _refraction(value: object) -> dict[str, float | str | None]:
    """Return the numbers and nulls of a refraction by name, and the text of `refused`; entries of other types are
    omitted. ValueError if its `sphere` is neither a number nor null.
    """
    entries = _object(value)
    _checked(entries, "sphere", _number, None)
    kept: dict[str, float | str | None] = {}
    for name, one in entries.items():
        is_number = isinstance(one, int | float) and not isinstance(one, bool)
        if one is None or is_number or (name == "refused" and isinstance(one, str)):
            kept[name] = one  # type: ignore[assignment]  # narrowed by the conditions
    return kept


def _texts(value: object) -> tuple[str, ...]:
    if not isinstance(value, list | tuple):
        raise ValueError(f"{type(value).__name__} where a list was kept")
    return tuple(text(one) for one in value)


def _position(value: object) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("a position has a row and a column")
    return _number(value[0]), _number(value[1])
