// Controller of the technician page: calibration, trial lenses. The state of a calibration is polled from the server,
// so a reload or restart loses nothing.

import { ApiError } from "../core/api.js";
import "../components/user_login.js";
import { askIfRequired, lock, reportActivity } from "../core/login.js";
import "./sensor_preview.js";
import { createStore } from "../core/store.js";
import { buttonsChanged } from "../core/taps.js";
import { render } from "../vendor/lit-html.js";
import { technicianPage } from "./calibration_wizard.js";
import { loadLanguage, t } from "../i18n/translate.js";

const POLL_MS = 700;

await loadLanguage("en", "technician/en");

const store = createStore(/** @type {Record<string, any>} */ ({
  view: "opening", // opening | overview | wizard | done | lenses | lens-result
  section: "calibration", // section of the overview
  cal: null, // latest calibration state of the server
  by: loadSetting("technician", ""),
  levels: null,
  mishap: "",
  error: null, // of the last action
  busy: false,
  lost: false,
  theme: loadSetting("theme", "dim"),
}));
const { get, set } = store;
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
    showCalibration(await request("/api/calibration"));
    set({ lost: false });
  } catch (problem) {
    if (problem.code === "link.cut") set({ lost: true });
    else if (problem.code === "access.role") set({ view: "overview", cal: null, error: problem, lost: false });
    else if (askIfRequired(problem)) set({ view: "opening", lost: false });
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

// Send one request per tap; show the server's error.
async function submit(path, body, then = showCalibration) {
  if (get().busy) return;
  set({ busy: true, error: null });
  try {
    then(await request(path, body));
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    if (!askIfRequired(problem)) set({ error: { code: problem.code, message: problem.message, remedy: problem.remedy } });
  } finally {
    set({ busy: false });
    buttonsChanged();
  }
}

// ---- user actions

const actions = {
  lock,
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

for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, () => get().view !== "opening" && reportActivity());
document.addEventListener("login-changed", refresh);

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
