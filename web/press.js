// From the press to the picture: which shots are in the making, what the instrument says about each, what is kept.
// A shot: {key, visit, slot, eye, id, stage, verdict, quick, capture, over}; `id` is the instrument's, `key` is ours and stays.

import { freshKey, getCapture, Refusal, send } from "./api.js";
import { allowsLight, eyeOf, FRESH_PICTURE, get, set, shotOf } from "./memory.js";
import { go } from "./routes.js";
import { lower, raise, shownStates } from "./states.js";
import { politely, refreshVisit } from "./visit.js";
import { t } from "./words.js";

const LOCK_MS = 400; // the second half of a double tap must neither take a picture nor leave one
const SHOTS = 12;
const START = Object.freeze({ name: "expose", fraction: 0, left: 0 });

let lockedUntil = 0;
const known = new Set(); // captures that were there before: late events about them are not about our press

export function lock() {
  lockedUntil = performance.now() + LOCK_MS;
}

/** True, once, when an act may follow the last one. */
export function unlocked() {
  if (performance.now() < lockedUntil) return false;
  lock();
  return true;
}

const BUZZ = { ready: 15, taken: 30, good: 15, poor: [30, 60, 30] };

/** A tone and a short vibration beside the words, once somebody has touched the page: browsers complain about earlier ones. */
export function cue(name) {
  if (!navigator.userActivation?.hasBeenActive) return;
  navigator.vibrate?.(BUZZ[name]);
  if (get().sound) import("./sound.js").then(({ play }) => play(name), () => {}); // no link: the words say so
}

const put = (shots) => set({ shots: Object.freeze(shots.slice(-SHOTS)) });
const change = (key, more) =>
  put(get().shots.map((shot) => (shot.key === key ? Object.freeze({ ...shot, ...more }) : shot)));
const byId = (id) => get().shots.find((shot) => shot.id === id);

export function take() {
  if (!unlocked()) return;
  const { route } = get();
  if (route.screen === "picture") sayAlready();
  if (route.screen !== "aim" || !allowsLight(get())) return;
  // A press into a dead link could arrive later, and light nobody expects would go on: it is not sent. Everything else
  // that may forbid a press the instrument has told, and would refuse.
  if (shownStates(get()).stop) return;
  makePicture(route.visit, route.slot);
}

// The note stands where the picture's mark stands, so it must soon give the place back.
function sayAlready() {
  set({ note: t("take.already") });
  setTimeout(() => set({ note: "" }), 3000);
}

async function makePicture(visit, slot) {
  const eye = eyeOf(get(), slot);
  const key = freshKey();
  for (const { id, over } of get().shots) if (id && over) known.add(id);
  lower(({ from }) => from === "press");
  put([...get().shots, Object.freeze({ key, visit, slot, eye, id: null, stage: START, verdict: null, over: false })]);
  go({ screen: "picture", visit, slot });
  cue("taken");
  try {
    kept(await send("POST", "/api/captures", { eye, key, visit, slot }), key);
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    refused(key, problem);
  }
}

// A shot that the instrument began is never forgotten without a word, for somebody may have been told that it is good.
function refused(key, { code, message, remedy, vars }) {
  const shot = get().shots.find((one) => one.key === key);
  if (!shot || shot.over) return;
  const here = shotOf(get())?.key === key;
  if (shot.id && code === "link.cut") {
    change(key, { cut: true }); // perhaps it is kept: asked when the link is back
  } else {
    if (shot.id) change(key, { over: true, failed: { code, message, remedy } });
    else put(get().shots.filter((one) => one.key !== key));
    if (here) go({ screen: "aim", visit: shot.visit, slot: shot.slot }, { replace: true });
  }
  if (here || !shot.id) raise({ code, message, remedy, ...vars, from: "press" }); // elsewhere the chip of the lost one tells
  refreshVisit(shot.visit);
}

/** The link is back: what became of the pictures whose answer it cut off? */
export async function settleShots() {
  for (const { id, key } of get().shots.filter(({ cut, over }) => cut && !over)) {
    try {
      kept(await getCapture(id), key);
    } catch (problem) {
      if (!(problem instanceof Refusal)) throw problem;
      const later = problem.code === "link.cut" || ["making", "busy"].includes(get().doing);
      if (!later) refused(key, { ...problem, message: t("lost"), remedy: t("lost.remedy") });
    }
  }
}

function kept(capture, key = byId(capture.id)?.key) {
  known.add(capture.id);
  const shot = get().shots.find((one) => one.key === key);
  if (!shot || shot.capture) return;
  const verdict = capture.verdict ?? shot.verdict;
  if (verdict?.word !== "good" || shot.verdict?.word !== "good") lock(); // the buttons have just changed under the finger
  change(key, { id: capture.id, capture: Object.freeze(capture), verdict, over: true, stage: { ...shot.stage, fraction: 1 } });
  intoSlot(shot, capture.id, verdict);
  refreshVisit(shot.visit);
}

// The tile shows the picture at once; the visit that is loaded then has the last word.
function intoSlot({ visit: id, slot: name }, capture, verdict) {
  const { visit } = get();
  const slot = visit?.id === id ? visit.slots[name] : null;
  if (!slot || slot.captures.includes(capture)) return;
  const captures = [...slot.captures, capture];
  const taken = { ...slot, state: "taken", capture, captures, verdict, tries: slot.tries + 1 };
  set({ visit: Object.freeze({ ...visit, slots: { ...visit.slots, [name]: taken } }) });
}

/** What the instrument says about shots, by the name of the event. */
export const heardOfShots = {
  stage({ id, key, visit, slot, stage: name, url, fraction, left_s: left }) {
    if (known.has(id)) return;
    // Only by its own key, or by its place after a reload: another screen's picture must never be taken for ours.
    const own = (one) => one.key === key || (one.reloaded && one.visit === visit && one.slot === slot);
    const shot = byId(id) ?? get().shots.find((one) => !one.id && !one.over && own(one));
    if (!shot || shot.over) return;
    // A bar that goes back tells people that something broke, so it never does.
    const stage = { name, fraction: Math.max(shot.stage.fraction, fraction ?? 0), left: left ?? 0 };
    change(shot.key, { id, stage, quick: url ?? shot.quick });
  },

  /** The word on the raw frame, while the eye is there; once more when the made picture changes it. */
  verdict({ id, ...verdict }) {
    const shot = byId(id);
    if (!shot || shot.over) return;
    change(shot.key, { verdict: Object.freeze(verdict) });
    if (shot.verdict?.word === verdict.word) return;
    lock();
    cue(verdict.word === "again" ? "poor" : "good");
  },

  kept(capture) {
    const waiting = ({ id, over, visit, slot }) => !id && !over && visit === capture.visit && slot === capture.slot;
    const shot = byId(capture.id) ?? get().shots.find(waiting);
    if (shot) kept(capture, shot.key);
    else if (capture.visit && capture.visit === get().visit?.id) refreshVisit(capture.visit);
  },

  /** Whoever pressed hears it as the answer; a page that was loaded anew since then hears it here. */
  failed({ id, code, message, remedy }) {
    const shot = byId(id);
    if (shot?.reloaded && !shot.over) change(shot.key, { over: true, failed: { code, message, remedy } });
  },
};

/** Show a picture that was taken before: after a reload, or from the tiles. Without one, aim instead. */
export async function openPicture(route) {
  if (shotOf(get())) return;
  const { visit } = get();
  const slot = visit?.slots[route.slot];
  const id = route.capture ?? slot?.capture ?? slot?.captures?.at(-1);
  if (id) {
    const capture = await politely(() => getCapture(id));
    if (capture && capture.visit !== route.visit) notHere(route, capture);
    else if (capture) put([...get().shots, shotFrom(capture, route)]);
  } else if (["making", "busy"].includes(get().doing)) {
    const eye = eyeOf(get(), route.slot);
    const shot = { key: freshKey(), ...route, eye, id: null, stage: START, verdict: null, reloaded: true };
    put([...get().shots, Object.freeze(shot)]);
  } else {
    go({ screen: "aim", visit: route.visit, slot: route.slot }, { replace: true });
  }
}

// An address that somebody typed: no picture is shown as one of a visit to which it does not belong.
function notHere({ visit }, { test }) {
  go({ screen: "person", visit }, { replace: true });
  raise({ code: "capture.elsewhere", message: t(test ? "fault.test" : "fault.elsewhere"), remedy: "", from: "press" });
}

function shotFrom(capture, { visit, slot }) {
  known.add(capture.id);
  const { id, eye } = capture;
  return Object.freeze({ key: id, visit, slot, eye, id, stage: START, verdict: capture.verdict ?? null, capture, over: true });
}

/** Another picture begins with neutral tools. */
export function freshPicture() {
  set({ ...FRESH_PICTURE, zoom: 1, note: "" });
}
