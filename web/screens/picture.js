// Making and result on one screen: the picture sharpens in place, the verdict comes while the eye is still there, and the
// big button is what the verdict advises. Three words: Good, Take again, Could not.

import { icon } from "../icons.js";
import { shotOf } from "../memory.js";
import { chips, does, slotWords, tiles } from "../parts.js";
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
    <button class="quiet finish" type="button" id="finish" @click=${act.finish}>${t("finish.now")}</button>
  `;
}

/** Tries in this slot, with the shot that is not kept yet. */
function triesOf({ visit }, shot) {
  const slot = visit?.slots[shot.slot];
  return (slot?.tries ?? 0) + (slot?.captures.includes(shot.id) ? 0 : 1);
}

const exhausted = (state, shot) =>
  shot.verdict?.code === "shot.poor" || triesOf(state, shot) > (state.protocol?.retakes ?? 2);

// ---- the card

function card(state, act, shot) {
  if (!shot.verdict && !shot.over) return makingCard(shot);
  const side = state.states.find(({ level, id }) => level === "ask" && (!id || id === shot.id));
  const [name, word, text] = verdictWords(state, shot);
  const warnings = shot.capture?.report?.warnings ?? [];
  return html`
    <div class="card" data-verdict=${shot.verdict?.word ?? "none"} data-code=${shot.verdict?.code ?? shot.failed?.code ?? ""}>
      <h2 tabindex="-1" id="result-title">${icon(name)} ${word}</h2>
      <p>${text}</p>
      ${side ? html`<p class="ask">${wordsOf(side)} ${side.buttons.map((one) => does(side, one, act))}</p>` : nothing}
      ${shot.over ? nothing : html`${bar(shot)} <p class="muted">${t("make.goon")}</p>`}
      ${timer(state, act, shot)} ${warnings.map((one) => html`<p class="warning">${icon("warn")} ${one}</p>`)}
      ${shot.capture ? details(shot.capture, state.grey) : nothing}
    </div>
  `;
}

function verdictWords(state, shot) {
  if (shot.failed) return ["warn", t("verdict.again"), wordsOf(shot.failed)];
  if (shot.verdict?.word === "good") return ["star", t("verdict.good"), t("verdict.good.what")];
  if (!shot.verdict) return ["check", t("verdict.none"), ""];
  if (exhausted(state, shot)) return ["pen", t("verdict.again"), wordsOf({ code: "shot.poor", n: triesOf(state, shot) })];
  const cause = STATES[shot.verdict.code] ? wordsOf({ code: shot.verdict.code }) : "";
  return ["pen", t("verdict.again"), cause];
}

function timer(state, act, shot) {
  if (shot.verdict?.code !== "shot.pupil" || exhausted(state, shot)) return nothing;
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
      <h2>${t(words[shot.stage.name] ?? "make.refine")}</h2>
      <p class="muted">${promise}</p>
      ${bar(shot)}
    </div>
  `;
}

const bar = ({ stage }) => html`<progress max="1" .value=${stage.fraction} aria-label=${t("make.progress")}></progress>`;

// For the technician: how the picture was made, and the files to take away.
function details({ id, report, calibration_id: calibration, links }, grey) {
  const total = Object.values(report.seconds ?? {}).reduce((sum, part) => sum + part, 0);
  const rows = [
    ["method", report.method],
    ["rounds", report.rounds],
    ["stopped", report.stopped],
    ["seconds", t("detail.seconds.value", { s: number(total, 2) })],
    ["calibration", calibration],
    ["id", id],
  ];
  return html`
    <details>
      <summary>${t("result.details")}</summary>
      ${grey ? html`<p class="muted">${t("result.grey")}</p>` : nothing}
      <dl>${rows.map(([key, value]) => html`<dt>${t(`detail.${key}`)}</dt><dd>${value}</dd>`)}</dl>
      <p class="links">
        ${["picture", "raw", "report"].map((key) => html`<a href=${links[key]} download>${t(`detail.${key}`)}</a>`)}
      </p>
    </details>
  `;
}

// ---- tools

function tools({ redfree, contrast, zoom, grey }, act) {
  const step = (less, more, label, lessName, moreName) => html`
    <div class="step" role="group" aria-label=${label}>
      <button type="button" aria-label=${lessName} @click=${less}>−</button>
      <span aria-hidden="true">${label}</span>
      <button type="button" aria-label=${moreName} @click=${more}>+</button>
    </div>
  `;
  const sign = contrast > 0 ? "+" : "−";
  const contrastWord = t("tool.contrast") + (contrast ? ` ${sign}${Math.abs(contrast)}` : "");
  const soften = () => act.contrastBy(-1);
  const harden = () => act.contrastBy(1);
  return html`
    <div class="tools" role="group" aria-label=${t("part.tools")}>
      <div class="pair">
        ${[false, true].map(
          (on) => html`<button type="button" aria-pressed=${on === redfree} @click=${() => act.setRedfree(on)}>
            ${t(on ? "tool.redfree" : grey ? "tool.plain" : "tool.colour")}
          </button>`,
        )}
      </div>
      ${step(soften, harden, contrastWord, t("tool.contrast.less"), t("tool.contrast.more"))}
      ${step(act.zoomOut, act.zoomIn, t("tool.zoom", { z: number(zoom) }), t("tool.zoom.less"), t("tool.zoom.more"))}
      <button class="reset" type="button" @click=${act.reset}>${t("tool.reset")}</button>
    </div>
  `;
}

// ---- what to do with it: the primary button moves to what the verdict advises

function actions(state, act, shot) {
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
  if (shot.verdict?.word !== "again" && !shot.failed) {
    return [button(act.again, "again", "again", "result.again"), next(state, act, true)];
  }
  if (exhausted(state, shot)) {
    return [button(act.again, "again", "again", "result.try"), button(act.ask, "could-not", "cross", "result.couldnot", true)];
  }
  const keep = shot.over && !shot.failed ? button(act.keepThis, "keep", "check", "result.keep") : next(state, act, false);
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

function reasons({ protocol, route }, act) {
  return html`
    <div class="reasons" role="group" aria-labelledby="why">
      <h2 id="why">${t("result.why")}</h2>
      ${protocol.reasons.map(
        (reason) => html`<button type="button" data-reason=${reason} @click=${() => act.couldNot(route.slot, reason)}>
          ${t(`reason.${reason}`)}
        </button>`,
      )}
      <button class="quiet" type="button" @click=${act.stopAsking}>${t("back")}</button>
    </div>
  `;
}
