// A person's visit: begin, fill in, go on to the next missing picture, finish, take back. Every change is sent as it is made.

import { freshKey, getOutbox, getVisit, getVisits, Refusal, send } from "./api.js";
import { eyeOf, get, lostShots, moveShot, set, underway } from "./memory.js";
import { go } from "./routes.js";
import { lower, raise } from "./states.js";

/** Do something that the instrument may refuse, and tell the refusal in its words; undefined then. */
export async function politely(work) {
  try {
    return await work();
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    const { code, message, remedy, vars } = problem;
    raise({ code, message, remedy, ...vars, from: "press" });
    return undefined;
  }
}

const at = (visit, what) => `/api/visits/${encodeURIComponent(visit)}${what ? `/${what}` : ""}`;

function take(visit) {
  if (visit && get().route.visit === visit.id) set({ visit: withUnsaved(Object.freeze(visit)) });
  return visit;
}

/** Load a visit anew; the page's picture of it is never older than the last event. */
export const refreshVisit = (id) => politely(async () => take(await getVisit(id)));

export async function refreshList(query) {
  const screen = get().route.screen;
  const answer = await politely(() => getVisits(query));
  if (answer && get().route.screen === screen) set({ visits: answer.visits, counts: answer.counts });
}

export async function begin(number) {
  const visit = await politely(() => send("POST", "/api/visits", number ? { number } : {}));
  if (!visit) return;
  set({ visit: Object.freeze(visit) });
  go({ screen: "person", visit: visit.id });
}

/** Where a visit that was left goes on. */
export function resume(visit) {
  set({ visit: Object.freeze(visit) });
  if (visit.finished_at) go({ screen: "outcome", visit: visit.id });
  else if (visit.fields.consent !== "agreed" || !visit.next_slot) go({ screen: "person", visit: visit.id });
  else go({ screen: "aim", visit: visit.id, slot: visit.next_slot });
}

// ---- fields: shown at once, sent at once, and sent again with the same key when the link was away

let unsaved = []; // {visit, field, value, key}

export async function setField(field, value) {
  const { visit } = get();
  const change = { visit: visit.id, field, value, key: freshKey() };
  unsaved = [...unsaved.filter((other) => other.visit !== visit.id || other.field !== field), change];
  set({ visit: withUnsaved(visit) });
  await saveRest();
}

const withUnsaved = (visit) => {
  const mine = unsaved.filter((change) => change.visit === visit.id);
  const fields = Object.fromEntries(mine.map(({ field, value }) => [field, value]));
  return Object.freeze({ ...visit, fields: { ...visit.fields, ...fields }, waiting: mine.map(({ field }) => field) });
};

let saving = null;

/** Send what is not saved yet, one change after the other, in the order in which they were made. */
export function saveRest() {
  saving ??= drain().finally(() => {
    saving = null;
  });
  return saving;
}

async function drain() {
  while (unsaved.length) {
    const change = unsaved[0];
    const { visit, ...body } = change;
    try {
      const answer = await send("PATCH", at(visit), body);
      unsaved = unsaved.filter((other) => other !== change);
      take(answer);
    } catch (problem) {
      if (!(problem instanceof Refusal)) throw problem;
      if (problem.code === "link.cut") return; // sent again when the link is back
      unsaved = unsaved.filter((other) => other !== change);
      raise({ code: problem.code, message: problem.message, remedy: problem.remedy, from: "press" });
      await refreshVisit(visit);
    }
  }
}

// ---- slots

const change = (what, body) =>
  politely(async () => take(await send("POST", at(get().route.visit, what), body)));

/** It could not be taken; for ten seconds a chip offers to take that back. */
export async function couldNot(slot, reason) {
  set({ asking: false });
  const { visit, protocol } = get();
  const before = visit.slots[slot].capture;
  if (!(await change("could-not", { slot, reason }))) return;
  go({ screen: "aim", visit: visit.id, slot: nextSlot(slot) ?? slot });
  const { eye } = protocol.slots.find(({ id }) => id === slot);
  lower("shot.crossed");
  raise({ code: "shot.crossed", visit: visit.id, slot, eye, before, from: "page" });
}

/** It could be taken after all. */
export async function uncross({ visit, slot, before }) {
  lower("shot.crossed");
  const answer = await politely(() => send("POST", at(visit, "slots"), { slot, capture: before }));
  if (!answer) return;
  take(answer);
  go({ screen: "aim", visit, slot });
}

export async function keepPoor(capture, slot) {
  const kept = await politely(() => send("POST", `/api/captures/${encodeURIComponent(capture)}/keep`));
  if (!kept) return;
  await refreshVisit(get().route.visit);
  goOn(slot);
}

export const useInSlot = (slot, capture) => change("slots", { slot, capture });

/** The picture was of the other eye: it goes into that eye's slot of the same field. */
export async function moveToOtherEye(slot, capture) {
  const { protocol } = get();
  const from = protocol.slots.find(({ id }) => id === slot);
  const to = protocol.slots.find(({ eye, field }) => field === from.field && eye !== from.eye);
  if (!to) return;
  const visit = await politely(() => send("POST", `/api/captures/${encodeURIComponent(capture)}/eye`, { eye: to.eye }));
  if (!visit) return;
  take(visit);
  moveShot(capture, to);
  go({ screen: "picture", visit: visit.id, slot: to.id, capture });
}

/** The picture is of the eye that it was taken for: nobody asks again. */
export const sayEyeIsRight = (slot, capture) =>
  politely(() => send("POST", `/api/captures/${encodeURIComponent(capture)}/eye`, { eye: eyeOf(get(), slot) }));

/** The next slot without a picture, after this one in the order of the programme; null when every one is answered. */
export function nextSlot(after) {
  const { visit, protocol } = get();
  if (!visit || !protocol) return null;
  const ids = protocol.slots.map(({ id }) => id);
  const order = [...ids.slice(ids.indexOf(after) + 1), ...ids.slice(0, ids.indexOf(after))];
  const making = underway(get(), visit.id).map(({ slot }) => slot);
  const missing = order.filter((id) => id !== after && visit.slots[id]?.state === "empty" && !making.includes(id));
  return missing[0] ?? null;
}

/** Go to the next missing picture; with none missing, finish. */
export function goOn(after) {
  const slot = nextSlot(after);
  if (slot) go({ screen: "aim", visit: get().route.visit, slot });
  else finish();
}

// ---- sending

export async function refreshOutbox() {
  const outbox = await politely(getOutbox);
  if (outbox) set({ outbox });
}

/** What kept one visit (none: any of them) from being sent is mended, somebody says. */
export async function trySending(visit) {
  const outbox = await politely(() => send("POST", "/api/outbox/try", visit ? { visit } : {}));
  if (outbox) set({ outbox });
}

// ---- the end

/** Finish; while a picture of this visit is still being made, that is shown, and then it goes on by itself. */
export async function finish() {
  const { visit } = get().route;
  lower("shot.crossed"); // what is finished is opened again first
  if (underway(get(), visit).length) {
    go({ screen: "outcome", visit });
    set({ finishing: visit });
    return;
  }
  if (await change("finish")) go({ screen: "outcome", visit });
}

/** The last picture of a visit that is to be finished is there, or is lost: then it is asked for instead. */
export function finishWhenMade() {
  const { finishing, route, visit } = get();
  if (!finishing || visit?.id !== finishing || underway(get(), finishing).length) return;
  set({ finishing: null });
  if (route.visit !== finishing || route.screen !== "outcome") return;
  const [lost] = lostShots(get());
  if (lost) go({ screen: "aim", visit: finishing, slot: lost.slot }, { replace: true });
  else finish();
}

export async function reopen() {
  const visit = await change("reopen");
  if (visit) resume(visit);
}

/** Copy the visit to a USB stick; `folder` is the stick's `id` among those that the instrument listed. */
export async function copyTo({ id: folder, name }) {
  const done = await politely(() => send("POST", at(get().route.visit, "export"), { folder }));
  if (done) set({ copied: name });
}
