"""HTML texts of the report on what is claimed and on its words."""

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
