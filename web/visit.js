// A person's visit: begin, fill in, go on to the next missing picture, finish, take back. Every change is sent as it is made.

import { freshKey, getVisit, getVisits, Refusal, send } from "./api.js";
import { get, set } from "./memory.js";
import { go } from "./routes.js";
import { raise } from "./states.js";

const UNDO_MS = 10_000;

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
  if (visit.outcome) go({ screen: "outcome", visit: visit.id });
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

export async function couldNot(slot, reason) {
  set({ asking: false });
  if (await change("could-not", { slot, reason })) goOn(slot);
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
  if (!to || !(await useInSlot(to.id, capture))) return;
  await useInSlot(slot, null);
  go({ screen: "picture", visit: get().route.visit, slot: to.id, capture });
}

/** The next slot without a picture, after this one in the order of the programme; null when every one is answered. */
export function nextSlot(after) {
  const { visit, protocol, shots } = get();
  if (!visit || !protocol) return null;
  const ids = protocol.slots.map(({ id }) => id);
  const order = [...ids.slice(ids.indexOf(after) + 1), ...ids.slice(0, ids.indexOf(after))];
  const underway = (id) => shots.some((shot) => shot.visit === visit.id && shot.slot === id && !shot.over);
  const missing = order.filter((id) => id !== after && visit.slots[id]?.state === "empty" && !underway(id));
  return missing[0] ?? null;
}

/** Go to the next missing picture; with none missing, finish. */
export function goOn(after) {
  const slot = nextSlot(after);
  if (slot) go({ screen: "aim", visit: get().route.visit, slot });
  else finish();
}

// ---- the end

export async function finish() {
  const { route } = get();
  const visit = await change("finish");
  if (!visit) return;
  set({ undoUntil: Date.now() + UNDO_MS, now: Date.now() });
  go({ screen: "outcome", visit: route.visit });
}

export async function reopen() {
  const visit = await change("reopen");
  if (!visit) return;
  set({ undoUntil: 0 });
  resume(visit);
}

export async function copyTo({ folder, name }) {
  const done = await politely(() => send("POST", at(get().route.visit, "export"), { folder }));
  if (done) set({ copied: name });
}
