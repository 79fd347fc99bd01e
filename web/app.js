// Controller of the exam page: handles route changes and server events, and renders the state store. User actions are
// in core/actions.js.

import { actions, pageHooks } from "./core/actions.js";
import { requestControl, EventStream, getCapture, getProtocol, getStatus, releaseControl, ApiError } from "./core/api.js";
import { page } from "./screens/page_layout.js";
import { bindKeys } from "./core/keyboard.js";
import "./components/live_preview.js";
import { get, set, store } from "./core/state.js";
import { playCue, resetPictureTools, captureEventHandlers, openPicture, rejectForeignCapture, resolveCutShots, takePicture } from "./core/capture.js";
import { buttonsChanged } from "./core/taps.js";
import { startRouter, navigate } from "./core/router.js";
import { lowerAlerts, endNotice, raiseAlert, syncNotices } from "./core/alerts.js";
import { render } from "./vendor/lit-html.js";
import { finishWhenComplete, alertOnError, refreshHome, refreshList, refreshMontages, refreshOutbox, refreshVisit, flushUnsaved } from "./core/visit.js";
import { loadLanguage, t, today } from "./i18n/translate.js";

/** @typedef {import("./core/state.js").State} State */

const STATUS_BEATS = 10; // request the status at every tenth heartbeat
const LEASE_BEATS = 4; // renewal period; the server's control lease lasts ten seconds
const PROMPT_MIN_MS = 700; // minimum display time of a prompt
const AUTO_CAPTURE_MS = 500;
const LATE_S = 4; // the server answers within 2 s, with a frame or without one

const $ = (selector) => document.querySelector(selector);

// ---- route changes

async function showRoute(route) {
  const before = get().route;
  const same = ["screen", "visit", "slot", "capture"].every((name) => before[name] === route[name]);
  const picked = route.visit === before.visit ? get().picked : Object.freeze([]);
  if (!same) resetPictureTools();
  // Alerts of a failed action are cleared when the screen changes.
  if (!same) lowerAlerts(({ from }) => from === "press");
  if (route.visit !== before.visit) lowerAlerts("shot.crossed");
  if (route.screen !== "outcome") set({ finishing: null });
  set({ route: Object.freeze(route), asking: "", picked, prompt: null, typed: "", timer: 0, code: undefined });
  buttonsChanged();
  lowerAlerts("link.slow");
  if (route.screen !== "film" || route.visit !== before.visit) set({ montages: Object.freeze({}) });
  if (!same) set({ visits: null, folders: null, copied: null, zipped: false, blink: false });
  renewControl();
  await loadRoute(route);
  if (!same) requestAnimationFrame(() => focusScreen(route.screen));
}

// Lazily loaded modules, and the screens that need them. A failed import is retried when the event stream is connected
// again.
const LAZY_MODULES = {
  history: () => import("./screens/history.js"),
  send: () => import("./screens/send.js"),
  speech: () => import("./components/speech_dialog.js"),
  details: () => import("./components/picture_details.js"),
  viewer: () => import("./components/viewer/viewer.js"),
};
const MODULES_OF_SCREEN = {
  find: ["viewer"],
  person: ["viewer", "speech"],
  aim: ["viewer", "speech"],
  picture: ["viewer", "details"],
  history: ["viewer", "history"],
  send: ["send"],
  film: ["viewer", "history"],
  compare: ["viewer", "history"],
};

async function loadModule(name) {
  if (get().modules[name]) return;
  try {
    const module = await LAZY_MODULES[name]();
    set({ modules: Object.freeze({ ...get().modules, [name]: module }) });
  } catch (problem) {
    if (!(problem instanceof TypeError)) throw problem;
  }
}

async function loadRoute(route) {
  for (const name of MODULES_OF_SCREEN[route.screen] ?? []) loadModule(name);
  if (route.screen === "home") refreshHome();
  if (route.screen === "find") refreshList({ day: today(), limit: "100" });
  if (route.screen === "send") refreshOutbox();
  if (route.screen === "history") refreshList({ day: route.day ?? today(), limit: "500" });
  if (!route.visit) return;
  if (get().visit?.id !== route.visit) set({ visit: null });
  const visit = await refreshVisit(route.visit);
  if (get().route.visit !== route.visit) return;
  if (!visit && !get().visit && get().link !== "lost") return leaveVisit();
  if (visit?.finished_at && ["aim", "person"].includes(route.screen)) {
    return navigate({ screen: "outcome", visit: route.visit }, { replace: true }); // a finished visit is read-only
  }
  if (route.screen === "film") refreshMontages(route.visit);
  if (route.screen === "compare") {
    const captures = await Promise.all([route.capture, route.other].map((id) => alertOnError(() => getCapture(id))));
    const found = captures.filter((one) => one !== undefined);
    const foreign = found.find((one) => one.visit !== route.visit);
    if (get().route !== route) return;
    if (foreign) rejectForeignCapture(route, foreign);
    else set({ compared: Object.freeze(found) });
  }
  if (route.screen !== "picture" || !visit) return;
  if (!get().status) await refreshStatus(); // after a reload, `activity` shows whether a capture is in progress
  await openPicture(route);
}

// Go to Home and keep the error alert visible there.
function leaveVisit() {
  const messages = get().alerts.filter(({ from }) => from === "press");
  navigate({ screen: "home" }, { replace: true });
  messages.forEach(raiseAlert);
}

// Initial keyboard focus of each screen.
const FOCUS = { aim: "#shutter", picture: "#shutter", home: "#new", outcome: "#done" };
const focusScreen = (screen) => $(FOCUS[screen] ?? "#back")?.focus({ preventScroll: true });

// ---- server events

let heartbeats = 0;

const eventHandlers = {
  ...captureEventHandlers,

  link(link) {
    set({ link });
    if (link === "lost") raiseAlert({ code: "link.lost", from: "page" });
    else lowerAlerts("link.lost");
    if (link === "live") refresh();
  },

  beat() {
    heartbeats += 1;
    // While a status alert is shown, poll at every heartbeat, so that the alert ends soon after its cause.
    if (heartbeats % STATUS_BEATS === 0 || get().alerts.some(({ from }) => from === "status")) refreshStatus();
    else if (get().route.screen === "send" && heartbeats % LEASE_BEATS === 1) refreshOutbox();
    else if (heartbeats % LEASE_BEATS === 0 && get().hasControl) renewControl();
  },

  state: ({ state }) => set({ activity: state }),
  aim: (aim) => showAim(aim),

  /** An advisory alert begins, changes (`n`) or ends. */
  notice({ code, over: gone, ...more }) {
    noticeCount += 1;
    if (code === "link.other") renewControl(); // the lease answer shows whether this page holds control
    else if (gone) endNotice(code);
    else raiseAlert({ code, ...more, from: "notice" });
  },

  failed(failure) {
    captureEventHandlers.failed(failure);
    refreshStatus();
  },
};

// The age on the live picture already shows a cut light; the next frame follows. And `light.visit` refuses light
// without a visit only, while every picture of this page has one.
const UNSHOWN_PROBLEMS = ["light.cut", "light.visit"];

let interruptedShown = false;

let noticeCount = 0;

async function refreshStatus() {
  const before = noticeCount;
  let status;
  try {
    status = await getStatus();
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
    return; // the event stream already shows the lost connection
  }
  const { problem } = status;
  set({ status: Object.freeze(status), activity: status.state });
  lowerAlerts(({ from, problemCode }) => from === "status" && problemCode !== problem?.code);
  if (problem && !UNSHOWN_PROBLEMS.includes(problem.code)) raiseAlert({ ...problem, problemCode: problem.code, from: "status" });
  if (noticeCount === before) syncNotices(status.standing ?? []); // otherwise `status.standing` is older than the latest notice event
  resolveCutShots();
  raiseFindings(status.notices ?? []);
  if (status.swept?.length && !interruptedShown) raiseInterrupted(status.swept);
  await renewControl();
}

const shownFindings = new Set(); // dismissed findings are not shown again on this page

// Show findings of the instrument's self-checks that do not block captures, with the server's text.
function raiseFindings(notices) {
  lowerAlerts(({ from, message }) => from === "finding" && !notices.includes(message));
  for (const message of notices.filter((text) => !shownFindings.has(text))) {
    shownFindings.add(message);
    raiseAlert({ code: `finding.${shownFindings.size}`, level: "tell", rank: 99, message, buttons: ["later"], from: "finding" });
  }
}

function raiseInterrupted(swept) {
  interruptedShown = true;
  const [first] = swept;
  const known = swept.length === 1 && first.slot ? first : { buttons: ["ok"] };
  raiseAlert({ code: "power.lost", message: t("swept", { n: swept.length }), ...known, from: "page" });
}

// Screens that show what was taken. A page on one of them never takes the camera, and releases it.
const READING = ["outcome", "film", "compare", "history", "send"];

/**
 * Return whether this page needs the control lease: it aims, or a picture of its own is being taken.
 * @param {State} state
 */
const needsControl = ({ route, shots }) => route.screen === "aim" || shots.some((shot) => !shot.over && !shot.reloaded);

/** @param {State} state */
const isReading = ({ route, visit }) => READING.includes(route.screen) || (route.screen === "picture" && Boolean(visit?.finished_at));

// Request or renew the control lease where this page needs it; between two pictures renew it where it is held.
async function renewControl() {
  if (!needsControl(get()) && (isReading(get()) || !get().hasControl)) {
    if (get().hasControl) releaseControl();
    set({ hasControl: false });
    return lowerAlerts(({ code, from }) => code === "link.other" && from === "page");
  }
  try {
    setControl(await requestControl(false));
  } catch (problem) {
    if (!(problem instanceof ApiError)) throw problem;
  }
}

function setControl({ mine }) {
  set({ hasControl: mine });
  if (mine) lowerAlerts("link.other");
  else if (needsControl(get())) raiseAlert({ code: "link.other", from: "page" });
}

Object.assign(pageHooks, { refreshStatus, setControl });

async function refresh() {
  await refreshStatus();
  if (!get().protocol) set({ protocol: (await alertOnError(getProtocol)) ?? null });
  await flushUnsaved();
  await loadRoute(get().route);
}

// ---- aiming: at most one new prompt every 0.7 s

let promptedMs = 0;
let readySinceMs = 0;

function showAim(aim) {
  if (!aim || get().route.screen !== "aim") return;
  const now = performance.now();
  const was = get().prompt;
  if (aim.code !== "ready") readySinceMs = 0;
  else readySinceMs ||= now;
  if (aim.code !== was?.code && now - promptedMs >= PROMPT_MIN_MS) {
    promptedMs = now;
    set({ prompt: Object.freeze(aim) });
    if (aim.code === "ready") playCue("ready");
  }
  if (get().auto && get().prompt?.code === "ready" && readySinceMs && now - readySinceMs > AUTO_CAPTURE_MS) takePicture();
}

// Release the control lease when the page closes, so that another screen can take pictures. After a reload, this page
// requests control again.
addEventListener("pagehide", releaseControl);

Object.assign(actions, {
  previewAim: ({ detail }) => showAim(detail),
  // Consent or control changed on another screen: reload the visit or the lease to show the reason.
  previewRefused({ detail: { code } }) {
    if (code.startsWith("consent.")) refreshVisit(get().route.visit);
    else if (code === "link.other") renewControl();
  },
  previewLate({ detail: { frame_s, link_s } }) {
    if (frame_s && get().prompt) set({ prompt: null }); // an outdated frame must not show "ready"
    if (link_s >= LATE_S && get().link === "live") {
      raiseAlert({ code: "link.slow", n: frame_s, from: "page" });
    } else lowerAlerts("link.slow");
  },
});

// ---- render

/** @param {State} state */
function renderPage(state) {
  document.documentElement.dataset.theme = state.theme;
  render(page(state, actions), $("#app"));
  // When the focused shutter is removed, move the focus to the verdict, which a screen reader then reads.
  if (document.activeElement === document.body) $("#result-title")?.focus({ preventScroll: true });
}

await loadLanguage(get().language);
store.subscribe(renderPage);
store.subscribe(finishWhenComplete);
bindKeys(actions);
startRouter(showRoute);
renderPage(get());
new EventStream(eventHandlers);
