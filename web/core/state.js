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
  asking: false,
});

export const store = createStore({
  link: "opening", // opening | live | lost
  status: null,
  activity: "aim", // state of the instrument, as in its status
  hasControl: false, // this page holds the control lease, which live pictures need; another page can take it
  alerts: Object.freeze([]), // active alerts, see alerts.js
  route: Object.freeze({ screen: "home" }),
  protocol: null, // slots, reasons and retakes of the programme
  visit: null,
  visits: null, // the list on the current screen
  counts: null,
  typed: "", // digits of the number pad
  listFilter: "all", // all | open | referred
  shots: Object.freeze([]), // captures in progress and viewed captures, see capture.js
  prompt: null, // current aiming hint
  ...PICTURE_DEFAULTS,
  zoom: 1,
  note: "",
  picked: Object.freeze([]), // the two captures to compare
  compared: Object.freeze([]), // records of these two captures
  montages: Object.freeze({}), // of the visit on the pictures screen, by eye
  folders: null, // USB drives for a copy
  zipped: false, // the browser was asked to save a ZIP file
  copied: null,
  outbox: null, // upload queue, for the Send screen
  finishing: null, // visit to finish after its last capture
  now: 0, // updated every second during a countdown
  modules: Object.freeze({}), // lazily loaded modules, by name
  speech: null, // sentences for the patient: {tag, words, hasVoice}, see speech.js
  saying: null, // {key, why}: the sentence, and why it was not spoken
  voice: loadSetting("voice", ""), // speech language, if it differs from the page's
  sound: loadSetting("sound", "on") === "on",
  theme: loadSetting("theme", "dim"),
  letters: loadSetting("letters", "on") === "on",
  auto: loadSetting("auto", "off") === "on",
  language: loadSetting("language", "en"),
});

export const { get, set } = store;

/** Return the shot on the picture screen: the named capture, or the newest of the slot. */
export function currentShot({ route, shots }) {
  if (route.screen !== "picture") return null;
  const here = shots.filter((shot) => shot.visit === route.visit && shot.slot === route.slot);
  if (route.capture) return here.find((shot) => shot.id === route.capture) ?? null;
  return here.findLast((shot) => !shot.failed) ?? here.at(-1) ?? null;
}

/** Return the shots of a visit that are still in progress. */
export const pendingShots = ({ shots }, visit) => shots.filter((shot) => shot.visit === visit && !shot.over);

/** Move a shot to a slot of the other eye. */
export const moveShot = (id, { id: slot, eye }) =>
  set({ shots: Object.freeze(get().shots.map((shot) => (shot.id === id ? Object.freeze({ ...shot, slot, eye }) : shot))) });

/** Return the failed shots of the open visit, each until its slot gets another shot or is marked "could not". */
export function lostShots({ shots, visit }) {
  if (!visit || visit.finished_at) return [];
  const of = ({ slot }) => shots.filter((shot) => shot.visit === visit.id && shot.slot === slot);
  return shots.filter(
    (shot) => shot.failed && of(shot).at(-1) === shot && visit.slots[shot.slot]?.state !== "could_not",
  );
}

/** Return the consent of a visit: "agreed", "declined" or "missing"; "saving" while a change is being sent. */
export const consentOf = ({ fields, waiting }) => (waiting?.includes("consent") ? "saving" : (fields.consent ?? "missing"));

/** Return whether captures are allowed for the visit on this screen; the server refuses all others. */
export const allowsLight = ({ route, visit }) => Boolean(visit) && visit.id === route.visit && consentOf(visit) === "agreed";

/** Return the definition of a slot in the programme: {id, eye, field}. */
export const slotPlan = ({ protocol }, id) => protocol?.slots.find((slot) => slot.id === id) ?? null;
export const eyeOf = (state, slot) => slotPlan(state, slot)?.eye ?? "OD";
