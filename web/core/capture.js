// Captures from press to kept picture: requests, progress events, verdicts and lost answers.
// A capture: {key, visit, slot, eye, id, stage, verdict, quick, record, over}; `key` is the idempotency key, `id` the
// server's, `record` what the server stored.

import { newIdempotencyKey, getCapture, ApiError, send } from "./api.js";
import { allowsLight, eyeOf, PICTURE_DEFAULTS, get, set, currentCapture } from "./state.js";
import { navigate } from "./router.js";
import { buttonsChanged, isUnseen } from "./taps.js";
import { lowerAlerts, raiseAlert, raiseRefusal, visibleAlerts } from "./alerts.js";
import { alertOnError, refreshVisit } from "./visit.js";
import { t } from "../i18n/translate.js";

const CAPTURES_MAX = 12;
const FIRST_STAGE = Object.freeze({ name: "expose", fraction: 0, left: 0 });

const finishedIds = new Set(); // finished captures; their late events are ignored

const VIBRATIONS = { ready: 15, taken: 30, good: 15, poor: [30, 60, 30] };

/** Play a tone and vibrate, after the first touch of the page: browsers refuse both before it. */
export function playCue(name) {
  if (!navigator.userActivation?.hasBeenActive) return;
  navigator.vibrate?.(VIBRATIONS[name]);
  if (get().sound) import("./sound.js").then(({ play }) => play(name), () => {}); // without a connection there is no tone; the text is shown
}

const setCaptures = (captures) => set({ captures: Object.freeze(captures.slice(-CAPTURES_MAX)) });
const updateCapture = (key, patch) =>
  setCaptures(get().captures.map((capture) => (capture.key === key ? Object.freeze({ ...capture, ...patch }) : capture)));
const captureById = (id) => get().captures.find((capture) => capture.id === id);

/** Take a picture of the current slot, unless an alert or a missing consent blocks it. */
export function takePicture() {
  const { route } = get();
  if (route.screen === "picture") showPendingNote();
  if (route.screen !== "aim" || !allowsLight(get()) || isUnseen()) return;
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
  for (const { id, over } of get().captures) if (id && over) finishedIds.add(id);
  lowerAlerts(({ from }) => from === "press");
  setCaptures([...get().captures, Object.freeze({ key, visit, slot, eye, id: null, stage: FIRST_STAGE, verdict: null, over: false })]);
  set({ goesOnFrom: get().auto ? null : key });
  navigate({ screen: "picture", visit, slot });
  playCue("taken");
  try {
    completeCapture(await send("POST", "/api/captures", { eye, key, visit, slot }), key);
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    failCapture(key, problem);
  }
}

// A failed capture that the server had begun is reported, because a good verdict may have been shown.
function failCapture(key, problem) {
  const { code, message, remedy } = problem;
  const capture = get().captures.find((candidate) => candidate.key === key);
  if (!capture || capture.over) return;
  const here = currentCapture(get())?.key === key;
  if (capture.id && code === "link.cut") {
    updateCapture(key, { answerLost: true }); // perhaps the server kept it; queried when the connection is back
  } else {
    if (capture.id) updateCapture(key, { over: true, failed: { code, message, remedy } });
    else setCaptures(get().captures.filter((other) => other.key !== key));
    if (here) navigate({ screen: "aim", visit: capture.visit, slot: capture.slot }, { replace: true });
  }
  if (here || !capture.id) raiseRefusal(problem); // on other screens the chip of the lost picture is shown
  refreshVisit(capture.visit);
}

/** After a reconnection, fetch the result of each capture whose answer was lost. */
export async function resolveCutCaptures() {
  for (const { id, key, answerLost, over } of get().captures) {
    if (!id || !answerLost || over) continue;
    try {
      completeCapture(await getCapture(id), key);
    } catch (problem) {
      if (!(problem instanceof ApiError)) throw problem;
      const pending = problem.code === "link.cut" || ["making", "busy"].includes(get().activity);
      if (!pending) failCapture(key, { ...problem, message: t("lost"), remedy: t("lost.remedy") });
    }
  }
}

function completeCapture(record, key = captureById(record.id)?.key) {
  finishedIds.add(record.id);
  const capture = get().captures.find((candidate) => candidate.key === key);
  if (!capture || capture.record) return;
  const verdict = record.verdict ?? capture.verdict;
  if (verdict?.word !== "good" || capture.verdict?.word !== "good") buttonsChanged();
  updateCapture(key, { id: record.id, record: Object.freeze(record), verdict, over: true, stage: { ...capture.stage, fraction: 1 } });
  updateSlot(capture, record.id, verdict);
  refreshVisit(capture.visit);
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
    const matches = (candidate) => candidate.key === key || (candidate.reloaded && candidate.visit === visit && candidate.slot === slot);
    const capture = captureById(id) ?? get().captures.find((candidate) => !candidate.id && !candidate.over && matches(candidate));
    if (!capture || capture.over) return;
    // The progress bar never moves backwards.
    const stage = { name, fraction: Math.max(capture.stage.fraction, fraction ?? 0), left: left ?? 0 };
    updateCapture(capture.key, { id, stage, quick: url ?? capture.quick });
  },

  /**
   * Verdict on the raw frame, sent while the eye is still in front of the camera; sent again if the reconstruction
   * changes it.
   */
  verdict({ id, ...verdict }) {
    const capture = captureById(id);
    if (!capture || capture.over) return;
    updateCapture(capture.key, { verdict: Object.freeze(verdict) });
    if (capture.verdict?.word === verdict.word) return;
    buttonsChanged();
    playCue(verdict.word === "again" ? "poor" : "good");
  },

  kept(record) {
    const capture =
      captureById(record.id) ?? get().captures.find(({ id, over, visit, slot }) => !id && !over && visit === record.visit && slot === record.slot);
    if (capture) completeCapture(record, capture.key);
    else if (record.visit && record.visit === get().visit?.id) refreshVisit(record.visit);
  },

  /** The page that pressed gets the error as the answer to its request; a reloaded page gets it from this event. */
  failed({ id, code, message, remedy }) {
    const capture = captureById(id);
    if (capture?.reloaded && !capture.over) updateCapture(capture.key, { over: true, failed: { code, message, remedy } });
  },
};

/** Show an earlier picture (after a reload or from a tile); without one, go to aiming. */
export async function openPicture(route) {
  if (currentCapture(get())) return;
  const { visit } = get();
  const slot = visit?.slots[route.slot];
  const id = route.capture ?? slot?.capture ?? slot?.captures?.at(-1);
  if (id) {
    const record = await alertOnError(() => getCapture(id));
    if (record && record.visit !== route.visit) rejectForeignCapture(route, record);
    else if (record) setCaptures([...get().captures, captureFrom(record, route)]);
  } else if (["making", "busy"].includes(get().activity)) {
    const eye = eyeOf(get(), route.slot);
    const capture = { key: newIdempotencyKey(), ...route, eye, id: null, stage: FIRST_STAGE, verdict: null, reloaded: true };
    setCaptures([...get().captures, Object.freeze(capture)]);
  } else {
    navigate({ screen: "aim", visit: route.visit, slot: route.slot }, { replace: true });
  }
}

/** Go to the patient and show an error: the address names a picture that does not belong to this visit. */
export function rejectForeignCapture({ visit }, { test }) {
  navigate({ screen: "patient", visit }, { replace: true });
  raiseAlert({ code: "capture.elsewhere", message: t(test ? "fault.test" : "fault.elsewhere"), remedy: "", from: "press" });
}

function captureFrom(record, { visit, slot }) {
  finishedIds.add(record.id);
  const { id, eye } = record;
  return Object.freeze({ key: id, visit, slot, eye, id, stage: FIRST_STAGE, verdict: record.verdict ?? null, record, over: true });
}

/** Reset the image tools for another picture. */
export function resetPictureTools() {
  set({ ...PICTURE_DEFAULTS, zoom: 1, note: "" });
}
