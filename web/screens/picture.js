// Picture screen: progress and result in place; the verdict comes before the final picture and selects the primary
// button. Three verdict texts: Good, Take again, Not possible.

import { icon } from "../components/icons.js";
import { colourLink } from "../core/api.js";
import { followingSlot } from "../core/going_on.js";
import { currentCapture } from "../core/state.js";
import { choice, question, slotLabel, tiles, versionName } from "../components/components.js";
import { ALERTS, timeLeft, alertText } from "../core/alerts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { nextSlot } from "../core/visit.js";
import { number, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

/** @param {State} state */
export function picture(state, actions) {
  const capture = currentCapture(state);
  if (!capture) return html`<div class="card making"><p>${t("mark.opening")}</p></div>`;
  if (state.asking) return html`${question(state, actions)} ${tiles(state, actions)}`;
  return html`
    ${card(state, actions, capture)} ${state.picture === "none" ? nothing : tools(state, actions, capture.record)} ${tiles(state, actions)}
    <div class="actions">${actionButtons(state, actions, capture)}</div>
    ${capture.record ? (state.modules.details?.detailsDialog(state, actions, capture) ?? nothing) : nothing}
    ${state.visit?.finished_at || complete(state, capture)
      ? html`<div class="finish" aria-hidden="true"></div>`
      : html`<button class="quiet finish" type="button" id="finish" @click=${actions.finish}>${t("finish.now")}</button>`}
  `;
}

// Whether the primary button is already "Finish".
const complete = ({ route }, { verdict }) => verdict?.word === "good" && !route.capture && !nextSlot(route.slot);

/** Return the number of tries in this slot, including the current capture. */
function triesOf({ visit }, capture) {
  const slot = visit?.slots[capture.slot];
  return (slot?.tries ?? 0) + (slot?.captures.includes(capture.id) ? 0 : 1);
}

/** @param {State} state */
const exhausted = (state, capture) =>
  capture.verdict?.code === "shot.poor" || triesOf(state, capture) > (state.programme?.retakes ?? 2);

// ---- card: same height with and without a verdict, so that the layout does not shift

/** @param {State} state */
function card(state, actions, capture) {
  if (!capture.verdict && !capture.over) return makingCard(capture);
  const [name, word, text] = verdictText(state, capture);
  return html`
    <div class="card" data-verdict=${capture.verdict?.word ?? "none"} data-code=${capture.verdict?.code ?? capture.failed?.code ?? ""}>
      <div class="heading">
        <h2 tabindex="-1" id="result-title">${icon(name)} ${word}</h2>
        ${timer(state, actions, capture) ?? (capture.record ? detailsButton(actions, capture.record) : nothing)}
      </div>
      <p>${text}</p>
      ${capture.over ? nothing : progressBar(capture)}
    </div>
  `;
}

function detailsButton(actions, { report }) {
  const warned = report?.warnings?.length;
  const name = warned ? t("result.details.warn") : nothing; // the sign says it in half the width, beside the verdict
  return html`<button
    class="quiet"
    type="button"
    id="open-details"
    aria-haspopup="dialog"
    aria-label=${name}
    @click=${actions.openDetails}
  >
    ${warned ? icon("warn") : nothing} ${t("result.details")}
  </button>`;
}

/** @param {State} state */
function verdictText(state, capture) {
  if (capture.failed) return ["warn", t("verdict.again"), alertText(capture.failed)];
  if (capture.verdict?.word === "good") {
    const what = t(followingSlot(state) ? "verdict.good.next" : "verdict.good.what");
    return ["check", t("verdict.good"), [what, capture.over ? "" : t("make.goon")].join(" ")];
  }
  if (!capture.verdict) return ["check", t("verdict.none"), ""];
  if (exhausted(state, capture)) return ["pen", t("verdict.again"), alertText({ code: "shot.poor", n: triesOf(state, capture) })];
  const cause = ALERTS[capture.verdict.code] ? alertText({ code: capture.verdict.code }) : "";
  return ["pen", t("verdict.again"), cause];
}

/** @param {State} state */
function timer(state, actions, capture) {
  if (capture.verdict?.code !== "shot.pupil" || exhausted(state, capture)) return null;
  const left = timeLeft(state.timer);
  return left
    ? html`<p class="clock">${left}</p>`
    : html`<button type="button" data-do="timer" @click=${() => actions.runAlertButton("timer")}>${icon("wait")} ${t("do.timer")}</button>`;
}

function makingCard(capture) {
  const left = Math.round(capture.stage.left); // 0: unknown; then no estimate is shown
  const titles = { expose: "make.expose", keep: "make.keep" };
  const estimate = left >= 1 ? t("make.left", { count: left }) : capture.stage.fraction >= 0.9 ? t("make.soon") : "\u00a0";
  return html`
    <div class="card making">
      <div class="heading"><h2>${t(titles[capture.stage.name] ?? "make.refine")}</h2></div>
      <p class="muted">${estimate}</p>
      ${progressBar(capture)}
    </div>
  `;
}

const progressBar = ({ stage }) => html`<progress max="1" .value=${stage.fraction} aria-label=${t("make.progress")}></progress>`;

// ---- tools

/** @param {State} state */
function tools({ redfree, version, visit, brightness, contrast, loupe, zoom, grey }, actions, capture) {
  const coloured = Boolean(capture && colourLink(capture, version, visit));
  const step = (tool, label, by) => html`
    <div class="step" data-repeat role="group" aria-label=${label}>
      <button type="button" aria-label=${t(`${tool}.less`)} @click=${() => by(-1)}>−</button>
      <span aria-hidden="true">${label}</span>
      <button type="button" aria-label=${t(`${tool}.more`)} @click=${() => by(1)}>+</button>
    </div>
  `;
  const signed = (tool, steps) => t(tool) + (steps ? ` ${steps > 0 ? "+" : "−"}${Math.abs(steps)}` : "");
  const zoomBy = (way) => (way > 0 ? actions.zoomIn() : actions.zoomOut());
  return html`
    <div class="tools" role="group" aria-label=${t("part.tools")}>
      ${grey && !coloured
        ? html`<p class="pair muted" id="grey">${t("tool.grey")}</p>`
        : html`<div class="pair">
            ${[false, true].map(
              (on) => html`<button type="button" aria-pressed=${on === redfree} @click=${() => actions.setRedfree(on)}>
                ${t(on ? "tool.redfree" : coloured ? "tool.colour" : "tool.plain")}
              </button>`,
            )}
          </div>`}
      ${versions(version, actions, capture)} ${step("tool.brightness", signed("tool.brightness", brightness), actions.brightnessBy)}
      <button type="button" id="loupe" aria-pressed=${loupe} @click=${() => actions.setLoupe(!loupe)}>${t("tool.loupe")}</button>
      ${step("tool.contrast", signed("tool.contrast", contrast), actions.contrastBy)}
      ${step("tool.zoom", t("tool.zoom", { z: number(zoom) }), zoomBy)}
      <button class="reset" type="button" @click=${actions.reset}>${t("tool.reset")}</button>
    </div>
  `;
}

// The picture as taken and its later versions; nothing for a capture without versions.
function versions(value, actions, capture) {
  if (!capture?.versions) return nothing;
  const options = [[0, t("version.taken")], ...capture.versions.map((version) => [version.number, versionName(version)])];
  return choice({ label: t("version.label"), field: "version", value, options, choose: actions.setVersion });
}

// ---- buttons: the verdict selects the primary one

/** @param {State} state */
function actionButtons(state, actions, capture) {
  if (state.visit?.finished_at) return button(actions.backToOutcome, "result", "left", "result.seen");
  if (!capture.verdict && !capture.over) {
    const held = capture.stage.name === "expose"; // the next frames may be exposed after the quick look
    return html`<button class="primary shutter" type="button" id="shutter" aria-disabled="true" @click=${actions.take}>
      ${icon(held ? "hand" : "wait")} <span>${t(held ? "take.hold" : "take.making")}</span>
    </button>`;
  }
  const current = state.visit?.slots[capture.slot]?.capture;
  if (state.route.capture && current !== capture.id) {
    return [button(actions.again, "again", "again", "result.again"), button(actions.useThis, "use", "check", "result.use", true)];
  }
  if (capture.failed) return button(actions.again, "again", "again", "result.again", true);
  if (capture.verdict?.word !== "again") {
    return [button(actions.again, "again", "again", "result.again"), next(state, actions, true)];
  }
  if (exhausted(state, capture)) {
    return [button(actions.again, "again", "again", "result.try"), button(actions.ask, "not-possible", "cross", "result.notpossible", true)];
  }
  const keep = capture.over ? button(actions.keepThis, "keep", "check", "result.keep") : next(state, actions, false);
  return [keep, button(actions.again, "again", "again", "result.again", true)];
}

const button = (click, id, name, word, primary = false) => html`
  <button class=${primary ? "primary" : ""} type="button" id=${id} @click=${click}>${icon(name)} <span>${t(word)}</span></button>
`;

/** @param {State} state */
function next(state, actions, primary) {
  const slot = nextSlot(state.route.slot);
  const waits = !slot && state.captures.some((capture) => capture.visit === state.route.visit && !capture.over);
  const { eye, part } = slotLabel(state, slot);
  return html`
    <button class=${primary ? "primary" : ""} type="button" id="next" aria-disabled=${waits} @click=${() => waits || actions.next()}>
      ${icon("next")}
      <span>
        ${t(waits ? "take.making" : slot ? "result.next" : "result.finish")}
        ${slot ? html`<small>${eye} · ${part}</small>` : nothing}
      </span>
    </button>
  `;
}
