"""Modules that are handed out as one do what they do apart."""

import re
from pathlib import Path

import pytest

from services.instrument.joined import joined, joined_sheet
from services.instrument.page import PAGES
from services.resources import WEB

SMALL = {
    "app.js": """import "./side.js";
import * as all from "./deep/low.js";
import { a, b as c } from "./deep/low.js";
await all.f();
""",
    "side.js": 'import { a } from "./deep/low.js";\nconst own = a;\n',
    "deep/low.js": """export const { a, b } = { a: 1, b: 2 };
export async function f() {}
const x = 3;
export{x as y};
""",
}


def test_each_module_runs_once_after_what_it_needs() -> None:
    whole = joined("app.js", SMALL.__getitem__)["app.js"]
    assert re.findall(r"// ---- (.*)", whole) == ["deep/low.js", "side.js", "app.js"]
    assert "return { a: a, b: b, f: f, y: x };" in whole
    assert "const all = of_deep_low_js;" in whole
    assert "const { a, b: c } = of_deep_low_js;" in whole
    assert re.search(r"^(import|export) ", whole.replace("export const parts", ""), re.M) is None


def test_what_comes_on_demand_gets_the_very_same_objects() -> None:
    stand_in = joined("app.js", SMALL.__getitem__)["deep/low.js"]
    assert stand_in == 'import { parts } from "../app.js";\nexport const { a, b, f, y } = parts["deep/low.js"];\n'


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"deep/low.js": 'import "../side.js";\n'}, "ring"),
        ({"side.js": "export let changing = 1;\n"}, "side.js: 'export let"),
        ({"side.js": "export default 1;\n"}, "side.js: 'export default"),
        ({"side.js": 'export * from "./deep/low.js";\n'}, "side.js: 'export [*]"),
        ({"side.js": "const here = import.meta.url;\n"}, "side.js: .*import.meta"),
    ],
)
def test_what_cannot_be_joined_is_refused_by_name(change: dict[str, str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        joined("app.js", (SMALL | change).__getitem__)


@pytest.mark.parametrize(("module", "sheet"), PAGES.values())
def test_the_pages_lose_no_line(module: str, sheet: str) -> None:
    def read(name: str) -> str:
        return Path(WEB / name).read_text()

    parts = joined(module, read)
    whole = parts[module]
    for name in parts:
        lines = [line for line in read(name).splitlines() if not re.match(r"import |export |} from |//", line)]
        at = whole.index(f"// ---- {name}\n")
        for line in lines[-3:]:
            assert line.split("export{")[0] in whole[at:], f"{name}: {line}"
    style = joined_sheet(sheet, read)
    named = re.findall(r'@import "(.*)";', read(sheet))
    assert len(named) == 3
    assert all(read(one) in style for one in named)
    assert "@import" not in style
