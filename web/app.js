// The page's story: aim, press, hold still, look, next. State lives in the store, looks live in views.js.

import { EventLine, getCaptures, getStatus, Refusal, takePicture } from "./api.js";
import "./live.js";
import { createStore } from "./store.js";
import { render } from "./vendor/lit-html.js";
import { EyePic, homeBox } from "./viewer.js";
import { otherEye, page } from "./views.js";
import { t } from "./words.js";

const LOCK_MS = 600; // the second half of a double tap must neither take a picture nor leave one
const STRIP = 20;
const STATUS_BEATS = 10; // ask for the status again at every tenth heartbeat

const START = Object.freeze({ name: "expose", fraction: 0, left: 0 });

const store = createStore({
  link: "opening", // opening | live | lost
  status: null,
  doing: "aim", // what the instrument says about itself
  screen: "aim", // aim | making | result
  eye: "OD",
  subject: null, // whose picture the viewer holds: a press, or a capture from the list
  src: null, // what the viewer should load
  picture: "none", // what the viewer has really drawn: none | quick | final
  grey: false,
  stage: START,
  shown: null, // the capture on the result screen
  fresh: false, // it was taken just now, so "Take again" and "Next" make sense
  captures: [],
  alert: null,
  note: "",
  redfree: false,
  contrast: 0,
  zoom: 1,
  theme: remembered("theme", "dim"),
  letters: remembered("letters", "on") === "on",
});

const { get, set } = store;
const $ = (selector) => document.querySelector(selector);
let lockedUntil = 0;
let press = 0; // counts presses, names their subject
let makingId = null; // the capture that our press is making, once the instrument has named it
let lastId = null; // the capture before it: late events about it are not about our press

// ---- acts: everything a person can do

const act = {
  chooseEye: (eye) => set({ eye }),

  take() {
    if (performance.now() < lockedUntil) return;
    lock();
    // A press into a dead link could arrive later, and light nobody expects would go on: it is not sent.
    if (get().link === "lost") return;
    // Our own second press costs the eye nothing: it is not even sent. Everything else the instrument decides.
    if (get().screen === "making") sayAlready();
    else if (get().screen === "aim") makePicture(get().eye);
  },

  again() {
    toAim(get().shown.eye);
  },

  next() {
    toAim(otherEye(get().shown.eye));
  },

  back() {
    toAim(get().eye);
  },

  open(capture) {
    if (get().screen === "making") return sayAlready();
    if (get().shown?.id === capture.id && get().screen === "result") return undefined;
    set({ ...noPicture(), subject: capture.id, alert: null });
    showCapture(capture, false);
    return undefined;
  },

  // The viewer tells what it has drawn; until then nothing on the page says "final".
  drawn({ detail }) {
    set({ picture: detail.mark, grey: detail.mark === "final" && detail.grey });
  },

  pictureFault({ detail }) {
    if (detail.mark === "quick") return; // the final picture is still to come
    set({ alert: { code: "picture", message: t("fault.picture"), remedy: t("fault.picture.remedy") } });
  },

  zoomed: ({ detail }) => set({ zoom: detail }),
  zoomIn: () => $("eye-pic").zoomIn(),
  zoomOut: () => $("eye-pic").zoomOut(),
  setRedfree: (redfree) => set({ redfree }),
  contrastBy: (step) => set({ contrast: EyePic.clampContrast(get().contrast + step) }),

  reset() {
    set({ contrast: 0 });
    $("eye-pic").showAll();
  },

  // A thumbnail shows the illuminated disc, not the dark frame around it.
  thumbLoaded({ target }) {
    const { naturalWidth: width, naturalHeight: height } = target;
    const home = homeBox(get().status, width, height);
    target.style.transform = `scale(${Math.min(width, height) / Math.min(home.width, home.height)})`;
  },

  closeAlert: () => set({ alert: null }),
  openMenu: () => $("#menu").showModal(),
  closeMenu: () => $("#menu").close(),

  setTheme(theme) {
    remember("theme", theme);
    set({ theme });
  },

  setLetters({ target }) {
    remember("letters", target.checked ? "on" : "off");
    set({ letters: target.checked });
  },
};

// ---- from the press to the picture

async function makePicture(eye) {
  press += 1;
  makingId = null;
  lastId = get().captures[0]?.id ?? null;
  set({ ...noPicture(), screen: "making", subject: `press-${press}`, stage: START, alert: null, note: "" });
  navigator.vibrate?.(30);
  const mine = press;
  try {
    const capture = await takePicture(eye);
    if (mine === press) pictureKept(capture);
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    if (mine === press && get().screen === "making") fail(problem);
  }
}

function pictureKept(capture) {
  addToStrip(capture);
  if (get().screen !== "making") return;
  press += 1; // this press is over; a late answer changes nothing any more
  showCapture(capture, true);
}

function fail({ code, message, remedy }) {
  press += 1;
  toAim(get().eye);
  set({ alert: { code, message, remedy } });
}

function noPicture() {
  return { src: null, picture: "none", grey: false, shown: null, redfree: false, contrast: 0 };
}

function showCapture(capture, fresh) {
  set({
    screen: "result",
    shown: capture,
    fresh,
    note: "",
    src: { url: capture.links.picture, mark: "final" },
  });
  lock();
  if (history.state?.screen !== "result") history.pushState({ screen: "result" }, "");
  requestAnimationFrame(() => $("#result-title")?.focus({ preventScroll: true }));
}

function toAim(eye) {
  lock();
  const had = get().screen;
  set({ ...noPicture(), screen: "aim", subject: null, eye, note: "", alert: get().status?.problem ?? null });
  if (history.state?.screen === "result") history.back();
  if (had === "result") requestAnimationFrame(() => $("#shutter")?.focus({ preventScroll: true }));
}

function lock() {
  lockedUntil = performance.now() + LOCK_MS;
}

// The note stands where the picture's mark stands, so it must soon give the place back.
function sayAlready() {
  set({ note: t("take.already") });
  setTimeout(() => set({ note: "" }), 3000);
}

function addToStrip(capture) {
  const others = get().captures.filter(({ id }) => id !== capture.id);
  set({ captures: [capture, ...others].slice(0, STRIP) });
}

// ---- what the instrument tells

let beats = 0;

const heard = {
  link(link) {
    set({ link });
    if (link === "live") refresh();
  },

  beat() {
    beats += 1;
    if (beats % STATUS_BEATS === 0 || get().status?.problem) refreshStatus(); // a problem that is over must go at once
  },

  state({ state }) {
    set({ doing: state });
  },

  stage({ id, stage: name, url, fraction, left_s: left }) {
    const { screen, stage } = get();
    if (screen !== "making" || id === lastId || (makingId && id !== makingId)) return;
    makingId = id;
    // A bar that goes back tells people that something broke, so it never does.
    set({ stage: { name, fraction: Math.max(stage.fraction, fraction ?? 0), left: left ?? 0 } });
    if (url) set({ src: { url, mark: "quick" } });
  },

  failed() {
    // Our own press hears of its failure by its answer; anything else is a problem of the instrument that stands now.
    if (get().screen !== "making") refreshStatus();
  },

  kept(capture) {
    if (get().screen === "making" && capture.id === makingId) pictureKept(capture);
    else addToStrip(capture);
  },
};

async function refreshStatus() {
  try {
    const status = await getStatus();
    const { problem } = status;
    const was = get().status?.problem;
    set({ status: Object.freeze(status), doing: status.state });
    // Tell a standing problem once, not again every ten seconds after somebody has read it.
    if (problem && problem.code !== was?.code) set({ alert: problem });
    if (!problem && was && get().alert?.code === was.code) set({ alert: null });
    return status;
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    return null; // the banner already tells
  }
}

let sweptTold = false;

async function refresh() {
  const status = await refreshStatus();
  if (status?.swept?.length && !sweptTold && !status.problem) {
    sweptTold = true;
    set({ alert: { code: "swept", message: t("swept", { n: status.swept.length }), remedy: t("swept.remedy") } });
  }
  try {
    set({ captures: await getCaptures(STRIP) });
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    if (get().link === "live") set({ alert: problem });
  }
}

// ---- keys

addEventListener("keydown", (event) => {
  if (event.defaultPrevented || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  if ($("#menu").open) return;
  const { screen, fresh, picture, redfree, letters } = get();
  const inControl = event.target.closest("button, a, input, summary, eye-pic");
  if (event.key === " " || event.key === "Enter") {
    if (screen !== "aim" || inControl) return;
    event.preventDefault();
    act.take();
    return;
  }
  if (!letters || picture === "none") return;
  const result = screen === "result";
  const keys = {
    g: () => act.setRedfree(!redfree),
    "+": () => act.contrastBy(1),
    "=": () => act.contrastBy(1),
    "-": () => act.contrastBy(-1),
    0: act.reset,
    r: () => result && fresh && act.again(),
    n: () => result && (fresh ? act.next() : act.back()),
  };
  keys[event.key.toLowerCase()]?.();
});

// The browser's (and Android's) Back goes from the result to the live picture, not out of the page.
addEventListener("popstate", () => {
  if (get().screen === "result") toAim(get().eye);
});
history.replaceState(null, "");

// ---- what this tablet remembers: how the page looks, and nothing about people

function remember(key, value) {
  try {
    localStorage.setItem(`diffuscope.${key}`, value);
  } catch {
    // A browser that keeps nothing still works; it only forgets the theme.
  }
}

function remembered(key, otherwise) {
  try {
    return localStorage.getItem(`diffuscope.${key}`) ?? otherwise;
  } catch {
    return otherwise;
  }
}

// ---- draw

function draw(state) {
  document.documentElement.dataset.theme = state.theme;
  render(page(state, act), $("#app"));
}

store.subscribe(draw);
draw(get());
new EventLine(heard);
