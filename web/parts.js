// Pieces that several screens share: tiles, thumbnails, the words of a person, the bar and the chips of states.

import { fileOf } from "./api.js";
import { icon, target } from "./icons.js";
import { get, lostShots, slotPlan } from "./memory.js";
import { shownStates, timeLeft, wordsOf } from "./states.js";
import { html, nothing } from "./vendor/lit-html.js";
import { has, t } from "./words.js";

export const slotWords = (state, slot) => {
  const plan = slotPlan(state, slot);
  return plan ? { eye: t(`eye.${plan.eye}`), part: fieldWord(plan.field) } : { eye: "", part: "" };
};

// The programme may name fields that this page has never heard of; their own name is better than none.
export const fieldWord = (field) => (has(`field.${field}`) ? t(`field.${field}`) : field);

/** A person's number, an automatic one with its check digit apart, so that people who follow each other are seen to. */
export function numberWords(number) {
  const prefix = get().protocol?.programme?.prefix;
  const own = prefix && number.startsWith(prefix) && /^\d{5,}$/.test(number.slice(prefix.length));
  return own ? `${number.slice(0, -1)}-${number.slice(-1)}` : number;
}

export function personWords({ number: plain, fields }) {
  const number = numberWords(plain);
  const sex = fields.sex ? t(`sex.${fields.sex}`) : "";
  const more = [sex, fields.age].filter(Boolean).join(", ");
  return more ? `${number} · ${more}` : number;
}

// ---- the four tiles: a taken picture is always shown, also a poor one, with a mark that says what it is

const FACES = {
  empty: ["circle", "tile.empty"], // a field that this page knows is drawn instead
  good: ["star", "tile.good"],
  poor: ["pen", "tile.poor"],
  could_not: ["cross", "tile.could_not"],
  making: ["wait", "tile.making"],
  lost: ["warn", "tile.lost"],
};

function faceOf(state, id) {
  const { shots, visit } = state;
  const slot = visit?.slots[id];
  if (shots.some((shot) => shot.visit === visit?.id && shot.slot === id && !shot.over)) return "making";
  if (!slot || slot.state === "empty") return lostShots(state).some((shot) => shot.slot === id) ? "lost" : "empty";
  if (slot.state === "could_not") return "could_not";
  return slot.verdict?.word === "again" ? "poor" : "good";
}

export function tiles(state, act) {
  return html`
    <div class="tiles" role="group" aria-label=${t("part.tiles")}>
      ${(state.protocol?.slots ?? []).map((plan) => tile(state, act, plan))}
    </div>
  `;
}

function tile(state, act, { id, eye, field }) {
  const face = faceOf(state, id);
  const [mark, word] = FACES[face];
  const capture = state.visit?.slots[id]?.capture ?? state.visit?.slots[id]?.captures.at(-1);
  const short = `${t(`eye.${eye}.letter`)} · ${fieldWord(field)}`;
  const name = t("tile.name", { short, eye: t(`eye.${eye}`), state: t(word) }); // begins with what is seen (WCAG 2.5.3)
  return html`
    <button
      type="button"
      data-slot=${id}
      data-face=${face}
      aria-label=${name}
      aria-current=${state.route.slot === id ? "step" : "false"}
      ?disabled=${Boolean(state.visit?.finished_at) && !capture}
      @click=${() => act.chooseTile(id)}
    >
      <span class="thumb">${capture ? thumb(capture, act) : nothing}<span class="mark">${face === "empty" && has(`field.${field}`) ? target(eye, field) : icon(mark)}</span></span>
      <span class="tile-word">${short}</span>
    </button>
  `;
}

export const thumb = (capture, act) =>
  html`<img src=${fileOf(capture, "quick.jpg")} alt="" loading="lazy" @load=${act.thumbLoaded} />`;

const OF_THE_EXAM = new Set(["otherEye", "finish"]); // such a button is for whoever takes pictures

// ---- states: one bar for what stops, at most two chips for what only tells

/** What stands instead of the prompt, or on top of a screen that has none: the worst stop, else the last refusal. */
export function standing(state) {
  return shownStates(state).stop ?? state.states.find(({ level }) => level === "refused") ?? null;
}

export function stateBar(one, act) {
  const left = timeLeft(one.until);
  const words = one.aloud ? html`<p role="alert">${wordsOf(one)}</p>` : html`<p>${wordsOf(one)}</p>`;
  const open = get().route.slot && !get().visit?.finished_at;
  const own = one.buttons.filter((name) => open || !OF_THE_EXAM.has(name));
  const buttons = one.from === "press" ? [...own, "ok"] : own;
  return html`
    <div class="state-bar" data-code=${one.code}>
      ${icon(one.code === "link.lost" ? "nolink" : "warn")} ${words} ${left ? html`<b class="clock">${left}</b>` : nothing}
      ${buttons.length ? html`<span class="does">${buttons.map((name) => does(one, name, act))}</span>` : nothing}
    </div>
  `;
}

export function chips(state, act) {
  // The Send screen says itself what its two states say.
  const shown = shownStates(state).chips.filter(({ code }) => state.route.screen !== "send" || !code.startsWith("send."));
  if (!shown.length) return nothing;
  return html`
    <ul class="notices" aria-label=${t("part.notices")}>
      ${shown.map(
        (one) => html`<li data-code=${one.code}>
          <p role=${one.aloud ? "alert" : nothing}>${wordsOf(one)}</p>
          ${one.until ? html`<b class="clock">${timeLeft(one.until)}</b>` : nothing} ${one.buttons.map((name) => does(one, name, act))}
        </li>`,
      )}
    </ul>
  `;
}

const DOORS = { technician: "/technician", pin: "/technician", setClock: "/technician" };

export const does = (one, name, act) =>
  DOORS[name]
    ? html`<a class="button" href=${DOORS[name]}>${t(`do.${name}`)}</a>`
    : html`<button type="button" data-do=${name} @click=${() => act.stateDo(name, one)}>${t(`do.${name}`)}</button>`;

/** A group of tiles of which one (or, with `many`, several) is chosen. */
export function choice({ label, field, value, options, choose, many = false }) {
  const on = (one) => (many ? (value ?? []).includes(one) : value === one);
  return html`
    <div class="choice" role="group" aria-label=${label} data-field=${field}>
      ${options.map(
        ([one, word]) => html`<button
          type="button"
          data-value=${String(one)}
          aria-pressed=${on(one)}
          @click=${() => choose(one)}
        >
          ${icon("check")}<span>${word}</span>
        </button>`,
      )}
    </div>
  `;
}

/** Why a picture could not be taken: the programme's reasons as tiles. */
export function reasons({ protocol, route }, act) {
  return html`
    <div class="reasons" role="group" aria-labelledby="why">
      <h2 id="why">${t("result.why")}</h2>
      ${protocol.reasons.map(
        (reason) => html`<button type="button" data-reason=${reason} @click=${() => act.couldNot(route.slot, reason)}>
          ${has(`reason.${reason}`) ? t(`reason.${reason}`) : reason}
        </button>`,
      )}
      <button class="quiet" type="button" id="not-asked" @click=${act.stopAsking}>${t("back")}</button>
    </div>
  `;
}

/** A number pad, so that nothing must be typed on a keyboard. */
export function pad(press) {
  const key = (value, word = value) =>
    html`<button type="button" data-key=${value} @click=${() => press(value)}>${word}</button>`;
  return html`<div class="pad">
    ${["1", "2", "3", "4", "5", "6", "7", "8", "9"].map((digit) => key(digit))} ${key("erase", t("find.erase"))} ${key("0")}
  </div>`;
}

export const typedBy = (before, key, most) => (key === "erase" ? before.slice(0, -1) : (before + key).slice(0, most));
