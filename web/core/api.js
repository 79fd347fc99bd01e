// API client: JSON requests, event stream (server-sent events) and preview frames. Restricted to interfaces that work
// without HTTPS: no service worker, no crypto.randomUUID, no web locks.

import { askIfRequired } from "./login.js";
import { t } from "../i18n/translate.js";

/** Error answer of the server: code, message and remedy; "link.cut" when no answer came. */
export class ApiError extends Error {
  /** @param {{code: string, message?: string, remedy?: string, [more: string]: any}} answer */
  constructor({ code, message, remedy, ...vars }) {
    super(message);
    this.code = code;
    this.remedy = remedy;
    this.vars = vars; // values for the translated text, such as minutes to wait
  }
}

/**
 * Return message and remedy of an error as sentences; the message of the server is a clause without a full stop.
 * @param {{message: string, remedy?: string}} error
 */
export function sentences({ message, remedy }) {
  const first = message.charAt(0).toUpperCase() + message.slice(1);
  return `${/[.!?।]$/.test(first) ? first : `${first}.`} ${remedy ?? ""}`.trim();
}

const RETRY_MS = [300, 1200]; // a reading request that got no answer is repeated after these times

async function answerTo(path, options, waits) {
  try {
    return await fetch(path, { cache: "no-store", ...options });
  } catch (problem) {
    const [wait, ...rest] = waits;
    if (wait === undefined) throw problem;
    await new Promise((resolve) => setTimeout(resolve, wait));
    return answerTo(path, options, rest);
  }
}

/**
 * @param {string} path
 * @param {RequestInit} [options]
 */
async function requestJson(path, options = {}) {
  let response;
  try {
    response = await answerTo(path, options, options.method ? [] : RETRY_MS);
  } catch {
    throw new ApiError({ code: "link.cut", message: t("link.cut"), remedy: t("link.cut.remedy") });
  }
  const body = await response.json().catch(() => null);
  if (response.ok && body) return body;
  if (body?.message) {
    askIfRequired(body);
    throw new ApiError(body);
  }
  throw new ApiError({ code: `http.${response.status}`, message: t("fault.unknown"), remedy: t("fault.unknown.remedy") });
}

export const getStatus = () => requestJson("/api/status");
export const getProgramme = () => requestJson("/api/programme");
export const getVisit = (id) => requestJson(`/api/visits/${encodeURIComponent(id)}`);
export const getChanges = (id) => requestJson(`/api/visits/${encodeURIComponent(id)}/changes`);
const montageUrl = (visit, eye) => `/api/visits/${encodeURIComponent(visit)}/montage/${encodeURIComponent(eye)}`;
export const getMontage = (visit, eye) => requestJson(montageUrl(visit, eye));
export const montagePictureUrl = (visit, eye, digest) => `${montageUrl(visit, eye)}/picture.png?${digest}`;
export const getVisits = (query) => requestJson(`/api/visits?${new URLSearchParams(query)}`);
export const getCapture = (id) => requestJson(`/api/captures/${encodeURIComponent(id)}`);
export const getUploadQueue = () => requestJson("/api/upload-queue");
export const getFolders = async () => (await requestJson("/api/exports")).folders;

/** Return the error code of a file of a capture, "" without one. */
export const fileErrorCode = async (url) =>
  (await fetch(url, { cache: "no-store" }).then((answer) => answer.json()).catch(() => null))?.code ?? "";

export const captureFileUrl = (capture, name) => `/api/captures/${encodeURIComponent(capture)}/${name}`;
export const visitZipUrl = (visit) => `/api/visits/${encodeURIComponent(visit)}/export.zip`;

/**
 * Send a change with an idempotency key, so that a duplicated or repeated request has one effect.
 * @param {string} method
 * @param {string} path
 * @param {Record<string, any>} [body]
 */
export function send(method, path, { key = newIdempotencyKey(), ...body } = {}) {
  return requestJson(path, {
    method,
    headers: { "Content-Type": "application/json", "X-Controller": controllerKey() },
    body: JSON.stringify({ ...body, key }),
  });
}

/** Set the clock of the device to that of this screen; `how` "/back": backwards or once more, as an administrator. */
export const acceptTime = (how = "") => send("POST", `/api/clock${how}`, { now: new Date().toISOString() });

/** Request or renew the control lease, which one page holds at a time; `take` takes it from another page. */
export const requestControl = (take) => send("POST", "/api/controller", { key: controllerKey(), ...(take && { take }) });

/** Release the control lease when the page closes; a beacon is sent even after the page is gone. */
export const releaseControl = () =>
  navigator.sendBeacon?.(
    "/api/controller",
    new Blob([JSON.stringify({ key: controllerKey(), release: true })], { type: "application/json" }),
  );

// Return a random idempotency key of 16 hex digits; crypto.randomUUID needs HTTPS.
export function newIdempotencyKey() {
  return Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

let cachedKey = null;

// Return the key of this browser tab for the control lease: kept on a reload, different in each tab.
function controllerKey() {
  if (cachedKey) return cachedKey;
  try {
    cachedKey = sessionStorage.getItem("diffuscope.controller") ?? newIdempotencyKey();
    sessionStorage.setItem("diffuscope.controller", cachedKey);
  } catch {
    cachedKey = newIdempotencyKey();
  }
  return cachedKey;
}

/** Fetch the first preview frame after number `after`; null when none came. ApiError when light is not allowed. */
export async function getPreview(after, eye, visit, signal) {
  const headers = { "X-Controller": controllerKey() }; // the server switches the lamp on only for the page with the lease
  const query = new URLSearchParams({ after, eye, visit });
  const response = await fetch(`/api/preview?${query}`, { cache: "no-store", headers, signal });
  if (response.status === 204) return null;
  if (!response.ok) {
    const answer = (await response.json().catch(() => null)) ?? { code: `http.${response.status}` };
    askIfRequired(answer);
    throw new ApiError(answer);
  }
  return {
    number: Number(response.headers.get("X-Frame")),
    ageMs: Number(response.headers.get("X-Age-Ms")),
    aim: parseAim(response.headers.get("X-Aim")),
    bitmap: await createImageBitmap(await response.blob()),
  };
}

function parseAim(header) {
  try {
    return header ? JSON.parse(header) : null;
  } catch {
    return null; // an unreadable hint does not discard the frame
  }
}

/**
 * Return the URLs of the pictures of a capture: of the version with this number, or as taken for 0.
 * @param {import("./state.js").CaptureRecord} capture
 * @param {number} version
 * @returns {Record<string, string>}
 */
export const pictureLinks = ({ links, versions = [] }, version) => versions.find(({ number }) => number === version) ?? links;

/**
 * Return the URL of the picture in colour of a capture or one of its versions. Pictures as taken are shown in colour in
 * all of a visit or in none: undefined where the server names a reason against it.
 * @param {import("./state.js").CaptureRecord} capture
 * @param {number} version
 * @param {import("./state.js").Visit | null} visit
 */
export const colourLink = (capture, version, visit) =>
  visit?.no_colour && !version ? undefined : pictureLinks(capture, version).colour;

/**
 * Return the source for <eye-pic> of a capture or one of its versions: the picture in colour, or red-free the one in
 * green light. Without a picture in colour there is only the latter, and the viewer's own red-free tool.
 */
export function finalPicture(capture, redfree, visit, version = 0) {
  const { picture } = pictureLinks(capture, version);
  const colour = colourLink(capture, version, visit);
  return colour && !redfree ? { url: colour, mark: "final" } : { url: picture, mark: "final", redfree: Boolean(colour) };
}

/** Fetch a picture; TypeError where a later request may get it: no answer, or an error of the server. */
export async function getPicture(url, signal) {
  const response = await fetch(url, { signal });
  if (response.status >= 500) throw new TypeError(`picture ${response.status}`);
  if (!response.ok) throw new Error(`picture ${response.status}`);
  return response.blob();
}

const HEARTBEAT_TIMEOUT_MS = 3500; // heartbeat timeout; the server sends one event per second
const RECONNECT_MS = 2500; // a half-open connection can look connected for minutes, so the stream is reopened
const EVENTS = ["beat", "state", "stage", "verdict", "kept", "failed", "aim", "button", "notice"];

/**
 * Event stream of the visible page, with heartbeat timeout and reconnection. A hidden page closes its stream, because
 * browsers allow six connections per origin.
 * Calls `handlers[type](data, heartbeats)` for each event, with the number of heartbeats so far, and
 * `handlers.link("live" | "lost")` on a change. Only received events count: navigator.onLine does not describe the
 * connection to this device.
 */
export class EventStream {
  #handlers;
  /** @type {EventSource | null} */
  #source = null;
  #heartbeats = 0;
  #lastEventMs = 0;
  #openedMs = 0;
  #link = "opening";

  constructor(handlers) {
    this.#handlers = handlers;
    document.addEventListener("visibilitychange", () => this.#resume());
    addEventListener("pagehide", () => this.#close());
    addEventListener("pageshow", (event) => event.persisted && this.#resume());
    setInterval(() => this.#checkTimeout(), 250);
    this.#resume();
  }

  #resume() {
    if (document.hidden) return this.#close();
    this.#lastEventMs = performance.now(); // a page that becomes visible gets a full timeout
    return this.#open();
  }

  #open() {
    this.#close();
    this.#openedMs = performance.now();
    const source = new EventSource("/api/events");
    this.#source = source;
    for (const type of EVENTS) {
      source.addEventListener(type, (event) => {
        this.#lastEventMs = performance.now();
        this.#setLink("live");
        if (type === "beat") this.#heartbeats += 1;
        this.#handlers[type]?.(event.data ? JSON.parse(event.data) : {}, this.#heartbeats);
      });
    }
  }

  #close() {
    this.#source?.close();
    this.#source = null;
  }

  #checkTimeout() {
    if (!this.#source) return;
    const now = performance.now();
    if (now - this.#lastEventMs < HEARTBEAT_TIMEOUT_MS) return;
    this.#setLink("lost");
    const waitMs = this.#source.readyState === EventSource.CLOSED ? RECONNECT_MS / 2 : RECONNECT_MS;
    if (now - this.#openedMs > waitMs) this.#open();
  }

  #setLink(link) {
    if (link === this.#link) return;
    this.#link = link;
    this.#handlers.link(link);
  }
}
