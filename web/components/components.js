// Templates that several screens share: tiles, thumbnails, patient labels, alert bar and chips, button groups, number
// pad.

import { captureFileUrl } from "../core/api.js";
import { displayNumber } from "../core/numbers.js";
import { icon, target } from "./icons.js";
import { currentCapture, get, lostCaptures, missingPictures, slotPlan } from "../core/state.js";
import { visibleAlerts, timeLeft, alertText } from "../core/alerts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { calendarDay, has, number, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

/**
 * Return the translated eye and field of a slot: {eye, part}.
 * @param {State} state
 * @param {string | null | undefined} slot
 */
export const slotLabel = (state, slot) => {
  const plan = slotPlan(state, slot);
  return plan ? { eye: t(`eye.${plan.eye}`), part: fieldLabel(plan.field) } : { eye: "", part: "" };
};

// A field without a translation is shown by its name in the programme.
export const fieldLabel = (field) => (has(`field.${field}`) ? t(`field.${field}`) : field);

/** Return number, sex and age as one label. */
export function patientLabel({ number: plain, fields }) {
  const shown = displayNumber(plain);
  const sex = fields.sex ? t(`sex.${fields.sex}`) : "";
  const details = [sex, fields.age].filter(Boolean).join(", ");
  return details ? `${shown} · ${details}` : shown;
}

// ---- slot tiles: every picture is shown, also a poor one, with an icon for its state

const TILE_FACES = {
  empty: ["circle", "tile.empty"], // known fields show their drawing instead
  good: ["check", "tile.good"],
  poor: ["pen", "tile.poor"],
  not_possible: ["cross", "tile.not_possible"],
  making: ["wait", "tile.making"],
  lost: ["warn", "tile.lost"],
};

/** @param {State} state */
function faceOf(state, id) {
  const { captures, visit } = state;
  const slot = visit?.slots[id];
  if (captures.some((capture) => capture.visit === visit?.id && capture.slot === id && !capture.over)) return "making";
  if (!slot || slot.state === "empty") return lostCaptures(state).some((capture) => capture.slot === id) ? "lost" : "empty";
  if (slot.state === "not_possible") return "not_possible";
  return slot.verdict?.word === "again" ? "poor" : "good";
}

/**
 * Row of slot tiles.
 * @param {State} state
 */
export function tiles(state, actions) {
  return html`
    <div class="tiles" role="group" aria-label=${t("part.tiles")}>
      ${(state.programme?.slots ?? []).map((plan) => tile(state, actions, plan))}
    </div>
  `;
}

/** @param {State} state */
function tile(state, actions, { id, eye, field }) {
  const face = faceOf(state, id);
  const [mark, word] = TILE_FACES[face];
  const capture = state.visit?.slots[id]?.capture ?? state.visit?.slots[id]?.captures.at(-1);
  const short = `${t(`eye.${eye}.letter`)} · ${fieldLabel(field)}`;
  const name = t("tile.name", { short, eye: t(`eye.${eye}`), state: t(word) }); // starts with the visible text (WCAG 2.5.3)
  return html`
    <button
      type="button"
      data-slot=${id}
      data-face=${face}
      aria-label=${name}
      aria-current=${state.route.slot === id ? "step" : "false"}
      ?disabled=${Boolean(state.visit?.finished_at) && !capture}
      @click=${() => actions.chooseTile(id)}
    >
      <span class="thumb">${capture ? thumb(state.visit, capture, actions) : nothing}<span class="mark">${face === "empty" && has(`field.${field}`) ? target(eye, field) : icon(mark)}</span></span>
      <span class="tile-word">${short}</span>
    </button>
  `;
}

/**
 * Thumbnail of a stored capture: the picture that its visit shows first, reduced.
 * @param {import("../core/state.js").Visit | null} visit
 */
export const thumb = (visit, capture, actions) =>
  html`<img src=${captureFileUrl(capture, visit?.no_colour ? "green.jpg" : "quick.jpg")} alt="" loading="lazy" @load=${actions.thumbLoaded} @error=${actions.thumbFailed} />`;

const LIGHT_LIMITS = ["light.limit", "light.day", "light.visit"];

/**
 * Why the pictures of a visit are shown in green light; "" for a visit in colour.
 * @param {import("../core/state.js").Visit | null} visit
 */
export function whyGreen(visit) {
  const code = visit?.no_colour;
  if (!code) return "";
  if (LIGHT_LIMITS.includes(code)) return t("green.light");
  return t(code === "colour.none" || code === "colour.psf" ? `green.${code.slice(7)}` : "green.failed");
}

/** How long a picture took, of its time budget and from the tap; "" where it is not known. */
export function madeText({ budget_s: budget, from_read_out_s: s = null, from_tap_s: tap = null }) {
  const digits = budget < 1 ? 2 : 1;
  if (s === null || tap === null) return "";
  return t("made.in", { s: number(s, digits), budget: number(budget, digits), tap: number(tap, 1) });
}

const EXAM_BUTTONS = new Set(["otherEye", "finish"]); // only shown during an exam

// ---- alerts: one bar for a blocking alert, at most two chips

/**
 * Return the alert of the prompt bar: the blocking alert of highest priority, else the latest refused request.
 * @param {State} state
 */
export function topAlert(state) {
  return visibleAlerts(state).stop ?? state.alerts.find(({ level }) => level === "refused") ?? null;
}

/**
 * The blocking alert in a line of its own, where no prompt line shows it.
 * @param {State} state
 */
export function standing(state, actions) {
  const stop = topAlert(state);
  return stop ? html`<div class="standing">${alertBar(stop, actions)}</div>` : nothing;
}

/** Bar of one alert with its text, countdown and buttons. */
export function alertBar(alert, actions) {
  const left = timeLeft(alert.until);
  const text = alert.assertive ? html`<p role="alert">${alertText(alert)}</p>` : html`<p>${alertText(alert)}</p>`;
  const open = get().route.slot && !get().visit?.finished_at;
  const shownButtons = alert.buttons.filter((name) => open || !EXAM_BUTTONS.has(name));
  const buttons = alert.from === "press" ? [...shownButtons, "ok"] : shownButtons;
  return html`
    <div class="state-bar" data-code=${alert.code}>
      ${icon(alert.code === "link.lost" ? "nolink" : "warn")} ${text} ${left ? html`<b class="clock">${left}</b>` : nothing}
      ${buttons.length ? html`<span class="does">${buttons.map((name) => alertButton(alert, name, actions))}</span>` : nothing}
    </div>
  `;
}

/**
 * List of advisory alerts, after the question about the picture that is shown.
 * @param {State} state
 */
export function chips(state, actions) {
  const capture = currentCapture(state);
  const side = capture && state.alerts.find(({ level, id }) => level === "ask" && (!id || id === capture.id));
  const advisory = visibleAlerts(state).chips.filter(({ code }) => !isSaidElsewhere(state, code));
  const shown = side ? [side, ...advisory] : advisory;
  if (!shown.length) return nothing;
  return html`
    <ul class="notices" aria-label=${t("part.notices")}>
      ${shown.map(
        (alert) => html`<li class=${alert.level} data-code=${alert.code}>
          <p role=${alert.assertive ? "alert" : nothing}>${alertText(alert)}</p>
          ${alert.until ? html`<b class="clock">${timeLeft(alert.until)}</b>` : nothing} ${alert.buttons.map((name) => alertButton(alert, name, actions))}
        </li>`,
      )}
    </ul>
  `;
}

/**
 * Return whether the screen itself says what an alert says: the Send screen, and a picture that has its verdict and "Next".
 * @param {State} state
 * @param {string} code
 */
function isSaidElsewhere(state, code) {
  const capture = currentCapture(state);
  return (state.route.screen === "send" && code.startsWith("send.")) || (code === "make.slow" && Boolean(capture?.verdict || capture?.over));
}

const ALERT_LINKS = { technician: "/technician", pin: "/technician" };

export const alertButton = (alert, name, actions) =>
  ALERT_LINKS[name]
    ? html`<a class="button" href=${ALERT_LINKS[name]}>${t(`do.${name}`)}</a>`
    : html`<button type="button" data-do=${name} @click=${() => actions.runAlertButton(name, alert)}>${t(`do.${name}`)}</button>`;

/**
 * Group of toggle buttons: one choice, or several with `many`.
 * @param {{label: string, field?: string, value: any, options: any[][], choose: (option: any) => void, many?: boolean}} group
 */
export function choice({ label, field, value, options, choose, many = false }) {
  const on = (option) => (many ? (value ?? []).includes(option) : value === option);
  return html`
    <div class="choice" role="group" aria-label=${label} data-field=${field}>
      ${options.map(
        ([option, word]) => html`<button
          type="button"
          data-value=${String(option)}
          aria-pressed=${on(option)}
          @click=${() => choose(option)}
        >
          ${icon("check")}<span>${word}</span>
        </button>`,
      )}
    </div>
  `;
}

/** Name of a version of a picture: its number, and the day on which the store adopted it. */
export const versionName = ({ number: count, at }) => t("version.n", { count, day: at ? calendarDay(at) : "" });

/**
 * The question in place of the controls: why a picture is not possible, or whether to finish without all pictures.
 * @param {State} state
 */
export const question = (state, actions) => (state.asking === "finish" ? finishQuestion(state, actions) : reasons(state, actions));

/** @param {State} state */
function finishQuestion(state, actions) {
  return html`
    <div class="reasons" id="finish-question" role="group" aria-labelledby="missing">
      <h2 id="missing">${t("finish.missing", { count: missingPictures(state) })}</h2>
      <button class="primary" type="button" id="take-missing" @click=${actions.takeMissing}>${icon("camera")} ${t("finish.take")}</button>
      <button type="button" id="finish-without" @click=${actions.finishWithout}>${t("finish.now")}</button>
      <button class="quiet" type="button" id="not-asked" @click=${actions.stopAsking}>${t("back")}</button>
    </div>
  `;
}

/**
 * Reasons of the programme why a picture could not be taken, as buttons.
 * @param {State} state
 */
function reasons({ programme, route }, actions) {
  return html`
    <div class="reasons" role="group" aria-labelledby="why">
      <h2 id="why">${t("result.why")}</h2>
      ${(programme?.reasons ?? []).map(
        (reason) => html`<button type="button" data-reason=${reason} @click=${() => actions.notPossible(route.slot, reason)}>
          ${has(`reason.${reason}`) ? t(`reason.${reason}`) : reason}
        </button>`,
      )}
      <button class="quiet" type="button" id="not-asked" @click=${actions.stopAsking}>${t("back")}</button>
    </div>
  `;
}

/** Number pad, so that no keyboard is needed. */
export function numberPad(press) {
  const key = (value, word = value) =>
    html`<button type="button" data-key=${value} @click=${() => press(value)}>${word}</button>`;
  return html`<div class="pad" data-repeat>
    ${["1", "2", "3", "4", "5", "6", "7", "8", "9"].map((digit) => key(digit))} ${key("erase", t("find.erase"))} ${key("0")}
  </div>`;
}
