"""JSON schema of `report.json`, generated from the typed report, with a description of every key.

Every `report.json` has the fields of `Report`; that of `diffuscope reconstruct --report` also has the entries of
FILES, that of a capture those of CAPTURE. `.venv/bin/python -m services.research.report_schema` writes
`services/research/site/report.schema.json` again; a test compares the file with this module, and real reports with it.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path

from pydantic import TypeAdapter

from device.values import Report
from services.records.json_values import JsonValue

FILE = Path(__file__).parent / "site" / "report.schema.json"

SECONDS: Mapping[str, str] = {
    "expose": "Lit and dark exposure; captures only.",
    "join": "Picture of each raw of a burst, their registration, and the joined frame; bursts only.",
    "colour": "Pictures in the other colours of light, their registration, and the colour picture.",
    "solve": "Preprocessing and all rounds of the solver.",
    "refract": "Estimate of the refraction, and the change of the PSF to it.",
    "cylinder": "Wait for the estimate of the cylinder: before the picture if it has no time budget, or after it.",
    "upsample": "Interpolation of the picture to the pixels of the sensor.",
}
REFRACTION: Mapping[str, str] = {
    "sphere": "Mean sphere M of the correction at the eye's pupil in dpt; negative for myopia.",
    "sd": "Standard deviation of `sphere` in dpt.",
    "j0": "Jackson cross cylinder J0 of the correction in dpt (power vector after Thibos).",
    "j0_sd": "Standard deviation of `j0` in dpt.",
    "j45": "Jackson cross cylinder J45 of the correction in dpt.",
    "j45_sd": "Standard deviation of `j45` in dpt.",
    "sphere_sc": "Sphere of the sphere-cylinder notation in dpt: M - cylinder/2.",
    "cylinder": "Minus cylinder in dpt.",
    "axis_deg": "Axis of the cylinder in TABO degrees, above 0 and up to 180, as the examiner sees the eye.",
    "field_deg": "Diameter of the lit field that was found with the refraction, in degrees.",
    "field_deg_sd": "Standard deviation of `field_deg` in degrees; 0 for a field that was held.",
    "refused": "Reason for which there is no refraction, and every number is null; null with a refraction.",
}
PSF_CYLINDER: Mapping[str, str] = {
    "j0_dpt": "Jackson cross cylinder J0 of the correction by which the PSF was warped, without the head's offset.",
    "j45_dpt": "Jackson cross cylinder J45 of the correction by which the PSF was warped, without the head's offset.",
    "gain_db": (
        "Predicted gain in dB by the cylinder over the PSF that is only scaled, for a linear solution with the fitted "
        "prior; not measured. Pictures gained about twice as much in tests. Null for a method without this prior."
    ),
}
SCATTER: Mapping[str, str] = {
    "frames": "Number of frames of the burst whose refraction was compared.",
    "sd_dpt": "Standard deviation of the mean sphere between these frames in dpt.",
    "stated_sd_dpt": (
        "Standard deviation that one frame states in dpt. If `sd_dpt` is larger, `sd` of the refraction is `sd_dpt`."
    ),
    "chi2": "Sum of the squared deviations over the stated variance; `frames` - 1 is expected at most.",
}
REGULARISATION: Mapping[str, str] = {
    "tau": "Weight of the total variation (methods variation and open).",
    "misfit": "Robust rms of the residual in units of the noise, from which tau follows (method open).",
    "prior_slope": "Exponent k of the fitted prior spectrum A f^-k of the detail.",
    "prior_log_power": "Natural logarithm of A of the fitted prior spectrum, in the units of the unnormalised DFT.",
    "flat_dn": "Level of the smooth part of the picture in DN; 0 if none is subtracted.",
    "background_dn": "Constant stray light in DN.",
    "mu": "Weight of the prior relative to |H|^2 (methods tikhonov and gradient).",
    "gcv": "Score of the generalised cross-validation that chose mu; null for a given mu.",
    "psf_error": "Assumed relative error of the PSF.",
}
QUALITY: Mapping[str, str] = {
    "saturated": "Share of the pixels at or above the white level, 0 to 1.",
    "missing": "Share of the frame that was left out (saturated, defective, not a number), 0 to 1.",
    "mean_dn": "Mean of the pixels that are not missing, above dark, in DN.",
    "through": "Share of the light that came through the eye: one minus stray light over mean. Eyes have 0.9 and more.",
    "coverage": "Share of the field that is lit, 0 to 1; null if the field is not known.",
    "cutoff_per_px": "Lowest frequency where the signal is below the noise, in cycles per sensor pixel.",
    "resolution_um": "Finest detail: half a period of `cutoff_per_px` on the retina in um; null without geometry.",
    "structure_nats": (
        "Mean gain in log-likelihood, in nats per frequency, of the spectrum |H|^2 of the PSF over a smooth spectrum. "
        "Above 0 the frame came through this PSF; near 0 nothing is known."
    ),
    "structure_sure": "`structure_nats` in units of its standard error; below -3 the frame came through another PSF.",
    "banding": "Rms of the row means of the residual as a share of the light; above 0.0013 the light flickered.",
    "psf_score": "How far the spectrum of the frame follows that of the PSF: 1 exactly, 0 for another diffuser's.",
    "psf_score_sd": "Standard deviation of `psf_score`.",
    "psf_orientation": "Evidence for the PSF as given (above 5) or rotated by 180 degrees (below -5), in sd.",
    "psf_mirrored": "Evidence for the PSF mirrored left to right (above 5) or top to bottom (below -5), in sd.",
}
OPTIONAL = (
    "frames",
    "channels",
    "psf_cylinder",
    "refraction_scatter",
)  # fields of `Report` that a capture without them does not write
FRAME: Mapping[str, JsonValue] = {
    "index": {"type": "integer", "description": "Place of the frame in the burst, from 0."},
    "used": {"type": "boolean", "description": "True if the picture has the light of this frame."},
    "shift_px": {
        "type": ["array", "null"],
        "items": {"type": "number"},
        "minItems": 2,
        "maxItems": 2,
        "description": "Rows and columns: what is at (r, c) of the reference, the first used frame of the channel, "
        "stands at (r, c) plus this in the frame, in pixels of the sensor. Null if the frame was not registered.",
    },
    "weight": {"type": "number", "description": "Share of the frame in the joined frame, 0 to 1."},
    "reason": {"type": ["string", "null"], "description": "Reason why the frame is not used; null if it is."},
}
CHANNEL: Mapping[str, JsonValue] = {
    "name": {"enum": ["red", "green", "blue", "amber"], "description": "Colour of the light."},
    "shift_px": {
        "type": ["array", "null"],
        "items": {"type": "number"},
        "minItems": 2,
        "maxItems": 2,
        "description": "Rows and columns: what is at (r, c) of the reference, green or else the first, stands at "
        "(r, c) plus this in this channel, in pixels of the raw. Null for a predicted or a missing channel.",
    },
    "predicted": {"type": "boolean", "description": "True if the channel was computed from the others, not measured."},
    "reason": {
        "type": ["string", "null"],
        "description": "Why the picture has not this colour; null for one that it has.",
    },
    "code": {
        "type": ["string", "null"],
        "description": "Name of this reason for programs: the code of an error, colour.psf (no PSF of this colour) or "
        "colour.interrupted; null for a colour that the picture has.",
    },
    "white_ratio": {
        "type": ["number", "null"],
        "description": "Light of its frame over that of a white card in the same lamp light. Null without a white "
        "reference in the calibration: the hue is then neutral, that of an average retina.",
    },
}
VERDICT: Mapping[str, str] = {
    "saturated": "Share of saturated pixels of the raw frame, 0 to 1.",
    "light_e_per_um2": "Mean light on the sensor in electrons per um^2.",
    "through": "Share of the light that came through the field.",
    "coverage": "Lit share of the field, from the raw frame, 0 to 1.",
    "off_x": "Centre of light to the right of the centre of the field, in field radii.",
    "off_y": "Centre of light below the centre of the field, in field radii.",
    "smear": "Dependence of the detail on its direction, 0 to 1: motion.",
    "wide": "Rms radius of the light on the sensor over that of an even field.",
    "residual": "As the entry `residual` of the report.",
    "lit": "As `coverage` of `quality`.",
}


def _typed(kind: str | list[JsonValue], text: str, **more: JsonValue) -> dict[str, JsonValue]:
    return {"type": kind, "description": text, **more}


def _number(text: str) -> dict[str, JsonValue]:
    return _typed("number", text)


def _figure(text: str) -> dict[str, JsonValue]:
    return _typed(["number", "null"], text)


def _text(text: str) -> dict[str, JsonValue]:
    return _typed(["string", "null"], text)


def _eye(text: str) -> dict[str, JsonValue]:
    return {"enum": ["OD", "OS", None], "description": text}


def _each(words: Mapping[str, str], entry: Callable[[str], dict[str, JsonValue]]) -> dict[str, JsonValue]:
    """Return the schemas of entries by name, of the kind `entry`, with these descriptions."""
    return {name: entry(text) for name, text in words.items()}


EYE_AT_BY: dict[str, JsonValue] = {
    "eye": _eye("Eye after the correction or confirmation: OD (right) or OS (left)."),
    "at": _text("Time, ISO 8601."),
    "by": _text("Public name of the screen; null for the instrument's own button or a script."),
}
FILES: Mapping[str, JsonValue] = {
    "solved": _typed(
        "array",
        "Rows and columns of the solved frame, in samples of bin x bin pixels.",
        items={"type": "integer"},
        minItems=2,
        maxItems=2,
    ),
    "given": _typed(
        "object",
        "Options that replaced a choice of the program, by name; those of the method are in `settings`.",
        additionalProperties={"type": ["number", "string", "object"]},
    ),
    "psf_channels": _typed("integer", "Number of PSFs for the channels of the raw; 1: one PSF for all."),
    "bayer": _text("Pattern of the colour mosaic, for example rggb; null for a raw without a mosaic."),
}
CAPTURE: Mapping[str, JsonValue] = {
    "dose_j_per_cm2": _figure("Light dose of this exposure at the retina in J/cm2."),
    "dose_24h_j_per_cm2": _typed(
        "object",
        "Light dose of each eye in the last 24 hours in J/cm2, with this exposure.",
        properties={"OD": _number("Right eye."), "OS": _number("Left eye.")},
    ),
    "dose_stop_j_per_cm2": _figure("Dose in 24 hours at which an eye gets no more light, in J/cm2."),
    "dose_high": _typed("array", "Eyes whose dose is above the warning.", items={"type": "string"}),
    "limits_unchecked": _typed(
        "array",
        "Names of the light limits that were not compared with the purchased standard.",
        items={"type": "string"},
    ),
    "visit": _text("Identifier of the visit; null for a test picture."),
    "slot": _text("Picture slot of the programme, for example R-centre; null for a test picture."),
    "test": _typed("boolean", "True for a test picture, which belongs to no visit."),
    "verdict": _typed(
        ["object", "null"],
        "Verdict for the operator.",
        properties={
            "word": _text('"good" or "again".'),
            "code": _text("Cause of the verdict, for example shot.moved; null if good."),
            "numbers": _typed(
                "object", "Known figures, to four significant digits.", properties=_each(VERDICT, _number)
            ),
        },
    ),
    "laterality": _typed(
        ["object", "null"],
        "Estimate of the eye that the picture shows.",
        properties={
            "eye": _eye("OD (right) or OS (left); null if uncertain."),
            "confidence": _number("0 to 1."),
            "disc": _typed(
                ["array", "null"],
                "Row and column of the optic disc in the picture, in pixels of the sensor.",
                items={"type": "number"},
                minItems=2,
                maxItems=2,
            ),
        },
    ),
    "budget_s": _number("Time budget of the reconstruction in s."),
    "moved": _typed(
        "array",
        "Corrections of the eye, oldest first; only if there are any.",
        items={
            "type": "object",
            "properties": {
                "from_eye": _eye("Eye before the correction."),
                "from_slot": _text("Picture slot before the correction."),
                **EYE_AT_BY,
            },
        },
    ),
    "confirmed": _typed("object", "Confirmation of the recorded eye; only if there is one.", properties=EYE_AT_BY),
    "device": _typed(
        "object",
        "Origin of the capture; null where it is unknown.",
        properties={
            "uuid": _text("UUID of the device, made with its data folder."),
            "serial": _text("Serial number of its board."),
            "software": _text("Version of the software."),
            "head": _text("Name of the head."),
            "calibration_id": _text("Identifier of the calibration."),
            "calibrated_at": _text("Date of the calibration, ISO 8601; null for a simulated one."),
            "clock": _text(
                "Source of the date: network, rtc (clock of the board), browser (of a tablet), or not_set: it may be "
                "too early."
            ),
        },
    ),
    "simulated": _typed("boolean", "True if the frame shows no real eye."),
}


def _refraction() -> dict[str, JsonValue]:
    """Return the schemas of the entries of a refraction: a text for `refused`, a number for the others; or null."""
    return {name: _text(text) if name == "refused" else _figure(text) for name, text in REFRACTION.items()}


def report_schema() -> dict[str, JsonValue]:
    """Return the JSON schema (draft 2020-12) of `report.json`; every key has a description."""
    properties = TypeAdapter(Report).json_schema(mode="serialization")["properties"]
    for one in properties.values():
        one.pop("title", None)
    nested: dict[str, dict[str, JsonValue]] = {
        "seconds": {
            "type": "object",
            "properties": _each(SECONDS, _number),
            "additionalProperties": {"type": "number"},
        },
        "psf_cylinder": {"type": ["object", "null"], "properties": _each(PSF_CYLINDER, _figure)},
        "refraction_dpt": {"type": ["object", "null"], "properties": _refraction()},
        "refraction_scatter": {"type": ["object", "null"], "properties": _each(SCATTER, _number)},
        "regularisation": {"type": "object", "properties": _each(REGULARISATION, _figure)},
        "quality": {"type": "object", "properties": _each(QUALITY, _figure)},
        "frames": {"type": "array", "items": {"type": "object", "properties": dict(FRAME)}},
        "channels": {"type": "array", "items": {"type": "object", "properties": dict(CHANNEL)}},
    }
    for name, entries in nested.items():
        properties[name] = {"description": properties[name]["description"], **entries}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "report.json of Diffuscope",
        "description": (
            "Report of a reconstruction. Of the entries that are not required, `diffuscope reconstruct` writes solved, "
            "given, psf_channels and bayer, the instrument the others; both write frames, channels and simulated. "
            "Later versions add entries; readers ignore those that they do not know."
        ),
        "type": "object",
        "properties": {**properties, **FILES, **CAPTURE},
        "required": [one.name for one in fields(Report) if one.name not in OPTIONAL],
    }


def schema_text() -> str:
    """Return the text of the schema file: indented JSON with a final line feed."""
    return json.dumps(report_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    FILE.write_text(schema_text(), encoding="utf-8")
