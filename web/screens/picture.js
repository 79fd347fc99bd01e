// Making and result on one screen: the picture sharpens in place, the verdict comes while the eye is still there, and the
// big button is what the verdict advises. Three words: Good, Take again, Could not.

import { icon } from "../icons.js";
import { shotOf } from "../memory.js";
import { chips, does, reasons, slotWords, tiles } from "../parts.js";
import { STATES, timeLeft, wordsOf } from "../states.js";
import { html, nothing } from "../vendor/lit-html.js";
import { nextSlot } from "../visit.js";
import { number, t } from "../words.js";

export function picture(state, act) {
  const shot = shotOf(state);
  if (!shot) return html`<div class="card making"><p>${t("mark.opening")}</p></div>`;
  if (state.asking) return html`${reasons(state, act)} ${tiles(state, act)}`;
  return html`
    ${card(state, act, shot)} ${state.picture === "none" ? nothing : tools(state, act)} ${tiles(state, act)}
    ${chips(state, act)}
    <div class="actions">${actions(state, act, shot)}</div>
    ${shot.capture ? (state.later.details?.sheet(state, act, shot) ?? nothing) : nothing}
    ${state.visit?.finished_at || complete(state, shot)
      ? nothing
      : html`<button class="quiet finish" type="button" id="finish" @click=${act.finish}>${t("finish.now")}</button>`}
  `;
}

// Then the button for what comes next says Finish already.
const complete = ({ route }, { verdict }) => verdict?.word === "good" && !route.capture && !nextSlot(route.slot);

/** Tries in this slot, with the shot that is not kept yet. */
function triesOf({ visit }, shot) {
  const slot = visit?.slots[shot.slot];
  return (slot?.tries ?? 0) + (slot?.captures.includes(shot.id) ? 0 : 1);
}

const exhausted = (state, shot) =>
  shot.verdict?.code === "shot.poor" || triesOf(state, shot) > (state.protocol?.retakes ?? 2);

// ---- the card: as tall with a verdict as without, so that what stands under it stays where it is

function card(state, act, shot) {
  if (!shot.verdict && !shot.over) return makingCard(shot);
  const side = state.states.find(({ level, id }) => level === "ask" && (!id || id === shot.id));
  const [name, word, text] = verdictWords(state, shot);
  return html`
    <div class="card" data-verdict=${shot.verdict?.word ?? "none"} data-code=${shot.verdict?.code ?? shot.failed?.code ?? ""}>
      <div class="heading">
        <h2 tabindex="-1" id="result-title">${icon(name)} ${word}</h2>
        ${timer(state, act, shot) ?? (shot.capture ? detailsButton(act, shot.capture) : nothing)}
      </div>
      <p>${text}</p>
      ${side ? html`<p class="ask">${wordsOf(side)} ${side.buttons.map((one) => does(side, one, act))}</p>` : nothing}
      ${shot.over ? nothing : bar(shot)}
    </div>
  `;
}

function detailsButton(act, { report }) {
  const warned = report?.warnings?.length;
  return html`<button class="quiet" type="button" id="open-details" aria-haspopup="dialog" @click=${act.openDetails}>
    ${warned ? icon("warn") : nothing} ${t(warned ? "result.details.warn" : "result.details")}
  </button>`;
}

function verdictWords(state, shot) {
  if (shot.failed) return ["warn", t("verdict.again"), wordsOf(shot.failed)];
  if (shot.verdict?.word === "good") {
    return ["star", t("verdict.good"), [t("verdict.good.what"), shot.over ? "" : t("make.goon")].join(" ")];
  }
  if (!shot.verdict) return ["check", t("verdict.none"), ""];
  if (exhausted(state, shot)) return ["pen", t("verdict.again"), wordsOf({ code: "shot.poor", n: triesOf(state, shot) })];
  const cause = STATES[shot.verdict.code] ? wordsOf({ code: shot.verdict.code }) : "";
  return ["pen", t("verdict.again"), cause];
}

function timer(state, act, shot) {
  if (shot.verdict?.code !== "shot.pupil" || exhausted(state, shot)) return null;
  const left = timeLeft(state.timer);
  return left
    ? html`<p class="clock">${left}</p>`
    : html`<button type="button" data-do="timer" @click=${() => act.stateDo("timer")}>${icon("wait")} ${t("do.timer")}</button>`;
}

function makingCard(shot) {
  const left = Math.round(shot.stage.left); // 0: not known, and then nothing is promised
  const words = { expose: "make.expose", keep: "make.keep" };
  const promise = left >= 1 ? t("make.left", { n: left }) : shot.stage.fraction >= 0.9 ? t("make.soon") : "\u00a0";
  return html`
    <div class="card making">
      <div class="heading"><h2>${t(words[shot.stage.name] ?? "make.refine")}</h2></div>
      <p class="muted">${promise}</p>
      ${bar(shot)}
    </div>
  `;
}

const bar = ({ stage }) => html`<progress max="1" .value=${stage.fraction} aria-label=${t("make.progress")}></progress>`;

// ---- tools

function tools({ redfree, brightness, contrast, loupe, zoom }, act) {
  const step = (tool, label, by) => html`
    <div class="step" role="group" aria-label=${label}>
      <button type="button" aria-label=${t(`${tool}.less`)} @click=${() => by(-1)}>−</button>
      <span aria-hidden="true">${label}</span>
      <button type="button" aria-label=${t(`${tool}.more`)} @click=${() => by(1)}>+</button>
    </div>
  `;
  const signed = (tool, steps) => t(tool) + (steps ? ` ${steps > 0 ? "+" : "−"}${Math.abs(steps)}` : "");
  const zoomBy = (way) => (way > 0 ? act.zoomIn() : act.zoomOut());
  return html`
    <div class="tools" role="group" aria-label=${t("part.tools")}>
      <div class="pair">
        ${[false, true].map(
          (on) => html`<button type="button" aria-pressed=${on === redfree} @click=${() => act.setRedfree(on)}>
            ${t(on ? "tool.redfree" : "tool.plain")}
          </button>`,
        )}
      </div>
      ${step("tool.brightness", signed("tool.brightness", brightness), act.brightnessBy)}
      <button type="button" id="loupe" aria-pressed=${loupe} @click=${() => act.setLoupe(!loupe)}>${t("tool.loupe")}</button>
      ${step("tool.contrast", signed("tool.contrast", contrast), act.contrastBy)}
      ${step("tool.zoom", t("tool.zoom", { z: number(zoom) }), zoomBy)}
      <button class="reset" type="button" @click=${act.reset}>${t("tool.reset")}</button>
    </div>
  `;
}

// ---- what to do with it: the primary button moves to what the verdict advises

function actions(state, act, shot) {
  if (state.visit?.finished_at) return button(act.backToOutcome, "result", "left", "result.seen");
  if (!shot.verdict && !shot.over) {
    const held = shot.stage.name === "expose" && state.picture === "none";
    return html`<button class="primary shutter" type="button" id="shutter" aria-disabled="true" @click=${act.take}>
      ${icon(held ? "hand" : "wait")} <span>${t(held ? "take.hold" : "take.making")}</span>
    </button>`;
  }
  const current = state.visit?.slots[shot.slot]?.capture;
  if (state.route.capture && current !== shot.id) {
    return [button(act.again, "again", "again", "result.again"), button(act.useThis, "use", "check", "result.use", true)];
  }
  if (shot.failed) return button(act.again, "again", "again", "result.again", true);
  if (shot.verdict?.word !== "again") {
    return [button(act.again, "again", "again", "result.again"), next(state, act, true)];
  }
  if (exhausted(state, shot)) {
    return [button(act.again, "again", "again", "result.try"), button(act.ask, "could-not", "cross", "result.couldnot", true)];
  }
  const keep = shot.over ? button(act.keepThis, "keep", "check", "result.keep") : next(state, act, false);
  return [keep, button(act.again, "again", "again", "result.again", true)];
}

const button = (click, id, name, word, primary = false) => html`
  <button class=${primary ? "primary" : ""} type="button" id=${id} @click=${click}>${icon(name)} <span>${t(word)}</span></button>
`;

function next(state, act, primary) {
  const slot = nextSlot(state.route.slot);
  const waits = !slot && state.shots.some((shot) => shot.visit === state.route.visit && !shot.over);
  const { eye, part } = slotWords(state, slot);
  return html`
    <button class=${primary ? "primary" : ""} type="button" id="next" aria-disabled=${waits} @click=${() => waits || act.next()}>
      ${icon("next")}
      <span>
        ${t(waits ? "take.making" : slot ? "result.next" : "result.finish")}
        ${slot ? html`<small>${eye} · ${part}</small>` : nothing}
      </span>
    </button>
  `;
}
