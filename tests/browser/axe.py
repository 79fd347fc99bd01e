"""What axe-core finds in the page that is shown now: WCAG 2.2 AA and best practice, in both themes.

It is injected by the debugger, so the page keeps the policy that the server sends: nothing is weakened for it.
"""

from axe_playwright_python.base import AXE_SCRIPT
from playwright.sync_api import Page

TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
ONLY = {
    "dim": {"type": "tag", "values": TAGS},
    "daylight": {"type": "rule", "values": ["color-contrast"]},  # the other theme has other colours, and nothing else
}

# The page draws itself anew when it hears something, in the theme that was chosen: then this look does not count.
RUN = """async ([theme, runOnly]) => {
  const root = document.documentElement;
  const chosen = root.dataset.theme;
  let found;
  do {
    root.dataset.theme = theme;
    found = await axe.run(document, { resultTypes: ["violations"], runOnly });
  } while (root.dataset.theme !== theme);
  root.dataset.theme = chosen;
  const said = ({ id, help, nodes }) => nodes.map(({ html }) => `${theme}: ${id}: ${help}: ${html}`);
  return found.violations.flatMap(said);
}"""


def axe_faults(page: Page) -> list[str]:
    """Every violation in what is shown now, as a sentence with the element that breaks the rule."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(AXE_SCRIPT)
    return [fault for theme, only in ONLY.items() for fault in page.evaluate(RUN, [theme, only])]
