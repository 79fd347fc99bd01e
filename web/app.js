// The page's story: where the person is, what the instrument tells, what is drawn. What a person can do stands in act.js.

import { act, answers } from "./act.js";
import { askForControls, EventLine, getCapture, getProtocol, getStatus, letControlsGo, Refusal } from "./api.js";
import { page } from "./frame.js";
import { listenToKeys } from "./keys.js";
import "./live.js";
import { get, set, store } from "./memory.js";
import { cue, freshPicture, heardOfShots, lock, openPicture, settleShots, take } from "./press.js";
import { follow, go } from "./routes.js";
import { lower, over, raise, stands } from "./states.js";
import { render } from "./vendor/lit-html.js";
import { finishWhenMade, politely, refreshList, refreshOutbox, refreshVisit, saveRest } from "./visit.js";
import { learn, t, today } from "./words.js";

const STATUS_BEATS = 10; // ask for the status again at every tenth heartbeat
const HOLD_BEATS = 4; // the controls are lent for ten seconds
const READ_MS = 700; // a prompt stays long enough to be read
const AUTO_MS = 500;
const LATE_S = 2;

const $ = (selector) => document.querySelector(selector);

// ---- arriving at a screen

async function arrive(route) {
  const before = get().route;
  const same = ["screen", "visit", "slot", "capture"].every((name) => before[name] === route[name]);
  const picked = route.visit === before.visit ? get().picked : Object.freeze([]);
  if (!same) freshPicture();
  // What went wrong belongs to the screen on which it did: nobody after that is told.
  if (!same) lower(({ from }) => from === "press");
  if (route.visit !== before.visit) lower("shot.crossed");
  if (route.screen !== "outcome") set({ finishing: null });
  set({ route: Object.freeze(route), asking: false, picked, prompt: null, typed: "", timer: 0, code: undefined });
  lock(); // a double tap must not also press what stands there on the new screen
  lower("link.slow");
  if (!same) set({ visits: null, folders: null, copied: null, zipped: false, blink: false });
  await load(route);
  if (!same) requestAnimationFrame(() => focusOn(route.screen));
}

// What Home does not need, by the screens that do. A file that a lost link kept back is asked for again when the link is back.
const FILES = {
  history: () => import("./screens/history.js"),
  send: () => import("./screens/send.js"),
  aloud: () => import("./screens/aloud.js"),
  details: () => import("./screens/details.js"),
  viewer: () => import("./viewer.js"),
};
const LATER = {
  find: ["viewer"],
  person: ["viewer", "aloud"],
  aim: ["viewer", "aloud"],
  picture: ["viewer", "details"],
  history: ["viewer", "history"],
  send: ["send"],
  film: ["viewer", "history"],
  compare: ["viewer", "history"],
};

async function bring(name) {
  if (get().later[name]) return;
  try {
    const module = await FILES[name]();
    set({ later: Object.freeze({ ...get().later, [name]: module }) });
  } catch (problem) {
    if (!(problem instanceof TypeError)) throw problem;
  }
}

async function load(route) {
  for (const name of LATER[route.screen] ?? []) bring(name);
  if (route.screen === "home") refreshList({ day: today(), open: "true", limit: "20" });
  if (route.screen === "find") refreshList({ day: today(), limit: "100" });
  if (route.screen === "send") refreshOutbox();
  if (route.screen === "history") refreshList({ day: route.day ?? today(), limit: "500" });
  if (!route.visit) return;
  if (get().visit?.id !== route.visit) set({ visit: null });
  const visit = await refreshVisit(route.visit);
  if (get().route.visit !== route.visit) return;
  if (!visit && !get().visit && get().link !== "lost") return leave();
  if (visit?.finished_at && ["aim", "person"].includes(route.screen)) {
    return go({ screen: "outcome", visit: route.visit }, { replace: true }); // it is closed: to be looked at only
  }
  if (route.screen === "compare") {
    const both = await Promise.all([route.capture, route.other].map((id) => politely(() => getCapture(id))));
    set({ compared: Object.freeze(both.filter(Boolean)) });
  }
  if (route.screen !== "picture" || !visit) return;
  if (!get().status) await refreshStatus(); // after a reload: is a picture being made?
  await openPicture(route);
}

// Home, with the words why.
function leave() {
  const said = get().states.filter(({ from }) => from === "press");
  go({ screen: "home" }, { replace: true });
  said.forEach(raise);
}

// Where the keyboard goes on; a finger does not notice.
const FOCUS = { aim: "#shutter", picture: "#shutter", home: "#new", outcome: "#done" };
const focusOn = (screen) => $(FOCUS[screen] ?? "#back")?.focus({ preventScroll: true });

// ---- what the instrument tells

let beats = 0;

const heard = {
  ...heardOfShots,

  link(link) {
    set({ link });
    if (link === "lost") raise({ code: "link.lost", from: "page" });
    else lower("link.lost");
    if (link === "live") refresh();
  },

  beat() {
    beats += 1;
    // A problem that is over must go at once.
    if (beats % STATUS_BEATS === 0 || get().states.some(({ from }) => from === "status")) refreshStatus();
    else if (get().route.screen === "send" && beats % HOLD_BEATS === 1) refreshOutbox();
    else if (beats % HOLD_BEATS === 0 && get().mine) holdControls();
  },

  state: ({ state }) => set({ doing: state }),
  aim: (aim) => heardAim(aim),

  /** What only tells begins, changes (`n`), or is over. */
  notice({ code, over: gone, ...more }) {
    noticed += 1;
    if (code === "link.other") holdControls(); // whose turn it is, the instrument says to each page by itself
    else if (gone) over(code);
    else raise({ code, ...more, from: "notice" });
  },

  failed(what) {
    heardOfShots.failed(what);
    refreshStatus();
  },
};

let sweptTold = false;

let noticed = 0;

async function refreshStatus() {
  const before = noticed;
  let status;
  try {
    status = await getStatus();
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    return; // the lost link already tells
  }
  const { problem } = status;
  set({ status: Object.freeze(status), doing: status.state });
  lower(({ from, told }) => from === "status" && told !== problem?.code);
  // A live picture whose light was cut tells it by its age; the next one is on its way.
  if (problem && problem.code !== "light.cut") raise({ ...problem, told: problem.code, from: "status" });
  if (noticed === before) stands(status.standing ?? []); // else it is older than what was just told
  settleShots();
  tellFindings(status.notices ?? []);
  if (status.swept?.length && !sweptTold) tellSwept(status.swept);
  await holdControls();
}

const told = new Set(); // a finding that somebody has put off is not told again to this page

// What the instrument found about itself that does not stop it, in its own words.
function tellFindings(notices) {
  lower(({ from, message }) => from === "finding" && !notices.includes(message));
  for (const message of notices.filter((words) => !told.has(words))) {
    told.add(message);
    raise({ code: `finding.${told.size}`, level: "tell", rank: 99, message, buttons: ["later"], from: "finding" });
  }
}

function tellSwept(swept) {
  sweptTold = true;
  const [first] = swept;
  const known = swept.length === 1 && first.slot ? first : { buttons: ["ok"] };
  raise({ code: "power.lost", message: t("swept", { n: swept.length }), ...known, from: "page" });
}

async function holdControls() {
  try {
    controls(await askForControls(false));
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
  }
}

function controls({ mine }) {
  set({ mine });
  if (mine) lower("link.other");
  else raise({ code: "link.other", from: "page" });
}

Object.assign(answers, { refreshStatus, controls });

async function refresh() {
  await refreshStatus();
  if (!get().protocol) set({ protocol: (await politely(getProtocol)) ?? null });
  await saveRest();
  await load(get().route);
}

// ---- aiming: one prompt from the device, at most every 0.7 s

let promptedAt = 0;
let readySince = 0;

function heardAim(aim) {
  if (!aim || get().route.screen !== "aim") return;
  const now = performance.now();
  const was = get().prompt;
  if (aim.code !== "ready") readySince = 0;
  else readySince ||= now;
  if (aim.code !== was?.code && now - promptedAt >= READ_MS) {
    promptedAt = now;
    set({ prompt: Object.freeze(aim) });
    if (aim.code === "ready") cue("ready");
  }
  if (get().auto && get().prompt?.code === "ready" && readySince && now - readySince > AUTO_MS) take();
}

// A page that closes lets the next screen take pictures; one that only loads itself anew is back before anybody asks.
addEventListener("pagehide", letControlsGo);

act.heardAim = ({ detail }) => heardAim(detail);
// Another screen changed the visit since it was loaded: loaded anew it tells why there is no light.
act.heardRefused = ({ detail: { code } }) => code.startsWith("consent.") && refreshVisit(get().route.visit);
act.heardLate = ({ detail: seconds }) => {
  if (seconds && get().prompt) set({ prompt: null }); // nobody is ready by an old picture
  if (seconds >= LATE_S && get().link === "live") {
    raise({ code: "link.slow", n: seconds, from: "page" });
  } else lower("link.slow");
};

// ---- draw

function draw(state) {
  document.documentElement.dataset.theme = state.theme;
  render(page(state, act), $("#app"));
  // The shutter had the focus and is gone: a keyboard goes on at the verdict, and a screen reader reads it.
  if (document.activeElement === document.body) $("#result-title")?.focus({ preventScroll: true });
}

await learn(get().language);
store.subscribe(draw);
store.subscribe(finishWhenMade);
listenToKeys(act);
follow(arrive);
draw(get());
new EventLine(heard);
