// Alerts: one table of all states that the page can show, and the rules that choose what is visible. Texts:
// "state.CODE" in i18n/en.json. A blocking alert is shown in the prompt bar and in the shutter ("stop.CODE"), an advisory one
// as a chip.

import { sentences } from "./api.js";
import { consentOf, get, lostCaptures, set } from "./state.js";
import { calendarDay, clockTime, has, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

const ASSERTIVE = /^(link\.lost|light\.|heat\.)/;

// Highest priority first. Levels: `stop` blocks captures; `refused` is the reason of a refused request, in the prompt
// bar where nothing blocks; `tell` is an advisory chip; `picture` belongs to one picture and is shown on its card; `ask` is
// a question on that card. `wait_s`: seconds until the alert ends by itself; "n": the n minutes that the server sent. A
// `wait_s` from the server takes precedence.
/** @type {[string, string, string[], {wait_s?: number | "n"}?][]} */
const TABLE = [
  ["link.lost", "stop", []],
  ["link.other", "stop", ["useHere"]],
  ["light.fault", "stop", ["technician"]],
  ["camera.missing", "stop", ["retry", "technician"]],
  ["heat.hot", "stop", [], { wait_s: 300 }],
  ["batt.empty", "stop", []],
  ["consent.declined", "stop", ["finish"]],
  ["consent.missing", "stop", ["ask"]],
  ["light.day", "stop", ["finish"]],
  ["light.limit", "stop", ["otherEye"], { wait_s: "n" }],
  ["store.full", "stop", ["how"]],
  ["cal.missing", "stop", ["technician"]],
  ["cal.mismatch", "stop", ["technician"]],
  ["light.cut", "refused", []],
  ["shot.lost", "tell", ["takeNow"]],
  ["shot.crossed", "tell", ["uncross"], { wait_s: 10 }],
  ["shot.next", "tell", ["showAgain"]],
  ["camera.stalled", "tell", []],
  ["power.lost", "tell", ["takeNow"]],
  ["link.slow", "tell", []],
  ["batt.low", "tell", []],
  ["store.low", "tell", []],
  ["clock.unset", "tell", ["timeIsRight", "later"]],
  ["clock.wrong", "tell", ["dateIsRight", "setClock"]],
  ["send.stuck", "tell", ["why", "tryNow"]],
  ["make.slow", "tell", ["next"]],
  ["heat.warm", "tell", []],
  ["send.waiting", "tell", ["see"]],
  ["cal.old", "tell", ["later"]],
  ["eye.side", "ask", ["change", "keepEye"]],
  ["make.failed", "picture", ["again", "next"]],
  ["shot.poor", "picture", ["notPossible", "again"]],
  ["shot.pupil", "picture", ["timer", "again"]],
  ["shot.saturated", "picture", ["again"]],
  ["shot.dark", "picture", ["again"]],
  ["shot.moved", "picture", ["again"]],
  ["shot.blink", "picture", ["again"]],
  ["shot.noeye", "picture", ["again"]],
  ["shot.edge", "picture", ["again"]],
  ["shot.halo", "picture", ["again"]],
];

export const ALERTS = Object.freeze(
  Object.fromEntries(
    TABLE.map(([code, level, buttons, more], rank) => [
      code,
      Object.freeze({ code, level, buttons, rank, assertive: ASSERTIVE.test(code), ...more }),
    ]),
  ),
);

// Server codes that are one alert on this page.
const SAME = {
  "head.hot": "heat.hot",
  "power.low": "batt.empty",
  "calibration.missing": "cal.missing",
  "calibration.damaged": "cal.missing",
  "calibration.old": "cal.missing",
  "calibration.mode": "cal.mismatch",
  "calibration.stale": "cal.mismatch",
  "head.mismatch": "cal.mismatch",
};

// Defaults for a code that is not in the table: a server status blocks captures, a refused request is advisory.
const UNKNOWN = { buttons: [], assertive: false };

/**
 * Return the text of an alert: translated, or the server's text where a number is missing.
 * @param {{code: string, message?: string, remedy?: string, [more: string]: any}} alert
 */
export function alertText({ code, message, remedy, ...vars }) {
  const key = `state.${code}`;
  const values = { ...translatedValues(vars), ...(code === "clock.unset" && timeHere()) };
  if (has(key, values)) return t(key, values);
  return message ? sentences({ message, remedy }) : t("fault.unknown");
}

// Date and time of this screen, which the user accepts for a device that has none.
const timeHere = (now = new Date().toISOString()) => ({ today: calendarDay(now), now: clockTime(now) });

/** @type {(vars: {eye?: string, other?: string, slot?: string, [more: string]: any}) => Record<string, any>} */
const translatedValues = ({ eye, other, slot, n, ...vars }) => ({
  ...vars,
  count: n,
  ...(eye ? { eye: t(`eye.${eye}`) } : {}),
  ...(other ? { other: t(`eye.${other}.word`) } : {}),
  ...(/^\d{4}-/.test(vars.date) ? { date: calendarDay(vars.date) } : {}),
  ...(slot ? { part: t(`field.${slot.split("-")[1] ?? slot}`) } : {}),
});

const dismissed = new Set(); // codes that the user dismissed; hidden until the alert ends

/** Hide an alert on this page until it ends. */
export function dismissAlert({ code }) {
  dismissed.add(code);
  lowerAlert(code);
}

/** Replace the server's alerts with the list `all`; those that are missing from the list have ended. */
export function syncNotices(all) {
  const codes = new Set(all.map(({ code }) => code));
  for (const code of dismissed) if (!codes.has(code)) dismissed.delete(code);
  lowerAlerts(({ from, level, code }) => from === "notice" && level !== "ask" && !codes.has(code));
  for (const notice of all) raiseAlert({ ...notice, from: "notice" });
}

/** End an alert of the server; it is shown if it begins again. */
export function endNotice(code) {
  dismissed.delete(code);
  lowerAlert(code);
}

/**
 * Begin or update an alert. `from` names what ends it: "status" (the next status without a problem), "press" (OK,
 * another screen or the next press), "notice" (the server), or "page".
 */
export function raiseAlert({ code: reported, from, ...vars }) {
  const code = SAME[reported] ?? reported;
  if (from === "notice" && dismissed.has(code)) return;
  const known = ALERTS[code] ?? { ...UNKNOWN, code, level: from === "press" ? "refused" : "stop", rank: 3 };
  const wait = vars.wait_s ?? (known.wait_s === "n" ? vars.n * 60 : known.wait_s);
  const before = get().alerts.find((state) => state.code === code);
  const until = before?.until || (wait ? Date.now() + wait * 1000 : 0);
  const state = Object.freeze({ ...known, ...vars, code, from, until });
  set({ alerts: Object.freeze([...get().alerts.filter((other) => other.code !== code), state].sort(worstFirst)) });
}

/**
 * Begin the alert of a refused request, with all that the server sent.
 * @param {{code: string, message?: string, remedy?: string, vars: Record<string, any>}} problem
 */
export const raiseRefusal = ({ code, message, remedy, vars }) => raiseAlert({ code, message, remedy, ...vars, from: "press" });

/**
 * End the alert with this code.
 * @param {string} reported
 */
export const lowerAlert = (reported) => lowerAlerts(({ code }) => code === (SAME[reported] ?? reported));

/**
 * End the alerts for which `isOver(alert)` is true.
 * @param {(alert: import("./state.js").Alert) => boolean} isOver
 */
export function lowerAlerts(isOver) {
  const left = get().alerts.filter((alert) => !isOver(alert));
  if (left.length !== get().alerts.length) set({ alerts: Object.freeze(left) });
}

const worstFirst = (left, right) => left.rank - right.rank;

/** Return the blocking alert of a visit without consent. */
function consentAlerts({ route, visit }) {
  if (route.screen !== "aim" || visit?.id !== route.visit) return [];
  const known = ALERTS[`consent.${consentOf(visit)}`];
  return known ? [{ ...known, from: "visit", until: 0 }] : [];
}

/**
 * Return at most one blocking alert and two chips, highest priority first, and a chip for each lost picture.
 * @param {State} state
 * @returns {{stop: import("./state.js").Alert | null, chips: import("./state.js").Alert[]}}
 */
export function visibleAlerts(state) {
  const { alerts } = state;
  const lost = lostCaptures(state).map((capture) => ({ ...capture, ...ALERTS["shot.lost"], assertive: true, from: "page", until: 0 }));
  return {
    stop: [...consentAlerts(state), ...alerts].sort(worstFirst).find(({ level }) => level === "stop") ?? null,
    chips: [...lost, ...alerts.filter(({ level }) => level === "tell").slice(0, 2)],
  };
}

/** Return the remaining time as "4:12"; empty without an end time. */
export function timeLeft(until) {
  const left = Math.ceil((until - Date.now()) / 1000);
  return until && left > 0 ? `${Math.floor(left / 60)}:${String(left % 60).padStart(2, "0")}` : "";
}

// One timer for all countdowns; it changes the state only while a countdown is active.
setInterval(() => {
  const { alerts, timer } = get();
  lowerAlerts(({ until }) => until > 0 && until <= Date.now());
  if (timer || alerts.some(({ until }) => until)) set({ now: Date.now() });
}, 1000);
