// Everything that crosses the network: plain JSON, the event stream, and the preview.
// Works on plain http: no service worker, no crypto.randomUUID, no web locks (knowledge/page.md 3.4).

import { t } from "./words.js";

/** The instrument's own words about why something was not done. */
export class Refusal extends Error {
  constructor({ code, message, remedy, ...vars }) {
    super(message);
    this.code = code;
    this.remedy = remedy;
    this.vars = vars; // numbers that the words may need, such as minutes to wait
  }
}

async function json(path, options) {
  let answer;
  try {
    answer = await fetch(path, { cache: "no-store", ...options });
  } catch {
    throw new Refusal({ code: "link.cut", message: t("link.cut"), remedy: t("link.cut.remedy") });
  }
  const body = await answer.json().catch(() => null);
  if (answer.ok && body) return body;
  if (body?.message) throw new Refusal(body);
  throw new Refusal({ code: `http.${answer.status}`, message: t("fault.unknown"), remedy: t("fault.unknown.remedy") });
}

export const getStatus = () => json("/api/status");
export const getProtocol = () => json("/api/protocol");
export const getVisit = (id) => json(`/api/visits/${encodeURIComponent(id)}`);
export const getVisits = (query) => json(`/api/visits?${new URLSearchParams(query)}`);
export const getCapture = (id) => json(`/api/captures/${encodeURIComponent(id)}`);
export const getOutbox = () => json("/api/outbox");
export const getFolders = async () => (await json("/api/exports")).folders;
export const fileOf = (capture, name) => `/api/captures/${encodeURIComponent(capture)}/${name}`;
export const zipOf = (visit) => `/api/visits/${encodeURIComponent(visit)}/export.zip`;

/** Send a change. The key makes a request that the network doubles, or that we repeat after a lost link, happen once. */
export function send(method, path, { key = freshKey(), ...body } = {}) {
  return json(path, {
    method,
    headers: { "Content-Type": "application/json", "X-Controller": controllerKey() },
    body: JSON.stringify({ ...body, key }),
  });
}

/** Ask for the controls of the instrument, which one page holds at a time; `take` takes them from another page. */
export const askForControls = (take) =>
  send("POST", "/api/controller", take ? { key: controllerKey(), take } : { key: controllerKey() });

/** Tell that this page closes; a browser sends this even when the page is gone. */
export const letControlsGo = () =>
  navigator.sendBeacon?.(
    "/api/controller",
    new Blob([JSON.stringify({ key: controllerKey(), release: true })], { type: "application/json" }),
  );

// Sixteen hex digits; crypto.randomUUID does not exist on plain http.
export function freshKey() {
  return Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

let ownKey = null;

// The tab's own name towards the instrument: a reload keeps it, another tab has another.
function controllerKey() {
  if (ownKey) return ownKey;
  try {
    ownKey = sessionStorage.getItem("diffuscope.controller") ?? freshKey();
    sessionStorage.setItem("diffuscope.controller", ownKey);
  } catch {
    ownKey = freshKey();
  }
  return ownKey;
}

/** The next preview frame for an eye of a visit after number `after`, or null when none came; a Refusal when there is no light. */
export async function getPreview(after, eye, visit, signal) {
  const headers = { "X-Controller": controllerKey() }; // the lamp shines for no stranger
  const query = new URLSearchParams({ after, eye, visit });
  const answer = await fetch(`/api/preview?${query}`, { cache: "no-store", headers, signal });
  if (answer.status === 204) return null;
  if (!answer.ok) throw new Refusal((await answer.json().catch(() => null)) ?? { code: `http.${answer.status}` });
  return {
    number: Number(answer.headers.get("X-Frame")),
    ageMs: Number(answer.headers.get("X-Age-Ms")),
    aim: aimFrom(answer.headers.get("X-Aim")),
    bitmap: await createImageBitmap(await answer.blob()),
  };
}

function aimFrom(header) {
  try {
    return header ? JSON.parse(header) : null;
  } catch {
    return null; // a frame is a frame, whatever somebody wrote beside it
  }
}

export async function getBitmap(url, signal) {
  const answer = await fetch(url, { signal });
  if (!answer.ok) throw new Error(`picture ${answer.status}`);
  return createImageBitmap(await answer.blob());
}

const SILENCE_MS = 3500; // the server's heart beats every second; three missed beats are a lost link
const RETRY_MS = 2500; // a half-open connection can look alive for minutes, so we open a fresh one
const EVENTS = ["beat", "state", "stage", "verdict", "kept", "failed", "aim", "notice"];

/**
 * One event stream per visible page: six open ones freeze the whole origin, so a hidden page closes its own.
 * Calls `on[type](data)` for each event, and `on.link("live" | "lost")` when data begins or stops to arrive;
 * freshness is judged by data alone, because navigator.onLine knows nothing about this device.
 */
export class EventLine {
  #on;
  #source = null;
  #heardAt = 0;
  #openedAt = 0;
  #link = "opening";

  constructor(on) {
    this.#on = on;
    document.addEventListener("visibilitychange", () => this.#wake());
    addEventListener("pagehide", () => this.#close());
    addEventListener("pageshow", (event) => event.persisted && this.#wake());
    setInterval(() => this.#look(), 250);
    this.#wake();
  }

  #wake() {
    if (document.hidden) return this.#close();
    this.#heardAt = performance.now(); // a page that comes back gets its three seconds before it complains
    return this.#open();
  }

  #open() {
    this.#close();
    this.#openedAt = performance.now();
    this.#source = new EventSource("/api/events");
    for (const type of EVENTS) {
      this.#source.addEventListener(type, (event) => {
        this.#heardAt = performance.now();
        this.#say("live");
        this.#on[type]?.(event.data ? JSON.parse(event.data) : {});
      });
    }
  }

  #close() {
    this.#source?.close();
    this.#source = null;
  }

  #look() {
    if (!this.#source) return;
    const now = performance.now();
    if (now - this.#heardAt < SILENCE_MS) return;
    this.#say("lost");
    const patience = this.#source.readyState === EventSource.CLOSED ? RETRY_MS / 2 : RETRY_MS;
    if (now - this.#openedAt > patience) this.#open();
  }

  #say(link) {
    if (link === this.#link) return;
    this.#link = link;
    this.#on.link(link);
  }
}
