"""The bundler: bundled modules behave like separate ones."""

import re
from pathlib import Path

import pytest

from services.http.bundler import bundle_module, bundle_style_sheet
from services.http.static_files import PAGES
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


def test_modules_run_once_in_dependency_order() -> None:
    whole = bundle_module("app.js", SMALL.__getitem__)["app.js"]
    assert re.findall(r"// ---- (.*)", whole) == ["deep/low.js", "side.js", "app.js"]
    assert "return { a: a, b: b, f: f, y: x };" in whole
    assert "const all = of_deep_low_js;" in whole
    assert "const { a, b: c } = of_deep_low_js;" in whole
    assert re.search(r"^(import|export) ", whole.replace("export const parts", ""), re.M) is None


def test_lazy_module_shares_objects_with_bundle() -> None:
    stand_in = bundle_module("app.js", SMALL.__getitem__)["deep/low.js"]
    assert stand_in == 'import { parts } from "../app.js";\nexport const { a, b, f, y } = parts["deep/low.js"];\n'


def test_dynamic_import_path_is_relative_to_entry() -> None:
    modules = {
        "pages/app.js": 'import { f } from "../core/a.js";\nconst later = () => import("./late.js");\n',
        "core/a.js": 'export const f = () => import("./b.js");\n',
    }
    files = bundle_module("pages/app.js", modules.__getitem__)
    assert re.findall(r"import\((.*)\);", files["pages/app.js"]) == [
        '"../core/b.js"',
        '"./late.js"',
    ]
    assert files["core/a.js"].startswith('import { parts } from "../pages/app.js";')


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"deep/low.js": 'import "../side.js";\n'}, "ring"),
        ({"side.js": "export let changing = 1;\n"}, "side.js: 'export let"),
        ({"side.js": "export default 1;\n"}, "side.js: 'export default"),
        ({"side.js": 'export * from "./deep/low.js";\n'}, "side.js: 'export [*]"),
        ({"side.js": "const here = import.meta.url;\n"}, "side.js: .*import.meta"),
        ({"side.js": "const late = (path) => import(path);\n"}, "side.js: .*import[(]path"),
    ],
)
def test_unsupported_syntax_is_refused_with_module_name(change: dict[str, str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        bundle_module("app.js", (SMALL | change).__getitem__)


@pytest.mark.parametrize(("module", "sheet"), PAGES.values())
def test_bundles_keep_every_line(module: str, sheet: str) -> None:
    def read(name: str) -> str:
        return Path(WEB / name).read_text()

    parts = bundle_module(module, read)
    whole = parts[module]
    for name in parts:
        lines = [
            line for line in read(name).splitlines() if not re.match(r"import |export |} from |//|/\*\*| \*", line)
        ]
        at = whole.index(f"// ---- {name}\n")
        for line in lines[-3:]:
            assert line.split("export{")[0] in whole[at:], f"{name}: {line}"
    style = bundle_style_sheet(sheet, read)
    named = re.findall(r'@import "(.*)";', read(sheet))
    assert len(named) == {"app.css": 4, "technician_app.css": 5, "pairing.css": 1}[Path(sheet).name]
    assert all(read(f"{Path(sheet).parent}/{file}") in style for file in named)
    assert "@import" not in style


@pytest.mark.parametrize(("module", "has_some"), [(module, module == "app.js") for module, _ in PAGES.values()])
def test_dynamic_imports_of_pages_exist(module: str, has_some: bool) -> None:
    whole = bundle_module(module, lambda name: Path(WEB / name).read_text())[module]
    paths = re.findall(r'\bimport\("([^"]+)"\)', whole)
    assert bool(paths) is has_some
    for path in paths:
        assert (WEB / module).parent.joinpath(path).is_file(), path
