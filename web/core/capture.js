// Captures from press to kept picture: requests, progress events, verdicts and lost answers.
// A shot: {key, visit, slot, eye, id, stage, verdict, quick, capture, over}; `key` is the idempotency key, `id` the
// server's.

import { newIdempotencyKey, getCapture, ApiError, send } from "./api.js";
import { allowsLight, eyeOf, PICTURE_DEFAULTS, get, set, currentShot } from "./state.js";
import { navigate } from "./router.js";
import { buttonsChanged } from "./taps.js";
import { lowerAlerts, raiseAlert, raiseRefusal, visibleAlerts } from "./alerts.js";
import { alertOnError, refreshVisit } from "./visit.js";
import { t } from "../i18n/translate.js";

const SHOTS_MAX = 12;
const FIRST_STAGE = Object.freeze({ name: "expose", fraction: 0, left: 0 });

const finishedIds = new Set(); // finished captures; their late events are ignored

const VIBRATIONS = { ready: 15, taken: 30, good: 15, poor: [30, 60, 30] };

/** Play a tone and vibrate, after the first touch of the page: browsers refuse both before it. */
export function playCue(name) {
  if (!navigator.userActivation?.hasBeenActive) return;
  navigator.vibrate?.(VIBRATIONS[name]);
  if (get().sound) import("./sound.js").then(({ play }) => play(name), () => {}); // without a connection there is no tone; the text is shown
}

const setShots = (shots) => set({ shots: Object.freeze(shots.slice(-SHOTS_MAX)) });
const updateShot = (key, patch) =>
  setShots(get().shots.map((shot) => (shot.key === key ? Object.freeze({ ...shot, ...patch }) : shot)));
const shotById = (id) => get().shots.find((shot) => shot.id === id);

/** Take a picture of the current slot, unless an alert or a missing consent blocks it. */
export function takePicture() {
  const { route } = get();
  if (route.screen === "picture") showPendingNote();
  if (route.screen !== "aim" || !allowsLight(get())) return;
  // No request while a blocking alert is visible: over a dead connection it could arrive later and switch on unexpected
  // light. The server refuses presses for all other reasons.
  if (visibleAlerts(get()).stop) return;
  submitCapture(route.visit, route.slot);
}

// The note replaces the picture's mark, so it is removed after 3 s.
function showPendingNote() {
  set({ note: t("take.already") });
  setTimeout(() => set({ note: "" }), 3000);
}

async function submitCapture(visit, slot) {
  const eye = eyeOf(get(), slot);
  const key = newIdempotencyKey();
  for (const { id, over } of get().shots) if (id && over) finishedIds.add(id);
  lowerAlerts(({ from }) => from === "press");
  setShots([...get().shots, Object.freeze({ key, visit, slot, eye, id: null, stage: FIRST_STAGE, verdict: null, over: false })]);
  navigate({ screen: "picture", visit, slot });
  playCue("taken");
  try {
    completeShot(await send("POST", "/api/captures", { eye, key, visit, slot }), key);
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    failShot(key, problem);
  }
}

// A failed capture that the server had begun is reported, because a good verdict may have been shown.
function failShot(key, problem) {
  const { code, message, remedy } = problem;
  const shot = get().shots.find((one) => one.key === key);
  if (!shot || shot.over) return;
  const here = currentShot(get())?.key === key;
  if (shot.id && code === "link.cut") {
    updateShot(key, { answerLost: true }); // perhaps the server kept it; queried when the connection is back
  } else {
    if (shot.id) updateShot(key, { over: true, failed: { code, message, remedy } });
    else setShots(get().shots.filter((one) => one.key !== key));
    if (here) navigate({ screen: "aim", visit: shot.visit, slot: shot.slot }, { replace: true });
  }
  if (here || !shot.id) raiseRefusal(problem); // on other screens the chip of the lost picture is shown
  refreshVisit(shot.visit);
}

/** After a reconnection, fetch the result of each capture whose answer was lost. */
export async function resolveCutShots() {
  for (const { id, key, answerLost, over } of get().shots) {
    if (!id || !answerLost || over) continue;
    try {
      completeShot(await getCapture(id), key);
    } catch (problem) {
      if (!(problem instanceof ApiError)) throw problem;
      const pending = problem.code === "link.cut" || ["making", "busy"].includes(get().activity);
      if (!pending) failShot(key, { ...problem, message: t("lost"), remedy: t("lost.remedy") });
    }
  }
}

function completeShot(capture, key = shotById(capture.id)?.key) {
  finishedIds.add(capture.id);
  const shot = get().shots.find((one) => one.key === key);
  if (!shot || shot.capture) return;
  const verdict = capture.verdict ?? shot.verdict;
  if (verdict?.word !== "good" || shot.verdict?.word !== "good") buttonsChanged();
  updateShot(key, { id: capture.id, capture: Object.freeze(capture), verdict, over: true, stage: { ...shot.stage, fraction: 1 } });
  updateSlot(shot, capture.id, verdict);
  refreshVisit(shot.visit);
}

// Optimistic update: show the picture in its tile until the visit is loaded.
function updateSlot({ visit: id, slot: name }, capture, verdict) {
  const { visit } = get();
  const slot = visit?.slots[name];
  if (!visit || visit.id !== id || !slot || slot.captures.includes(capture)) return;
  const captures = [...slot.captures, capture];
  const taken = { ...slot, state: "taken", capture, captures, verdict, tries: slot.tries + 1 };
  set({ visit: Object.freeze({ ...visit, slots: { ...visit.slots, [name]: taken } }) });
}

/** Handlers of the capture events, by event name. */
export const captureEventHandlers = {
  stage({ id, key, visit, slot, stage: name, url, fraction, left_s: left }) {
    if (finishedIds.has(id)) return;
    // Match by key, or by visit and slot after a reload, so that another screen's capture is not matched.
    const matches = (one) => one.key === key || (one.reloaded && one.visit === visit && one.slot === slot);
    const shot = shotById(id) ?? get().shots.find((one) => !one.id && !one.over && matches(one));
    if (!shot || shot.over) return;
    // The progress bar never moves backwards.
    const stage = { name, fraction: Math.max(shot.stage.fraction, fraction ?? 0), left: left ?? 0 };
    updateShot(shot.key, { id, stage, quick: url ?? shot.quick });
  },

  /**
   * Verdict on the raw frame, sent while the eye is still in front of the camera; sent again if the reconstruction
   * changes it.
   */
  verdict({ id, ...verdict }) {
    const shot = shotById(id);
    if (!shot || shot.over) return;
    updateShot(shot.key, { verdict: Object.freeze(verdict) });
    if (shot.verdict?.word === verdict.word) return;
    buttonsChanged();
    playCue(verdict.word === "again" ? "poor" : "good");
  },

  kept(capture) {
    const shot =
      shotById(capture.id) ?? get().shots.find(({ id, over, visit, slot }) => !id && !over && visit === capture.visit && slot === capture.slot);
    if (shot) completeShot(capture, shot.key);
    else if (capture.visit && capture.visit === get().visit?.id) refreshVisit(capture.visit);
  },

  /** The page that pressed gets the error as the answer to its request; a reloaded page gets it from this event. */
  failed({ id, code, message, remedy }) {
    const shot = shotById(id);
    if (shot?.reloaded && !shot.over) updateShot(shot.key, { over: true, failed: { code, message, remedy } });
  },
};

/** Show an earlier picture (after a reload or from a tile); without one, go to aiming. */
export async function openPicture(route) {
  if (currentShot(get())) return;
  const { visit } = get();
  const slot = visit?.slots[route.slot];
  const id = route.capture ?? slot?.capture ?? slot?.captures?.at(-1);
  if (id) {
    const capture = await alertOnError(() => getCapture(id));
    if (capture && capture.visit !== route.visit) rejectForeignCapture(route, capture);
    else if (capture) setShots([...get().shots, shotFrom(capture, route)]);
  } else if (["making", "busy"].includes(get().activity)) {
    const eye = eyeOf(get(), route.slot);
    const shot = { key: newIdempotencyKey(), ...route, eye, id: null, stage: FIRST_STAGE, verdict: null, reloaded: true };
    setShots([...get().shots, Object.freeze(shot)]);
  } else {
    navigate({ screen: "aim", visit: route.visit, slot: route.slot }, { replace: true });
  }
}

/** Go to the patient and show an error: the address names a picture that does not belong to this visit. */
export function rejectForeignCapture({ visit }, { test }) {
  navigate({ screen: "patient", visit }, { replace: true });
  raiseAlert({ code: "capture.elsewhere", message: t(test ? "fault.test" : "fault.elsewhere"), remedy: "", from: "press" });
}

function shotFrom(capture, { visit, slot }) {
  finishedIds.add(capture.id);
  const { id, eye } = capture;
  return Object.freeze({ key: id, visit, slot, eye, id, stage: FIRST_STAGE, verdict: capture.verdict ?? null, capture, over: true });
}

/** Reset the image tools for another picture. */
export function resetPictureTools() {
  set({ ...PICTURE_DEFAULTS, zoom: 1, note: "" });
}
