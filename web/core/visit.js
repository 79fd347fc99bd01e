// Changes of a visit: begin, form fields, next slot, finish, reopen. Each change is sent at once.

import { today } from "../i18n/translate.js";
import { newIdempotencyKey, getChanges, getMontage, getUploadQueue, getVisit, getVisits, ApiError, send } from "./api.js";
import { eyeOf, get, lostCaptures, missingPictures, otherEyeSlot, moveCapture, set, pendingCaptures } from "./state.js";
import { navigate } from "./router.js";
import { lowerAlert, raiseAlert, raiseRefusal } from "./alerts.js";

/** Run a request; on an error of the server raise an alert and return undefined. */
export async function alertOnError(task) {
  try {
    return await task();
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    raiseRefusal(problem);
    return undefined;
  }
}

const visitUrl = (visit, what) => `/api/visits/${encodeURIComponent(visit)}${what ? `/${what}` : ""}`;

let changesAnswered = 0;
const newestReads = new Map(); // of each visit

const storeVisit = (visit) => {
  if (get().route.visit === visit.id) set({ visit: withUnsaved(Object.freeze(visit)) });
  return visit;
};

/** Store the visit that the server returned after a change. */
const storeChanged = (visit) => {
  changesAnswered += 1;
  return storeVisit(visit);
};

/**
 * Reload a visit. What the server read before a change that was answered meanwhile is out of date and is read again;
 * of several readings at the same time only the last one counts.
 */
export const refreshVisit = (id) =>
  alertOnError(async () => {
    const read = {};
    newestReads.set(id, read);
    for (;;) {
      const before = changesAnswered;
      const visit = await getVisit(id);
      if (newestReads.get(id) !== read) return visit;
      if (before === changesAnswered) return storeVisit(visit);
    }
  });

const MONTAGE_POLL_MS = 2000; // a montage takes some seconds, and waits while the camera is used
let montagePoll = 0;

/** Load the montage of each eye of the visit on the pictures screen; ask again while one is being computed. */
export async function refreshMontages(visit) {
  const isShown = () => get().route.screen === "pictures" && get().route.visit === visit;
  const eyes = [...new Set((get().programme?.slots ?? []).map(({ eye }) => eye))];
  const answers = await Promise.all(eyes.map(async (eye) => [eye, await alertOnError(() => getMontage(visit, eye))]));
  if (!isShown()) return;
  set({ montages: Object.freeze(Object.fromEntries(answers.filter(([, answer]) => answer))) });
  const waits = answers.some(([, answer]) => answer?.state === "computing");
  clearTimeout(montagePoll);
  if (waits) montagePoll = setTimeout(() => isShown() && refreshMontages(visit), MONTAGE_POLL_MS);
}

let newestQuery = {};

/** Load the visits that match the query, and the counts of the day; return them. An answer to an earlier query is not shown. */
export async function refreshList(query) {
  const screen = get().route.screen;
  newestQuery = query;
  const result = await alertOnError(() => getVisits(query));
  if (result && get().route.screen === screen && query === newestQuery) set({ visits: result.visits, counts: result.counts });
  return result;
}

/** Load the counts of today, and the newest unfinished visit of any day: that of yesterday is continued, too. */
export async function refreshHome() {
  const query = { day: today(), limit: "1" };
  newestQuery = query;
  const found = await alertOnError(() => Promise.all([getVisits(query), getVisits({ open: "true", limit: "1" })]));
  if (!found || get().route.screen !== "home" || query !== newestQuery) return;
  const [{ counts }, { visits }] = found;
  set({ visits, counts });
}

/** Begin a visit with this number, or with an automatic one. */
export async function begin(number) {
  const visit = await alertOnError(() => send("POST", "/api/visits", number ? { number } : {}));
  if (!visit) return;
  set({ visit: Object.freeze(visit) });
  navigate({ screen: "patient", visit: visit.id });
}

/** Continue a visit on the screen of its next step. */
export function resume(visit) {
  set({ visit: Object.freeze(visit) });
  if (visit.finished_at) navigate({ screen: "outcome", visit: visit.id });
  else if (visit.fields.consent !== "agreed" || !visit.next_slot) navigate({ screen: "patient", visit: visit.id });
  else navigate({ screen: "aim", visit: visit.id, slot: visit.next_slot });
}

// ---- form fields: optimistic update, sent at once, and repeated with the same idempotency key after a lost connection

let unsaved = []; // {visit, field, value, key}

/** Set a form field at once and send the change. */
export async function setField(field, value) {
  const { visit } = get();
  if (!visit) return;
  const change = { visit: visit.id, field, value, key: newIdempotencyKey() };
  unsaved = [...unsaved.filter((other) => other.visit !== visit.id || other.field !== field), change];
  set({ visit: withUnsaved(visit) });
  await flushUnsaved();
}

const withUnsaved = (visit) => {
  const mine = unsaved.filter((change) => change.visit === visit.id);
  const fields = Object.fromEntries(mine.map(({ field, value }) => [field, value]));
  return Object.freeze({ ...visit, fields: { ...visit.fields, ...fields }, waiting: mine.map(({ field }) => field) });
};

let flushing = null;

/** Send unsaved changes one by one, in order. */
export function flushUnsaved() {
  flushing ??= sendUnsaved().finally(() => {
    flushing = null;
  });
  return flushing;
}

async function sendUnsaved() {
  while (unsaved.length) {
    const change = unsaved[0];
    const { visit, ...body } = change;
    try {
      const result = await send("PATCH", visitUrl(visit), body);
      unsaved = unsaved.filter((other) => other !== change);
      storeChanged(result);
    } catch (problem) {
      if (!(problem instanceof ApiError)) throw problem;
      if (problem.code === "link.cut") return; // repeated when the connection is back
      unsaved = unsaved.filter((other) => other !== change);
      raiseRefusal(problem);
      await refreshVisit(visit);
    }
  }
}

// ---- slots

const change = (what, body) =>
  alertOnError(async () => storeChanged(await send("POST", visitUrl(get().route.visit, what), body)));

/** Mark a slot as "could not"; a chip offers undo for ten seconds. */
export async function notPossible(slot, reason) {
  set({ asking: "" });
  const { visit } = get();
  if (!visit) return;
  const before = visit.slots[slot].capture;
  if (!(await change("not-possible", { slot, reason }))) return;
  navigate({ screen: "aim", visit: visit.id, slot: nextSlot(slot) ?? slot });
  lowerAlert("shot.crossed");
  raiseAlert({ code: "shot.crossed", visit: visit.id, slot, eye: eyeOf(get(), slot), before, from: "page" });
}

/** Undo "could not". */
export async function undoNotPossible({ visit, slot, before }) {
  lowerAlert("shot.crossed");
  const result = await alertOnError(() => send("POST", visitUrl(visit, "slots"), { slot, capture: before }));
  if (!result) return;
  storeChanged(result);
  navigate({ screen: "aim", visit, slot });
}

/** Accept a poor picture for its slot and go to the next slot. */
export async function keepPoor(capture, slot) {
  const kept = await alertOnError(() => send("POST", `/api/captures/${encodeURIComponent(capture)}/accept`));
  if (!kept) return;
  await refreshVisit(get().route.visit);
  goToNextSlot(slot);
}

/** Select another picture of a slot. */
export const useInSlot = (slot, capture) => change("slots", { slot, capture });

/** Move a picture to the slot of the same field of the other eye. */
export async function moveToOtherEye(slot, capture) {
  const to = otherEyeSlot(get(), slot);
  if (!to) return;
  const visit = await alertOnError(() => send("POST", `/api/captures/${encodeURIComponent(capture)}/eye`, { eye: to.eye }));
  if (!visit) return;
  storeChanged(visit);
  moveCapture(capture, to);
  navigate({ screen: "picture", visit: visit.id, slot: to.id, capture });
}

/** Confirm the eye of a picture, which answers the laterality question. */
export const confirmEye = (slot, capture) =>
  alertOnError(() => send("POST", `/api/captures/${encodeURIComponent(capture)}/eye`, { eye: eyeOf(get(), slot) }));

/** Return the next empty slot after `after` in the order of the programme; null if there is none. */
export function nextSlot(after) {
  const { visit, programme } = get();
  if (!visit || !programme) return null;
  const ids = programme.slots.map(({ id }) => id);
  const order = [...ids.slice(ids.indexOf(after) + 1), ...ids.slice(0, ids.indexOf(after))];
  const making = pendingCaptures(get(), visit.id).map(({ slot }) => slot);
  const missing = order.filter((id) => id !== after && visit.slots[id]?.state === "empty" && !making.includes(id));
  return missing[0] ?? null;
}

/** Go to the next empty slot; without one, finish the visit. */
export function goToNextSlot(after) {
  const slot = nextSlot(after);
  if (slot) navigate({ screen: "aim", visit: get().route.visit, slot });
  else finish();
}

// ---- upload queue

export async function refreshUploadQueue() {
  const uploadQueue = await alertOnError(getUploadQueue);
  if (uploadQueue) set({ uploadQueue });
}

/** Retry the uploads of one visit, or of all, at once. */
export async function retryUploads(visit) {
  const uploadQueue = await alertOnError(() => send("POST", "/api/upload-queue/retry", visit ? { visit } : {}));
  if (uploadQueue) set({ uploadQueue });
}

// ---- finishing

/**
 * Finish the visit; ask first when a picture is missing, but not a patient who did not agree. While a capture is in
 * progress, show its progress and finish afterwards.
 */
export async function finish({ isSure = false } = {}) {
  const { visit } = get().route;
  if (!visit || !get().programme || get().visit?.id !== visit) return; // still loading: what is missing is not known yet
  if (!isSure && missingPictures(get()) && get().visit?.fields.consent !== "declined") return set({ asking: "finish" });
  lowerAlert("shot.crossed"); // undo would need a reopened visit
  if (pendingCaptures(get(), visit).length) {
    navigate({ screen: "outcome", visit });
    set({ finishing: visit });
    return;
  }
  if (await change("finish")) navigate({ screen: "outcome", visit });
}

/** Finish a waiting visit after its last capture; if a capture was lost, go to its slot instead. */
export function finishWhenComplete() {
  const { finishing, route, visit } = get();
  if (!finishing || visit?.id !== finishing || pendingCaptures(get(), finishing).length) return;
  set({ finishing: null });
  if (route.visit !== finishing || route.screen !== "outcome") return;
  const [lost] = lostCaptures(get());
  if (lost) navigate({ screen: "aim", visit: finishing, slot: lost.slot }, { replace: true });
  else finish({ isSure: true });
}

/** Load the changes of the visit that is shown. */
export async function loadChanges() {
  const id = get().route.visit;
  const answer = await alertOnError(() => getChanges(id));
  if (answer && get().route.visit === id) set({ changes: Object.freeze(answer.changes) });
}

/** Reopen the finished visit; `reason` is one of the server's. */
export async function reopen(reason) {
  const visit = await change("reopen", { reason });
  if (visit) resume(visit);
}

/** Copy the visit to a USB drive; `id` is the drive's in the server's list. */
export async function copyTo({ id: folder, name }) {
  const done = await alertOnError(() => send("POST", visitUrl(get().route.visit, "export"), { folder }));
  if (done) set({ copied: name });
}

/** Return the content of the QR code: number, date, outcome, telephone of the centre. Never a picture, name or age. */
export function qrText({ number, finished_at: end, begun_at: begin, outcome }, programme) {
  const day = (end ?? begin).slice(0, 10);
  return [number, day, outcome.code, programme?.referral?.centre_phone].filter(Boolean).join("\n");
}
