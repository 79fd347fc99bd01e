// State of the page in one store, and settings of this tablet in localStorage (no patient data).

import { createStore } from "./store.js";

/** Store a setting of this tablet. */
export function saveSetting(key, value) {
  try {
    localStorage.setItem(`diffuscope.${key}`, value);
  } catch {
    // Without storage, the settings are lost on a reload.
  }
}

function loadSetting(key, otherwise) {
  try {
    return localStorage.getItem(`diffuscope.${key}`) ?? otherwise;
  } catch {
    return otherwise;
  }
}

export const PICTURE_DEFAULTS = Object.freeze({
  picture: "none",
  grey: false,
  version: 0, // number of the version that is shown; 0: the picture as taken
  redfree: false,
  brightness: 0,
  contrast: 0,
  loupe: false,
  asking: "", // question in place of the controls: "reason" why not possible, "finish" without all pictures
});

// What was shown so far.
const SHOWN = Object.freeze({
  noticeCount: 0, // notice events received
  shownFindings: Object.freeze([]), // texts of findings that were shown; a dismissed one is not shown again
  interruptedShown: false, // the captures that a power cut interrupted were shown
  promptedMs: 0, // begin of the display of `prompt`, performance.now()
  readySinceMs: 0, // since then the aiming hint is "ready"; 0: it is another one
});

const settings = Object.freeze({
  voice: loadSetting("voice", ""), // speech language, if it differs from the page's
  sound: loadSetting("sound", "on") === "on",
  theme: loadSetting("theme", "dim"),
  letters: loadSetting("letters", "on") === "on",
  auto: loadSetting("auto", "off") === "on",
  language: loadSetting("language", "en"),
});

/**
 * What the page reads of the server's answers (`services/http/schemas/`), and its own captures and alerts.
 * @typedef {{word: string, code?: string | null}} Verdict
 * @typedef {{state: string, capture: string | null, captures: string[], verdict: Verdict | null, reason: string | null, tries: number}} Slot
 * @typedef {{code: string, eye: string | null, field: string | null, value: string | null}} Reason
 * @typedef {{code: string, urgency: string, reasons: Reason[]}} Outcome
 * @typedef {{id: string, number: string, begun_at: string, fields: Record<string, any>, slots: Record<string, Slot>,
 *   next_slot: string | null, no_colour: string | null, outcome: Outcome | null,
 *   finished_at: string | null, day: string, undo_until: string | null, waiting?: string[]}} Visit
 * @typedef {{id: string, visit: string | null, slot: string | null, eye: string, taken_at: string, verdict: Verdict | null,
 *   simulated: boolean, report: any, links: Record<string, string>, versions?: any[], calibration_id: string, test: boolean}} CaptureRecord
 * @typedef {{key: string, visit: string, slot: string, eye: string, id: string | null,
 *   stage: {name: string, fraction: number, left: number}, verdict: Verdict | null, over?: boolean, quick?: string,
 *   record?: CaptureRecord, failed?: {code: string, message: string, remedy: string}, answerLost?: boolean, reloaded?: boolean}} Capture
 * @typedef {{code: string, level: string, rank: number, buttons: string[], from: string, until: number, [more: string]: any}} Alert
 * @typedef {{id: string, eye: string, field: string, required: boolean}} SlotPlan
 * @typedef {{slots: SlotPlan[], reasons: string[], retakes: number, referral: Record<string, any>, letter: {name: string | null}, numbers: Record<string, any>}} Programme
 * @typedef {{link: string, status: any, user: {name: string, roles: string[], is_demo: boolean} | null, activity: string, hasControl: boolean, alerts: readonly Alert[],
 *   route: import("./router.js").Route, programme: Programme | null, visit: Visit | null, visits: Visit[] | null,
 *   counts: {done: number, to_finish: number, referred: number, declined: number} | null, typed: string, listFilter: string,
 *   captures: readonly Capture[], prompt: {code: string} | null, picture: string, grey: boolean, version: number,
 *   redfree: boolean, brightness: number, contrast: number, loupe: boolean, asking: string, zoom: number, note: string,
 *   picked: readonly string[], compared: readonly CaptureRecord[], montages: Readonly<Record<string, any>>, changes: readonly any[],
 *   folders: {id: string, name: string, is_writable: boolean}[] | null, zipped: boolean, copied: string | null, uploadQueue: any,
 *   finishing: string | null, goesOnFrom: string | null, now: number, modules: Readonly<Record<string, any>>, speech: any, saying: any,
 *   voice: string, sound: boolean, theme: string, letters: boolean, auto: boolean, language: string, timer: number,
 *   blink: boolean, front: number, isCodeShown: boolean, noticeCount: number,
 *   shownFindings: readonly string[], interruptedShown: boolean, promptedMs: number, readySinceMs: number}} State
 */

export const store = createStore(/** @type {State} */ ({
  link: "opening", // opening | live | lost
  status: null,
  user: null, // the signed-in user: {name, roles, is_demo}
  activity: "aim", // state of the instrument, as in its status
  hasControl: false, // this page holds the control lease, which live pictures need; another page can take it
  alerts: Object.freeze([]), // active alerts, see alerts.js
  route: Object.freeze({ screen: "home" }),
  programme: null, // slots, reasons and retakes of the programme
  visit: null,
  visits: null, // the list on the current screen
  counts: null,
  typed: "", // digits of the number pad
  listFilter: "all", // all | open | referred
  captures: Object.freeze([]), // captures in progress and viewed captures, see capture.js
  prompt: null, // current aiming hint
  ...PICTURE_DEFAULTS,
  zoom: 1,
  note: "",
  picked: Object.freeze([]), // the two captures to compare
  compared: Object.freeze([]), // records of these two captures
  changes: Object.freeze([]), // of the visit on the pictures screen
  montages: Object.freeze({}), // of the visit on the pictures screen, by eye
  folders: null, // USB drives for a copy
  zipped: false, // the browser was asked to save a ZIP file
  copied: null,
  uploadQueue: null, // upload queue, for the Send screen
  finishing: null, // visit to finish after its last capture
  goesOnFrom: null, // key of the newest capture, while the page goes on from it by itself
  now: 0, // updated every second during a countdown
  modules: Object.freeze({}), // lazily loaded modules, by name
  speech: null, // sentences for the patient: {tag, words, hasVoice}, see speech.js
  saying: null, // {key, why}: the sentence, and why it was not spoken
  ...settings,
  timer: 0, // end of the rest of a small pupil, in milliseconds
  blink: false, // the compared pictures lie one over the other
  front: 0, // which of them is in front
  isCodeShown: false, // of the outcome
  ...SHOWN,
}));

export const { get, set } = store;

/**
 * Return the capture on the picture screen: the named capture, or the newest of the slot.
 * @param {State} state
 */
export function currentCapture({ route, captures }) {
  if (route.screen !== "picture") return null;
  const here = captures.filter((capture) => capture.visit === route.visit && capture.slot === route.slot);
  if (route.capture) return here.find((capture) => capture.id === route.capture) ?? null;
  return here.findLast((capture) => !capture.failed) ?? here.at(-1) ?? null;
}

/**
 * Return the captures of a visit that are still in progress.
 * @param {State} state
 * @param {string} visit
 */
export const pendingCaptures = ({ captures }, visit) => captures.filter((capture) => capture.visit === visit && !capture.over);

/** Move a capture to a slot of the other eye. */
export const moveCapture = (id, { id: slot, eye }) =>
  set({ captures: Object.freeze(get().captures.map((capture) => (capture.id === id ? Object.freeze({ ...capture, slot, eye }) : capture))) });

/**
 * Return the number of required slots of the visit that have neither a picture, nor one in progress, nor a reason.
 * @param {State} state
 */
export const missingPictures = ({ visit, programme, captures }) =>
  (programme?.slots ?? []).filter(
    ({ id, required }) =>
      required && visit?.slots[id]?.state === "empty" && !captures.some((capture) => capture.visit === visit.id && capture.slot === id && !capture.over),
  ).length;

/**
 * Return the failed captures of the open visit, each until its slot gets another capture or is marked "could not".
 * @param {State} state
 */
export function lostCaptures({ captures, visit }) {
  if (!visit || visit.finished_at) return [];
  const of = ({ slot }) => captures.filter((capture) => capture.visit === visit.id && capture.slot === slot);
  return captures.filter(
    (capture) => capture.failed && of(capture).at(-1) === capture && visit.slots[capture.slot]?.state !== "not_possible",
  );
}

/**
 * Return the consent of a visit: "agreed", "declined" or "missing"; "saving" while a change is being sent.
 * @param {Visit} visit
 */
export const consentOf = ({ fields, waiting }) => (waiting?.includes("consent") ? "saving" : (fields.consent ?? "missing"));

/**
 * Return whether captures are allowed for the visit on this screen; the server refuses all others.
 * @param {State} state
 */
export const allowsLight = ({ route, visit }) => visit !== null && visit.id === route.visit && consentOf(visit) === "agreed";

/**
 * Return the definition of a slot in the programme.
 * @param {State} state
 * @param {string | null | undefined} id
 */
export const slotPlan = ({ programme }, id) => programme?.slots.find((slot) => slot.id === id) ?? null;
/**
 * Return the definition of the slot with the same field of the other eye.
 * @param {State} state
 * @param {string | null | undefined} id
 */
export function otherEyeSlot(state, id) {
  const here = slotPlan(state, id);
  return state.programme?.slots.find(({ eye, field }) => eye !== here?.eye && field === here?.field) ?? null;
}

/** @type {(state: State, slot: string | null | undefined) => string} */
export const eyeOf = (state, slot) => slotPlan(state, slot)?.eye ?? "OD";
