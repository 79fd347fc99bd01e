"""Layout and accessibility checks in the page: control size, contrast, accessible names, clipping and overlap."""

from pathlib import Path

from playwright.sync_api import Page

SIZES = {"tablet": (1280, 800), "portrait": (800, 1280), "small": (1024, 600), "phone": (360, 740)}

_MEASURE = Path(__file__).with_name("looks.js").read_text()


def look_for_faults(page: Page, *in_view: str) -> list[str]:
    """Return all violations in both themes; each selector of `in_view` must be inside the viewport and uncovered."""
    both = f"""(inView) => {{
      const measure = {_MEASURE.strip().removesuffix(";")};
      const root = document.documentElement;
      const chosen = root.dataset.theme;
      const faults = ["dim", "daylight"].flatMap((theme) => {{
        root.dataset.theme = theme;
        return measure(inView).map((fault) => `${{theme}}: ${{fault}}`);
      }});
      root.dataset.theme = chosen;
      return faults;
    }}"""
    faults: list[str] = page.evaluate(both, list(in_view))
    return faults
