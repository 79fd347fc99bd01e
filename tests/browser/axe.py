"""axe-core checks of the current page: WCAG 2.2 AA and best practice, in both themes.

The script is injected by the debugger, so the content security policy of the server stays in force.
"""

from axe_playwright_python.base import AXE_SCRIPT
from playwright.sync_api import Page

TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
ONLY = {
    "dim": {"type": "tag", "values": TAGS},
    "daylight": {"type": "rule", "values": ["color-contrast"]},  # only colours differ between the themes
}

# A render in between resets the theme; the check is then repeated.
RUN = """async ([theme, runOnly]) => {
  const root = document.documentElement;
  const chosen = root.dataset.theme;
  let found;
  do {
    root.dataset.theme = theme;
    found = await axe.run(document, { resultTypes: ["violations"], runOnly });
  } while (root.dataset.theme !== theme);
  root.dataset.theme = chosen;
  const describe = ({ id, help, nodes }) => nodes.map(({ html }) => `${theme}: ${id}: ${help}: ${html}`);
  return found.violations.flatMap(describe);
}"""


def axe_faults(page: Page) -> list[str]:
    """Return each violation in the current page as a sentence with the offending element."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(AXE_SCRIPT)
    return [fault for theme, only in ONLY.items() for fault in page.evaluate(RUN, [theme, only])]
