// Aim: four tiles that drive the exam, and one big button that says in itself why it cannot be pressed.

import { icon } from "../icons.js";
import { chips, slotWords, tiles } from "../parts.js";
import { shownStates, timeLeft } from "../states.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, t } from "../words.js";

export function aim(state, act) {
  const { eye, part } = slotWords(state, state.route.slot);
  return html`
    <h2 class="slot-title">${eye} · ${part}</h2>
    ${tiles(state, act)} ${state.later.aloud?.toSay(state) ?? nothing} ${chips(state, act)}
    <div class="actions">${shutter(state, act)}</div>
    <button class="quiet finish" type="button" id="finish" @click=${act.finish}>${t("finish.now")}</button>
  `;
}

function shutter(state, act) {
  const { eye, part } = slotWords(state, state.route.slot);
  const [name, word] = face(state);
  return html`
    <button class="primary shutter" type="button" id="shutter" aria-disabled=${name !== "camera"} @click=${act.take}>
      ${icon(name)} <span>${word}<small>${eye} · ${part}</small></span>
    </button>
  `;
}

function face(state) {
  const { stop } = shownStates(state);
  if (stop) {
    const key = `stop.${stop.code}`;
    const left = timeLeft(stop.until);
    return [stop.code === "link.lost" ? "nolink" : "warn", t(has(key) ? key : "stop.other") + (left ? ` – ${left}` : "")];
  }
  return state.visit?.fields.consent === "agreed" ? ["camera", t("take")] : ["wait", t("take.consent")];
}
