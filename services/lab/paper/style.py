"""CSS of the report, and its HTML texts on what is claimed and on its words."""

CLAIMED = """
<h2>What is claimed, and what is not</h2>
<ul>
<li>Each row has a label. <b>As written</b>: the paper's statement, under the conditions that the paper gives.
<b>Adapted</b>: the paper's statement, but an object, a condition, a setting or the reading of its words is ours (how).
<b>Put in</b>: the simulation was given that number, so the row shows only that the program keeps it.
<b class=open>Not reproduced</b>: the paper's number or word is missed, with the reason or what was tried; it does not
count as held. <b>Ours</b>: no result of the paper: it says nothing of it, or names it as an outlook, which is then
quoted.</li>
<li>The column "the paper says" has the statement that a row is about. It is empty on rows of our solvers, whose values
are no result of the paper. It does not say that the statement was tested as the paper made it: the label says that, and
rows that are adapted, put in or not reproduced have the statement as well.</li>
<li>"A over B" is a ratio; a difference is called minus, loss or rise.</li>
<li>A limit has its reason under it, or a star: it was set after the value had been seen, so that a later change of the
program is noticed. A star says nothing about the paper.</li>
<li>Not claimed: scores that the paper does not print. Its text prints one pair (SSIM 0.59 to 0.85 for the dots, S1);
so orderings are asserted, and our own values stand beside them.</li>
<li>Not claimed: anything about a real diffuser, a real eye, or a diagnosis. The surface is a Gaussian random one;
it has not been measured. Retinas are drawn from a seed.</li>
<li>The paper chose its weight mu by eye from a small range. Here an oracle takes from such a range the weight whose
picture correlates best with the truth, or, where that is a blur (S2), the one with the best detail.</li>
<li>Learned priors and automatic reading, the paper's outlook, are left out: a prior learned from retinas can draw a
lesion that no light shows, and no data at hand could prove that one does not.</li>
<li>PCC, PSNR and SSIM are taken inside the lit field, on samples of about 10 um on the sensor, after one gain and one
offset for the whole picture; SSIM with a Gaussian window of 1.5 samples. That fit alone changes PSNR by decibels.</li>
</ul>
"""

GLOSSARY = """
<h2>Words</h2>
<dl>
<dt>paper's solver</dt><dd>Tikhonov's closed form with the weight mu: periodic boundary, no field model, one PSF.</dd>
<dt>gradient, flat-sub</dt><dd>Our closed form <code>gradient</code>, called flat-sub in pictures and tables: the flat
field (the even light of the lit disc) is subtracted first, the prior is on the gradient, mu is set by generalised
cross-validation (GCV).</dd>
<dt>evidence</dt><dd>Our Wiener filter with the prior that the frame's evidence supports.</dd>
<dt>our default</dt><dd>The method <code>variation</code>: total variation with noise weights and a model of the
cropped frame, with the calibrated PSF.</dd>
<dt>default schedule</dt><dd>What the instrument runs: a quick look by <code>evidence</code>, the refraction of the eye
from the frame, then our default with the PSF stretched to that eye.</dd>
<dt>detail</dt><dd>PCC after subtraction of a blur of 2 degrees from picture and truth. Vessel contrast: how much
darker vessels are than their surroundings, as a share of these.</dd>
<dt>sample</dt><dd>10 um on the sensor, 0.13 degrees at the eye.</dd>
<dt>cap, cone, field</dt><dd>The paper's LEDs lie under a 3D-printed cap that limits the angle of their light. Cone:
that full angle, at the LED. Field: the full angle at the eye; a cone lights a field f2 / f1 = 4/3 times as wide.</dd>
<dt>head</dt><dd>Camera, optics and LED ring, described by one head file. LuMini: the LED matrix of SparkFun from which
the paper's ring is taken.</dd>
<dt>M, Rx, dpt</dt><dd>Mean sphere of the eye's wavefront, its spectacle correction (of opposite sign), dioptres.</dd>
<dt>T, S1 to S13, ...</dt><dd>The sections below; a letter in brackets refers to one.</dd>
</dl>
"""

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
