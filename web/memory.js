// What the page knows now, in one store; and what this tablet remembers, which is how the page looks and no person.

import { createStore } from "./store.js";

export function remember(key, value) {
  try {
    localStorage.setItem(`diffuscope.${key}`, value);
  } catch {
    // A browser that keeps nothing still works; it only forgets the theme.
  }
}

function remembered(key, otherwise) {
  try {
    return localStorage.getItem(`diffuscope.${key}`) ?? otherwise;
  } catch {
    return otherwise;
  }
}

export const FRESH_PICTURE = Object.freeze({
  picture: "none",
  grey: false,
  redfree: false,
  brightness: 0,
  contrast: 0,
  loupe: false,
  asking: false,
});

export const store = createStore({
  link: "opening", // opening | live | lost
  status: null,
  doing: "aim", // what the instrument says about itself
  mine: true, // this page holds the controls; any other page may take them by a tap
  states: Object.freeze([]), // what stands now: see states.js
  route: Object.freeze({ screen: "home" }),
  protocol: null, // slots, reasons, retakes: data of the programme
  visit: null,
  visits: null, // the list on the screen that shows one
  counts: null,
  typed: "", // on the number pad
  onlyShow: "all", // all | open | referred
  shots: Object.freeze([]), // pictures in the making and those looked at: see press.js
  prompt: null, // the device's word for what to do now
  ...FRESH_PICTURE,
  zoom: 1,
  note: "",
  picked: Object.freeze([]), // two pictures to compare
  compared: Object.freeze([]), // what is known of these two
  folders: null, // where a visit can be copied to
  zipped: false, // whether the browser was asked to save it
  copied: null,
  outbox: null, // who waits to be sent: the Send screen
  finishing: null, // the visit that is finished as soon as its last picture is there
  now: 0, // set every second while something counts down
  later: Object.freeze({}), // modules that Home does not need, by name
  aloud: null, // what can be said to the person: {tag, words, able}; see aloud.js
  saying: null, // {key, why}: the sentence, and why nobody could hear it
  voice: remembered("voice", ""), // the language that people speak here, where it is not the screen's
  sound: remembered("sound", "on") === "on",
  theme: remembered("theme", "dim"),
  letters: remembered("letters", "on") === "on",
  auto: remembered("auto", "off") === "on",
  language: remembered("language", "en"),
});

export const { get, set } = store;

/** The shot on the picture screen: the named capture, or the newest of the slot. */
export function shotOf({ route, shots }) {
  if (route.screen !== "picture") return null;
  const here = shots.filter((shot) => shot.visit === route.visit && shot.slot === route.slot);
  if (route.capture) return here.find((shot) => shot.id === route.capture) ?? null;
  return here.findLast((shot) => !shot.failed) ?? here.at(-1) ?? null;
}

/** The shots of a visit that are not over: what of it is still being made. */
export const underway = ({ shots }, visit) => shots.filter((shot) => shot.visit === visit && !shot.over);

/** A picture that belongs to the other eye is found there from now on. */
export const moveShot = (id, { id: slot, eye }) =>
  set({ shots: Object.freeze(get().shots.map((shot) => (shot.id === id ? Object.freeze({ ...shot, slot, eye }) : shot))) });

/** Pictures of the open visit that were pressed for and never came, until another is taken or could not be. */
export function lostShots({ shots, visit }) {
  if (!visit || visit.finished_at) return [];
  const of = ({ slot }) => shots.filter((shot) => shot.visit === visit.id && shot.slot === slot);
  return shots.filter(
    (shot) => shot.failed && of(shot).at(-1) === shot && visit.slots[shot.slot]?.state !== "could_not",
  );
}

/** What is recorded of the person's consent: "agreed", "declined", "missing"; "saving" while an answer is on its way. */
export const consentOf = ({ fields, waiting }) => (waiting?.includes("consent") ? "saving" : (fields.consent ?? "missing"));

/** Whether light is allowed for the visit of this screen; the instrument refuses it for every other. */
export const allowsLight = ({ route, visit }) => Boolean(visit) && visit.id === route.visit && consentOf(visit) === "agreed";

export const slotPlan = ({ protocol }, id) => protocol?.slots.find((slot) => slot.id === id) ?? null;
export const eyeOf = (state, slot) => slotPlan(state, slot)?.eye ?? "OD";
