// Aim: four tiles that drive the exam, and one big button that says in itself why it cannot be pressed.

import { icon } from "../icons.js";
import { allowsLight } from "../memory.js";
import { chips, reasons, slotWords, tiles } from "../parts.js";
import { shownStates, timeLeft } from "../states.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, t } from "../words.js";

export function aim(state, act) {
  const { eye, part } = slotWords(state, state.route.slot);
  if (state.asking) return html`<h2 class="slot-title">${eye} · ${part}</h2> ${reasons(state, act)} ${tiles(state, act)}`;
  const answered = Object.values(state.visit?.slots ?? {}).every((slot) => slot.state !== "empty");
  const here = state.visit?.slots[state.route.slot];
  return html`
    <h2 class="slot-title">${eye} · ${part}</h2>
    ${tiles(state, act)} ${state.later.aloud?.toSay(state) ?? nothing} ${chips(state, act)}
    <div class="actions">${shutter(state, act)}</div>
    <div class="last finish">
      ${here?.capture
        ? html`<button class="quiet" type="button" id="keep-old" @click=${act.keepOld}>${icon("check")} ${t("aim.keep")}</button>`
        : nothing}
      ${here?.state === "could_not"
        ? nothing
        : html`<button class="quiet" type="button" id="could-not" @click=${act.ask}>${icon("cross")} ${t("result.couldnot")}</button>`}
      <button class=${answered ? "primary" : "quiet"} type="button" id="finish" @click=${act.finish}>
        ${t(answered ? "result.finish" : "finish.now")}
      </button>
    </div>
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
  if (state.doing === "busy") return ["wait", t("take.making")]; // two are in the making: a third would be refused
  return allowsLight(state) ? ["camera", t("take")] : ["wait", t("take.making")];
}
