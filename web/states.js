// Every state that the page can tell, as data: one table, one way to show it. The words stand in english.js under
// "state.CODE" (English master); what stops stands in the prompt bar and in the shutter ("stop.CODE"), what only tells is a chip.

import { consentOf, get, lostShots, set } from "./memory.js";
import { calendarDay, has, t } from "./words.js";

const SAID_ALOUD = /^(link\.lost|light\.|heat\.)/;

// Worst first. `stop`: no press while it stands. `tell`: a chip. `shot`: about one picture, on its card. `ask`: a question there.
// `wait`: how long until it is over by itself; "n" means the n minutes that the instrument named. Its own `wait_s` goes first.
const TABLE = [
  ["link.lost", "stop", []],
  ["link.other", "stop", ["useHere"]],
  ["lock.idle", "stop", ["pin"]],
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
  ["camera.stalled", "tell", []],
  ["power.lost", "tell", ["takeNow"]],
  ["link.slow", "tell", []],
  ["batt.low", "tell", []],
  ["store.low", "tell", []],
  ["clock.wrong", "tell", ["dateIsRight", "setClock"]],
  ["send.stuck", "tell", ["why", "tryNow"]],
  ["make.slow", "tell", ["next"]],
  ["heat.warm", "tell", []],
  ["send.waiting", "tell", ["see"]],
  ["cal.old", "tell", ["later"]],
  ["eye.side", "ask", ["change", "keepEye"]],
  ["make.failed", "shot", ["again", "next"]],
  ["shot.poor", "shot", ["couldNot", "again"]],
  ["shot.pupil", "shot", ["timer", "again"]],
  ...["shot.saturated", "shot.dark", "shot.moved", "shot.blink", "shot.noeye", "shot.edge", "shot.halo"].map((code) => [
    code,
    "shot",
    ["again"],
  ]),
];

export const STATES = Object.freeze(
  Object.fromEntries(
    TABLE.map(([code, level, buttons, more], rank) => [
      code,
      Object.freeze({ code, level, buttons, rank, aloud: SAID_ALOUD.test(code), ...more }),
    ]),
  ),
);

// The instrument's inner names of things that are one and the same to a screener.
const SAME = {
  "head.hot": "heat.hot",
  "power.low": "batt.empty",
  "calibration.missing": "cal.missing",
  "calibration.damaged": "cal.missing",
  "calibration.old": "cal.missing",
  "calibration.mode": "cal.mismatch",
  "calibration.stale": "cal.mismatch",
  "head.mismatch": "cal.mismatch",
  "technician.locked": "lock.idle",
};

// Stops that the server has and the table has not are as bad as a fault of the light; refusals without a fault only tell.
const UNKNOWN = { buttons: [], aloud: false };

/** The words of a state: the page's own in the reader's language, or the instrument's where those miss a number. */
export function wordsOf({ code, message, remedy, ...vars }) {
  const key = `state.${code}`;
  const values = filled(vars);
  if (has(key, values)) return t(key, values);
  return message ? `${message} ${remedy ?? ""}`.trim() : t("fault.unknown");
}

const filled = ({ eye, other, slot, ...vars }) => ({
  ...vars,
  ...(eye ? { eye: t(`eye.${eye}`) } : {}),
  ...(other ? { other: t(`eye.${other}.word`) } : {}),
  ...(/^\d{4}-/.test(vars.date) ? { date: calendarDay(vars.date) } : {}),
  ...(slot ? { part: t(`field.${slot.split("-")[1] ?? slot}`) } : {}),
});

const putOff = new Set(); // what somebody has read and put away is not told again before it was over

/** Somebody has read it: it stands no longer, on this page. */
export function dismiss({ code }) {
  putOff.add(code);
  lower(code);
}

/** What the instrument says stands now, whole: whatever it told before and is not in here is over. */
export function stands(all) {
  const codes = new Set(all.map(({ code }) => code));
  for (const code of putOff) if (!codes.has(code)) putOff.delete(code);
  lower(({ from, level, code }) => from === "notice" && level !== "ask" && !codes.has(code));
  for (const one of all) raise({ ...one, from: "notice" });
}

/** What the instrument told is over, and would be news if it came again. */
export function over(code) {
  putOff.delete(code);
  lower(code);
}

/**
 * A state begins, or is told anew. `from` says who takes it back: "status" (gone when the next status has no problem),
 * "press" (gone with OK, on another screen, with the next press), "notice" (the instrument says when), or "page".
 */
export function raise({ code: told, from, ...vars }) {
  const code = SAME[told] ?? told;
  if (from === "notice" && putOff.has(code)) return;
  const known = STATES[code] ?? { ...UNKNOWN, code, level: from === "press" ? "refused" : "stop", rank: 3 };
  const wait = vars.wait_s ?? (known.wait_s === "n" ? vars.n * 60 : known.wait_s);
  const before = get().states.find((state) => state.code === code);
  const until = before?.until || (wait ? Date.now() + wait * 1000 : 0);
  const state = Object.freeze({ ...known, ...vars, code, from, until });
  set({ states: Object.freeze([...get().states.filter((other) => other.code !== code), state].sort(worstFirst)) });
}

export function lower(test) {
  const code = SAME[test] ?? test;
  const gone = typeof code === "function" ? code : (state) => state.code === code;
  const left = get().states.filter((state) => !gone(state));
  if (left.length !== get().states.length) set({ states: Object.freeze(left) });
}

const worstFirst = (one, other) => one.rank - other.rank;

/** The stop of a visit whose person has not agreed: it stands for as long as the visit says so. */
function ofConsent({ route, visit }) {
  if (route.screen !== "aim" || visit?.id !== route.visit) return [];
  const known = STATES[`consent.${consentOf(visit)}`];
  return known ? [{ ...known, from: "visit" }] : [];
}

/** At most one stop and two chips, worst first; and every picture that was lost. */
export function shownStates(state) {
  const { states } = state;
  const lost = lostShots(state).map((shot) => ({ ...shot, ...STATES["shot.lost"], aloud: true }));
  return {
    stop: [...ofConsent(state), ...states].sort(worstFirst).find(({ level }) => level === "stop") ?? null,
    chips: [...lost, ...states.filter(({ level }) => level === "tell").slice(0, 2)],
  };
}

/** "4:12" until a state is over by itself; empty when nobody knows. */
export function timeLeft(until) {
  const left = Math.ceil((until - Date.now()) / 1000);
  return until && left > 0 ? `${Math.floor(left / 60)}:${String(left % 60).padStart(2, "0")}` : "";
}

// One clock for everything that counts down; it stands still when nothing does.
setInterval(() => {
  const { states, timer } = get();
  lower(({ until }) => until && until <= Date.now());
  if (timer || states.some(({ until }) => until)) set({ now: Date.now() });
}, 1000);
