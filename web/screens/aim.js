// Aim screen: slot tiles, and the shutter button, which shows why it is disabled.

import { icon } from "../components/icons.js";
import { allowsLight } from "../core/state.js";
import { question, slotLabel, tiles } from "../components/components.js";
import { visibleAlerts, timeLeft } from "../core/alerts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

/** @param {State} state */
export function aim(state, actions) {
  const { eye, part } = slotLabel(state, state.route.slot);
  if (state.asking) return html`${question(state, actions)} ${tiles(state, actions)}`;
  const answered = state.visit !== null && Object.values(state.visit.slots).every((slot) => slot.state !== "empty");
  const here = state.visit?.slots[state.route.slot ?? ""];
  return html`
    <h2 class="slot-title">${eye} · ${part}</h2>
    ${tiles(state, actions)} ${state.modules.speech?.speechButtons(state) ?? nothing}
    <div class="actions">${shutter(state, actions)}</div>
    <div class="last finish">
      ${here?.capture
        ? html`<button class="quiet" type="button" id="keep-old" @click=${actions.keepPrevious}>${icon("check")} ${t("aim.keep")}</button>`
        : nothing}
      ${here?.state === "not_possible"
        ? nothing
        : html`<button class="quiet" type="button" id="not-possible" @click=${actions.ask}>${icon("cross")} ${t("result.notpossible")}</button>`}
      <button class=${answered ? "primary" : "quiet"} type="button" id="finish" @click=${actions.finish}>
        ${t(answered ? "result.finish" : "finish.now")}
      </button>
    </div>
  `;
}

/** @param {State} state */
function shutter(state, actions) {
  const { eye, part } = slotLabel(state, state.route.slot);
  const [name, text] = shutterFace(state);
  return html`
    <button class="primary shutter" type="button" id="shutter" aria-disabled=${name !== "camera"} @click=${actions.take}>
      ${icon(name)} <span>${text}<small>${eye} · ${part}</small></span>
    </button>
  `;
}

/** @param {State} state */
function shutterFace(state) {
  const { stop } = visibleAlerts(state);
  if (stop) {
    const key = `stop.${stop.code}`;
    const left = timeLeft(stop.until);
    return [stop.code === "link.lost" ? "nolink" : "warn", t(has(key) ? key : "stop.other") + (left ? ` – ${left}` : "")];
  }
  if (state.activity === "busy") return ["wait", t("take.making")]; // two captures are in progress; the server would refuse a third
  return allowsLight(state) ? ["camera", t("take")] : ["wait", t("take.making")];
}
