// Controller of the technician page: PIN login, calibration, trial lenses. The state of a calibration is polled from the server,
// so a reload or restart loses nothing.

import { ApiError } from "../core/api.js";
import "./sensor_preview.js";
import { createStore } from "../core/store.js";
import { buttonsChanged } from "../core/taps.js";
import { render } from "../vendor/lit-html.js";
import { technicianPage } from "./calibration_wizard.js";
import { loadLanguage, t } from "../i18n/translate.js";

const POLL_MS = 700;
const ACTIVITY_MS = 30_000; // at most one activity report in this time

await loadLanguage("en", "technician/en");

const store = createStore(/** @type {Record<string, any>} */ ({
  view: "opening", // opening | door | overview | wizard | done | lenses | lens-result
  section: "calibration", // section of the overview
  cal: null, // latest calibration state of the server
  hasPin: true,
  pin: "",
  wait: 0, // lock-out: seconds until the next PIN attempt
  by: loadSetting("technician", ""),
  levels: null,
  mishap: "",
  error: null, // of the last action
  busy: false,
  lost: false,
  theme: loadSetting("theme", "dim"),
}));
const { get, set } = store;
let activityMs = 0;
let dismissed = readStorage("dismissed");
let dismissedLenses = readStorage("dismissed.lenses");

// ---- requests

async function request(path, body) {
  /** @type {RequestInit} */
  const init = { cache: "no-store", signal: AbortSignal.timeout(60_000) };
  if (body !== undefined) {
    Object.assign(init, {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
    });
  }
  let response;
  try {
    response = await fetch(path, init);
  } catch {
    throw new ApiError({ code: "link.cut", message: t("tech.lost"), remedy: "" });
  }
  const json = await response.json().catch(() => null);
  if (response.ok && json) return json;
  throw new ApiError(json?.message ? json : { code: "fault", message: t("fault.unknown"), remedy: t("fault.unknown.remedy") });
}

async function poll() {
  for (;;) {
    if (!document.hidden) await refresh();
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}

async function refresh() {
  try {
    if (get().view === "door") return set({ wait: Math.max(0, get().wait - POLL_MS / 1000) });
    if (get().view === "opening") {
      const { open } = await request("/api/technician");
      if (!open) return showLogin();
    }
    showCalibration(await request("/api/calibration"));
    set({ lost: false });
  } catch (problem) {
    if (problem.code === "technician.locked") await showLogin();
    else if (problem.code === "link.cut") set({ lost: true });
    else throw problem;
  }
  return undefined;
}

function showCalibration(cal) {
  const before = get().cal;
  const view = viewOf(cal);
  if (view !== get().view || stepOf(cal) !== stepOf(before)) buttonsChanged();
  const measuring = cal.state === "measuring" || cal.lenses?.state === "measuring";
  if (cal.stand !== before?.stand || cal.lenses?.lens !== before?.lenses?.lens || measuring) set({ error: null });
  set({ cal: Object.freeze(cal), view });
}

function viewOf({ state, made, lenses }) {
  if (lenses && lenses.state !== "done") return "lenses";
  if (state === "asking" || state === "measuring") return "wizard";
  if (lenses && lenses.ended_at !== dismissedLenses) return "lens-result";
  return made && made.id !== dismissed ? "done" : "overview";
}

const stepOf = (cal) => [cal?.state, cal?.stand, cal?.lenses?.state, cal?.lenses?.lens].join();

async function loginState() {
  const { has_pin: hasPin, wait_s: wait } = await request("/api/technician");
  return { hasPin, wait, pin: "" };
}

async function showLogin() {
  try {
    set({ view: "door", ...(await loginState()), error: null, lost: false, busy: false });
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    set({ lost: true });
  }
}

// Send one request per tap; show the server's error.
async function submit(path, body, then = showCalibration) {
  if (get().busy) return;
  set({ busy: true, error: null });
  try {
    then(await request(path, body));
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    if (problem.code === "technician.locked" && get().view !== "door") await showLogin();
    else {
      const wait = get().view === "door" ? await loginState().catch(() => null) : null; // the lock-out time is known before the next tap
      set({ ...wait, error: { code: problem.code, message: problem.message, remedy: problem.remedy } });
    }
  } finally {
    set({ busy: false });
    buttonsChanged();
  }
}

// ---- user actions

const actions = {
  digit: (digit) => set({ pin: `${get().pin}${digit}`.slice(0, 12) }),
  deleteDigit: () => set({ pin: get().pin.slice(0, -1) }),
  pinTyped: ({ target }) => set({ pin: target.value }),

  async enter(event) {
    event.preventDefault();
    const { pin, hasPin, wait } = get();
    if (wait > 0 || !pin) return;
    if (pin.length < 4) return set({ error: { code: "pin.short", message: t("pin.short"), remedy: "" } }); // keep the digits
    await submit(hasPin ? "/api/technician/unlock" : "/api/technician/pin", { pin }, () => set({ view: "opening" }));
    if (get().view === "opening") await refresh();
  },

  lock: () => submit("/api/technician/lock", {}, showLogin),
  openSection: (section) => set({ section }),

  setName({ target }) {
    saveSetting("technician", target.value);
    set({ by: target.value });
  },

  start(event) {
    event.preventDefault();
    const { by, cal } = get();
    if (!by.trim() || cal.state === "starting") return;
    const form = event.target.elements;
    const options = { by: by.trim() };
    if (form.serial.value.trim()) options.serial = form.serial.value.trim();
    if (form.source.value.trim()) options.source_deg = numberOrText(form.source.value);
    if (form.distance.value.trim()) options.source_mm = numberOrText(form.distance.value);
    submit("/api/calibration", options);
  },

  ready() {
    const { cal, mishap } = get();
    if (cal.state !== "asking") return;
    set({ mishap: "" });
    submit("/api/calibration/ready", { stand: cal.stand, ...(mishap && { mishap }) });
  },

  startLenses(event) {
    event.preventDefault();
    if (get().cal.state !== "idle") return;
    const { vertex, eye } = event.target.elements;
    const options = {};
    if (vertex.value.trim()) options.vertex_mm = numberOrText(vertex.value);
    if (eye.value.trim()) options.eye_dpt = numberOrText(eye.value);
    submit("/api/calibration/trial-lenses", options);
  },

  lensReady() {
    const { lenses } = get().cal;
    if (lenses.state === "asking") submit("/api/calibration/trial-lenses/ready", { lens: lenses.lens });
  },

  cancel: () => submit("/api/calibration/cancel", {}),
  use: (id) => submit("/api/calibration/use", { id }),
  choose: ({ target }) => set({ mishap: target.value }),
  levels: ({ detail }) => set({ levels: detail }),

  dismiss() {
    dismissed = get().cal.made?.id ?? "";
    writeStorage("dismissed", dismissed);
    showCalibration(get().cal);
  },

  dismissLenses() {
    dismissedLenses = get().cal.lenses?.ended_at ?? "";
    writeStorage("dismissed.lenses", dismissedLenses);
    showCalibration(get().cal);
  },

  setTheme(theme) {
    saveSetting("theme", theme);
    set({ theme });
  },
};

// Return the number, with a comma or a point; a text that is none is left for the server to refuse.
function numberOrText(text) {
  const value = Number(text.trim().replace(",", ".").replace("−", "-"));
  return Number.isFinite(value) ? value : text;
}

// Report activity on touch, which extends the login; polling does not.
function reportActivity() {
  const { view } = get();
  if (view === "door" || view === "opening" || performance.now() - activityMs < ACTIVITY_MS) return;
  activityMs = performance.now();
  request("/api/technician/here", {}).catch(() => {}); // the next poll shows the error
}
addEventListener("pointerdown", reportActivity);
addEventListener("keydown", reportActivity);

// ---- storage: theme and technician's name in localStorage; the dismissed results in sessionStorage

function saveSetting(key, value) {
  writeStorage(key, value, localStorage);
}

function loadSetting(key, otherwise) {
  return readStorage(key, localStorage) ?? otherwise;
}

function writeStorage(key, value, where = sessionStorage) {
  try {
    where.setItem(`diffuscope.${key}`, value);
  } catch {
    // Without storage, the settings are lost on a reload.
  }
}

function readStorage(key, where = sessionStorage) {
  try {
    return where.getItem(`diffuscope.${key}`);
  } catch {
    return null;
  }
}

// ---- render

function renderPage(state) {
  document.documentElement.dataset.theme = state.theme;
  render(technicianPage(state, actions), /** @type {HTMLElement} */ (document.querySelector("#app")));
}

store.subscribe(renderPage);
renderPage(get());
poll();
