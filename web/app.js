// Controller of the exam page: handles route changes and server events, and renders the state store. User actions are
// in core/actions.js.

import { actions } from "./core/actions.js";
import { showAim } from "./core/aiming.js";
import { EventStream, getCapture, getProgramme, releaseControl } from "./core/api.js";
import { page } from "./screens/page_layout.js";
import { goOnWhenShown, stay } from "./core/going_on.js";
import { bindKeys } from "./core/keyboard.js";
import { checkLogin, reportActivity } from "./core/login.js";
import "./components/live_preview.js";
import { get, set, store } from "./core/state.js";
import { resetPictureTools, captureEventHandlers, openPicture, rejectForeignCapture } from "./core/capture.js";
import { buttonsChanged } from "./core/taps.js";
import { startRouter, navigate } from "./core/router.js";
import { lowerAlert, lowerAlerts, endNotice, raiseAlert } from "./core/alerts.js";
import { refreshStatus, renewControl } from "./core/status.js";
import { render } from "./vendor/lit-html.js";
import { finishWhenComplete, alertOnError, refreshHome, refreshList, refreshMontages, refreshUploadQueue, refreshVisit, flushUnsaved } from "./core/visit.js";
import { loadLanguage, today } from "./i18n/translate.js";

/** @typedef {import("./core/state.js").State} State */

const STATUS_BEATS = 10; // request the status at every tenth heartbeat
const LEASE_BEATS = 4; // renewal period; the server's control lease lasts ten seconds

const $ = (selector) => document.querySelector(selector);

// ---- route changes

async function showRoute(route) {
  const before = get().route;
  const same = ["screen", "visit", "slot", "capture"].every((name) => before[name] === route[name]);
  const picked = route.visit === before.visit ? get().picked : Object.freeze([]);
  if (!same) resetPictureTools();
  // Alerts of a failed action are cleared when the screen changes.
  if (!same) lowerAlerts(({ from }) => from === "press");
  if (route.visit !== before.visit) lowerAlert("shot.crossed");
  if (route.screen !== "outcome") set({ finishing: null });
  set({ route: Object.freeze(route), asking: "", picked, prompt: null, typed: "", timer: 0, isCodeShown: false });
  buttonsChanged();
  lowerAlert("link.slow");
  if (route.screen !== "pictures" || route.visit !== before.visit) set({ montages: Object.freeze({}), changes: Object.freeze([]) });
  if (!same) set({ visits: null, folders: null, copied: null, zipped: false, blink: false });
  renewControl();
  await loadRoute(route);
  if (!same) requestAnimationFrame(() => focusScreen(route.screen));
}

// Lazily loaded modules, and the screens that need them. A failed import is retried when the event stream is connected
// again.
const LAZY_MODULES = {
  outcome: () => import("./screens/outcome.js"),
  history: () => import("./screens/history.js"),
  pictures: () => import("./screens/pictures.js"),
  send: () => import("./screens/send.js"),
  speech: () => import("./components/speech_dialog.js"),
  details: () => import("./components/picture_details.js"),
  viewer: () => import("./components/viewer/viewer.js"),
};
const MODULES_OF_SCREEN = {
  find: ["viewer"],
  patient: ["viewer", "speech", "outcome"],
  aim: ["viewer", "speech", "outcome"],
  picture: ["viewer", "details", "outcome"],
  outcome: ["outcome"],
  history: ["viewer", "history", "pictures"],
  send: ["send"],
  pictures: ["viewer", "pictures"],
  compare: ["viewer", "pictures"],
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

// The dialog of the login is loaded when it is needed first; without a link, when it is asked for again.
async function loadLogin({ detail }) {
  if (customElements.get("user-login")) return;
  try {
    await import("./components/user_login.js");
  } catch (problem) {
    if (problem instanceof TypeError) return;
    throw problem;
  }
  document.dispatchEvent(new CustomEvent("login-required", { detail }));
}

async function loadRoute(route) {
  for (const name of MODULES_OF_SCREEN[route.screen] ?? []) loadModule(name);
  if (route.screen === "home") refreshHome();
  if (route.screen === "find") refreshList({ day: today(), limit: "100" });
  if (route.screen === "send") refreshUploadQueue();
  if (route.screen === "history") refreshList({ day: route.day ?? today(), limit: "500" });
  if (!route.visit) return;
  if (get().visit?.id !== route.visit) set({ visit: null });
  const visit = await refreshVisit(route.visit);
  if (get().route.visit !== route.visit) return;
  if (!visit && !get().visit && get().link !== "lost") return leaveVisit();
  if (visit?.finished_at && ["aim", "patient"].includes(route.screen)) {
    return navigate({ screen: "outcome", visit: route.visit }, { replace: true }); // a finished visit is read-only
  }
  if (route.screen === "pictures") refreshMontages(route.visit);
  if (route.screen === "compare") {
    const captures = await Promise.all([route.capture, route.other].map((id) => alertOnError(() => getCapture(id))));
    const found = captures.filter((capture) => capture !== undefined);
    const foreign = found.find((capture) => capture.visit !== route.visit);
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
const SHUTTER = "#shutter";
const FOCUS = { aim: SHUTTER, picture: SHUTTER, home: "#new", outcome: "#outcome-title" };
const focusScreen = (screen) => $(FOCUS[screen] ?? "#back")?.focus({ preventScroll: true });

// ---- server events

const eventHandlers = {
  ...captureEventHandlers,

  link(link) {
    set({ link });
    if (link === "lost") {
      raiseAlert({ code: "link.lost", from: "page" });
      checkLogin(); // the server ends the stream with the login
    } else lowerAlert("link.lost");
    if (link === "live") refresh();
  },

  beat(data, heartbeats) {
    // While a status alert is shown, poll at every heartbeat, so that the alert ends soon after its cause.
    if (heartbeats % STATUS_BEATS === 0 || get().alerts.some(({ from }) => from === "status")) refreshStatus();
    else if (get().route.screen === "send" && heartbeats % LEASE_BEATS === 1) refreshUploadQueue();
    else if (heartbeats % LEASE_BEATS === 0 && get().hasControl) renewControl();
  },

  state: ({ state }) => set({ activity: state }),
  aim: showAim,

  /** The button on the handle: the page that aims and has control takes the picture. */
  button() {
    if (get().route.screen === "aim" && get().hasControl) actions.take();
  },

  /** An advisory alert begins, changes (`n`) or ends. */
  notice({ code, over: gone, ...more }) {
    set({ noticeCount: get().noticeCount + 1 });
    if (code === "link.other") renewControl(); // the lease answer shows whether this page holds control
    else if (gone) endNotice(code);
    else raiseAlert({ code, ...more, from: "notice" });
  },

  failed(failure) {
    captureEventHandlers.failed(failure);
    refreshStatus();
  },
};

async function refresh() {
  await refreshStatus();
  if (!get().programme) set({ programme: (await alertOnError(getProgramme)) ?? null });
  await flushUnsaved();
  await loadRoute(get().route);
}

// Release the control lease when the page closes, so that another screen can take pictures. After a reload, this page
// requests control again.
addEventListener("pagehide", releaseControl);

for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, () => get().user && reportActivity(), { passive: true });

document.addEventListener("login-required", (event) => loadLogin(/** @type {CustomEvent} */ (event)));

// A user has signed in: what the page shows stays, and is read again.
document.addEventListener("login-changed", (event) => {
  set({ user: /** @type {CustomEvent} */ (event).detail });
  refresh();
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
store.subscribe(goOnWhenShown);
// A touch keeps the page where it is, but of the shutter, which impatient people press twice.
for (const kind of ["pointerdown", "keydown", "wheel"]) {
  addEventListener(kind, ({ target }) => /** @type {Element} */ (target).closest(SHUTTER) ?? stay(), { capture: true, passive: true });
}
bindKeys(actions);
startRouter(showRoute);
renderPage(get());
new EventStream(eventHandlers);
set({ user: await checkLogin() });
