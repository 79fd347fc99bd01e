"""JSON schema of `report.json`, generated from the typed report, with a description of every key.

Every `report.json` has the fields of `Report`; that of `diffuscope reconstruct --report` is a `FileReport`, that of a
capture a `CaptureReport`. The keys inside of their mappings are named here.
`.venv/bin/python -m services.research.report_schema` writes `services/research/site/report.schema.json` again; a test
compares the file with this module, and real reports with it.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from services.records.capture import CaptureReport
from services.records.json_values import JsonValue
from services.research.reconstruct_file import FileReport

FILE = Path(__file__).parent / "site" / "report.schema.json"

SECONDS: Mapping[str, str] = {
    "expose": "Lit and dark exposure; captures only.",
    "join": "Picture of each raw of a burst, their registration, and the joined frame; bursts only.",
    "colour": "Pictures in the other colours of light, their registration, and the colour picture.",
    "solve": "Preprocessing and all rounds of the solver.",
    "refract": "Estimate of the refraction, and the change of the PSF to it.",
    "cylinder": "Wait for the estimate of the cylinder: before the picture if it has no time budget, or after it.",
    "correct": "Solutions of the same frame that were tried beside the picture: with its bands, uneven light or spots.",
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
    "field_deg": "Diameter of the lit field that was found with the refraction, in degrees; of a fading light at half.",
    "field_deg_sd": "Standard deviation of `field_deg` in degrees; 0 for a field that was held.",
    "zero": (
        "Origin of the zero of `sphere`, `j0` and `j45`: `trial lens`, `point source` (its stated distance in the "
        "calibration), or `relative`: nothing fixes it, and the numbers are those relative to the PSF."
    ),
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
    "coverage": "Share of the field in the light of the lamp that is lit, 0 to 1; null if the field is not known.",
    "cutoff_per_px": "Lowest frequency where the signal is below the noise, in cycles per sensor pixel.",
    "resolution_um": "Finest detail: half a period of `cutoff_per_px` on the retina in um; null without geometry.",
    "structure_nats": (
        "Mean gain in log-likelihood, in nats per frequency, of the spectrum |H|^2 of the PSF over a smooth spectrum. "
        "Above 0 the frame came through this PSF; near 0 nothing is known."
    ),
    "structure_sure": "`structure_nats` in units of its standard error; below -3 the frame came through another PSF.",
    "flicker": "Rms of the gains of the rows, minus 1, that were taken out of the frame; absent without flicker.",
    "column_noise_dn": "Rms of the noise of the columns that was taken out of the frame, in DN; absent without it.",
    "row_noise_dn": "Rms of the noise of the rows that was taken out of the frame, in DN; absent without it.",
    "ghost": "Light of a second, displaced image over that of the first that was taken out; absent without one.",
    "gain_step": "Step of the gain between columns of the sensor that was taken out; absent without one.",
    "spots": "Share of the frame that no object explains (dust, reflexes) and that was left out; absent without any.",
    "falloff": (
        "Falloff of the light over the sensor, beside the flat frame's, that was evened out; absent without any."
    ),
    "leak": "Share of light that is no image, near a corner, that was taken out of the frame; absent without any.",
    "pupil": "Share of the PSF's light that the pupil hides, with which the picture was made; absent without any.",
    "banding": (
        "Rms of the row means of the residual as a share of the light; above 0.0013 the light flickered. Of a closed "
        "form: rms of the periodic gain of the rows, absent without flicker."
    ),
    "psf_score": "How far the spectrum of the frame follows that of the PSF: 1 exactly, 0 for another diffuser's.",
    "psf_score_sd": "Standard deviation of `psf_score`.",
    "psf_orientation": "Evidence for the PSF as given (above 5) or rotated by 180 degrees (below -5), in sd.",
    "psf_mirrored": "Evidence for the PSF mirrored left to right (above 5) or top to bottom (below -5), in sd.",
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


NAMED: Mapping[str, Mapping[str, str]] = {
    "seconds": SECONDS,
    "psf_cylinder": PSF_CYLINDER,
    "refraction_dpt": REFRACTION,
    "refraction_scatter": SCATTER,
    "regularisation": REGULARISATION,
    "quality": QUALITY,
    "dose_24h_j_per_cm2": {"OD": "Right eye.", "OS": "Left eye."},
}

LEFT_OUT = ("$ref", "title", "default", "readOnly")  # of the schema of a record


def report_schema() -> dict[str, JsonValue]:
    """Return the JSON schema (draft 2020-12) of `report.json`; every key has a description."""
    capture, command = _schema(CaptureReport), _schema(FileReport)
    entries = {**command["properties"], **capture["properties"]}
    for name, words in NAMED.items():
        _mapping(entries[name])["properties"] = {key: _named(key, text) for key, text in words.items()}
    numbers = _mapping(entries["verdict"])["properties"]["numbers"]
    numbers["properties"] = {key: {"type": "number", "description": text} for key, text in VERDICT.items()}
    simulated: dict[str, JsonValue] = {"type": "boolean", "description": "True if the frame shows no real eye."}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "report.json of Diffuscope",
        "description": (
            "Report of a reconstruction. Of the entries that are not required, `diffuscope reconstruct` writes solved, "
            "given, psf_channels and bayer, the instrument the others; both write frames, channels and simulated. "
            "Later versions add entries; readers ignore those that they do not know."
        ),
        "type": "object",
        "properties": {**entries, "simulated": simulated},
        "required": [name for name in command["required"] if name in capture["required"]],
    }


def _schema(kind: type) -> Any:
    """Return the JSON schema of a record, with the parts of it in their places and without titles."""
    schema = TypeAdapter(kind).json_schema(mode="serialization")
    parts = schema.pop("$defs")

    def placed(value: Any) -> Any:
        if isinstance(value, list):
            return [placed(item) for item in value]
        if not isinstance(value, dict):
            return value
        part = placed(parts[value["$ref"].rpartition("/")[2]]) if "$ref" in value else {}
        return part | {key: placed(item) for key, item in value.items() if key not in LEFT_OUT}

    return placed(schema)


def _mapping(entry: Any) -> Any:
    """Return the part of the schema of an entry that is an object; the other part is null."""
    return next(part for part in (entry, *entry.get("anyOf", ())) if part.get("type") == "object")


def _named(key: str, text: str) -> dict[str, JsonValue]:
    """Return the schema of a figure in an object: a number, for an origin and a refusal a text, or null."""
    return {"type": ["string" if key in ("zero", "refused") else "number", "null"], "description": text}


def schema_text() -> str:
    """Return the text of the schema file: indented JSON with a final line feed."""
    return json.dumps(report_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    FILE.write_text(schema_text(), encoding="utf-8")
