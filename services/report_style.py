"""CSS of the HTML reports that commands write."""

STYLE = """
:root { color-scheme: light dark; --ground: #fbfbf9; --ink: #1d2330; --quiet: #59606d; --line: #dfe1e6;
  --card: #ffffff; --yes: #00664d; --no: #b3261e; --open: #8a5300; --accent: #0067a3; }
@media (prefers-color-scheme: dark) { :root { --ground: #12161d; --ink: #eceff4; --quiet: #a9b1bf; --line: #2c333f;
  --card: #191f28; --yes: #4fd1a5; --no: #ff8a80; --open: #ffb95c; --accent: #6cbcf5; } }
body { margin: 0; background: var(--ground); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "Noto Sans", Arial, sans-serif; }
main { max-width: 1320px; margin: 0 auto; padding: 32px 24px 80px; }
h1 { font-size: 34px; line-height: 1.15; margin: 0 0 8px; }
h2 { font-size: 23px; line-height: 1.25; margin: 0 0 8px; }
h2 span { display: inline-block; min-width: 2.2em; color: var(--accent); }
a { color: var(--accent); } p, ul, dl { max-width: 76ch; margin: 0 0 12px; }
dt { font-weight: 600; } dd { margin: 0 0 6px 16px; }
.lead { font-size: 19px; } .verdict { font-weight: 600; } .quiet, .paper, figcaption { color: var(--quiet); }
.quiet, figcaption { font-size: 14px; }
.toc { columns: 2; column-gap: 32px; padding-left: 20px; margin-bottom: 32px; }
section { border-top: 1px solid var(--line); padding: 28px 0 20px; }
table { border-collapse: collapse; margin: 12px 0 20px; font-size: 15px; }
th, td { text-align: left; padding: 5px 16px 5px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--quiet); font-weight: 500; } .n { text-align: right; font-variant-numeric: tabular-nums; }
.claims { width: 100%; table-layout: fixed; } .claims th { box-sizing: border-box; }
.claims th:first-child { width: 30%; }
.claims th:nth-child(2) { width: 8%; } .claims th:nth-child(3) { width: 17%; } .claims th:nth-child(4) { width: 10%; }
.claims th:nth-child(5) { width: 13%; } .claims small { display: block; color: var(--quiet); font-size: 13px; }
.claims td b { font-weight: 500; } b.label-put-in { color: var(--quiet); } b.label-not-reproduced { color: var(--open);
  font-weight: 600; }
.sheet td { font-variant-numeric: tabular-nums; }
tr.yes td:nth-child(4) { color: var(--yes); } tr.open td:nth-child(4), b.open { color: var(--open); font-weight: 600; }
tr.no td, b.no { color: var(--no); font-weight: 600; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(230px, 1fr)); gap: 16px; margin: 12px 0; }
.pictures figure.begins { grid-column-start: 1; }
.plots { max-width: 1000px; display: grid; gap: 16px; margin: 12px 0; } .plots figcaption { display: none; }
figure { margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 6px; overflow: hidden; }
figure img { display: block; width: 100%; } .pictures img { aspect-ratio: 1; object-fit: contain; background: #000; }
figcaption { padding: 8px 10px; line-height: 1.35; }
.note { border-left: 3px solid var(--accent); padding-left: 14px; }
@media print { @page { size: A4; margin: 14mm 12mm; }
  :root { color-scheme: light; --ground: #fff; --ink: #1d2330; --quiet: #59606d; --line: #dfe1e6; --card: #fff;
    --yes: #00664d; --no: #b3261e; --open: #8a5300; --accent: #0067a3; }
  body { font-size: 11px; } main { padding: 0 1px; max-width: none; } h1 { font-size: 22px; } .lead { font-size: 13px; }
  h2 { font-size: 16px; } h2, h2 + p, .paper { break-after: avoid; } tr, figure, .note { break-inside: avoid; }
  table { font-size: 10px; } .claims small, .quiet, figcaption { font-size: 9px; } th, td { padding-right: 10px; }
  .claims th:first-child { width: 24%; } .claims th:nth-child(2) { width: 6%; }
  .pictures { grid-template-columns: repeat(4, 1fr); gap: 8px; }
  .plots img { width: auto; max-width: 100%; max-height: 255mm; margin: 0 auto; } }
"""
