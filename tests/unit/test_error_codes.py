"""Error codes: the page and the server mean the same codes."""

import json
import re
from collections.abc import Iterator
from typing import get_args

from device.errors import DiffuscopeError
from device.recon.assessment.aiming import AimCode
from device.recon.assessment.frame_quality import Code as VerdictCode
from device.recon.colour_reconstructor import NO_PSF_CODE
from services.health.alerts import AlertCode
from services.http.problem_responses import HTTP_STATUS
from services.records.programme import Reason
from services.records.visit import GREEN_ONLY, OutcomeCode
from tests.project_files import files, text

PAGE_CODES = {
    "cal.mismatch": "one alert for several errors of the calibration (SAME in alerts.js)",
    "cal.missing": "one alert for several errors of the calibration (SAME in alerts.js)",
    "capture.elsewhere": "a stored picture belongs to another visit",
    "link.cut": "no answer came",
    "link.lost": "the event stream is silent",
    "link.slow": "the live picture is old",
    "power.lost": "interrupted captures in the status",
    "shot.crossed": "both eyes were probably exchanged",
    "shot.lost": "the answer to a press is missing",
    "shot.next": "a good picture, after which the page has gone on",
}
ALERTS = text("web/core/alerts.js")
ENGLISH = {re.sub("_(one|other)$", "", key) for key in json.loads(text("web/i18n/en.json"))}


def errors(kind: type[DiffuscopeError] = DiffuscopeError) -> Iterator[str]:
    """Yield the code of every error of device and services."""
    yield kind.code
    for child in kind.__subclasses__():
        if child.__module__.split(".")[0] in ("device", "services"):
            yield from errors(child)


def page_scripts() -> list[str]:
    return [name for name in files() if re.fullmatch(r"web/(?!vendor/|i18n/).*\.js", name)]


def table_codes() -> set[str]:
    """Return the codes of the page's table of alerts."""
    table = ALERTS[ALERTS.index("const TABLE") : ALERTS.index("export const ALERTS")]
    return set(re.findall(r'"([a-z]+\.[a-z-]+)"', table))


def page_codes() -> set[str]:
    """Return every code that the page compares, maps, shows as an alert or makes itself."""
    same = ALERTS[ALERTS.index("const SAME") : ALERTS.index("const UNKNOWN")]
    found = table_codes() | set(re.findall(r'"([a-z]+\.[a-z-]+)"', same))
    for name in page_scripts():
        found |= set(re.findall(r'\bcode(?: [!=]==|:) "([a-z]+\.[a-z-]+)"', text(name)))
        found |= set(re.findall(r'\b(?:lowerAlert|endNotice)\("([a-z]+\.[a-z-]+)"', text(name)))
    return found


def test_every_code_of_the_page_exists_on_the_server_or_is_its_own() -> None:
    server = {*errors(), *get_args(AlertCode), *get_args(VerdictCode), GREEN_ONLY, NO_PSF_CODE}
    assert page_codes() - server == set(PAGE_CODES)


def test_the_page_knows_every_alert_and_every_verdict() -> None:
    assert {*get_args(AlertCode), *get_args(VerdictCode)} <= table_codes()
    assert [code for code in table_codes() if f"state.{code}" not in ENGLISH] == []


def test_the_page_has_a_text_for_every_hint_outcome_and_reason() -> None:
    for prefix, codes in (("aim", AimCode), ("outcome", OutcomeCode), ("reason", Reason)):
        assert [code for code in get_args(codes) if f"{prefix}.{code}" not in ENGLISH] == []


def test_error_codes_are_unique_and_have_an_http_status() -> None:
    codes = list(errors())
    assert len(codes) == len(set(codes))
    assert DiffuscopeError in HTTP_STATUS
