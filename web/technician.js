// The technician's place: the door with its PIN, and the calibration wizard behind it. The instrument knows where a
// calibration stands; this page asks it again and again, and shows that. A reload or a restart loses nothing.

import { Refusal } from "./api.js";
import "./bench_live.js";
import { createStore } from "./store.js";
import { render } from "./vendor/lit-html.js";
import { place } from "./wizard.js";
import { speak, t } from "./words.js";
import { TECHNICIAN } from "./words_technician.js";

const ASK_MS = 700;
const LOCK_MS = 600; // the second half of a double tap must not start what the page shows next
const HERE_MS = 30_000; // tell the instrument at most this often that somebody is here

speak("en", TECHNICIAN);

const store = createStore({
  view: "opening", // opening | door | overview | wizard | done
  room: "calibration", // of the overview
  cal: null, // what the instrument says about calibration
  hasPin: true,
  pin: "",
  wait: 0, // seconds until another PIN may be tried
  by: remembered("technician", ""),
  levels: null,
  mishap: "",
  error: null, // of the last thing that was tapped
  busy: false,
  lost: false,
  theme: remembered("theme", "dim"),
});
const { get, set } = store;
let lockedUntil = 0;
let hereAt = 0;
let dismissed = kept("dismissed");

// ---- talking with the instrument

async function ask(path, body) {
  const options = { cache: "no-store", signal: AbortSignal.timeout(60_000) };
  if (body !== undefined) {
    Object.assign(options, {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
    });
  }
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Refusal({ code: "link.cut", message: t("tech.lost"), remedy: "" });
  }
  const said = await answer.json().catch(() => null);
  if (answer.ok && said) return said;
  throw new Refusal(said?.message ? said : { code: "fault", message: t("fault.unknown"), remedy: t("fault.unknown.remedy") });
}

async function watch() {
  for (;;) {
    if (!document.hidden) await look();
    await new Promise((resolve) => setTimeout(resolve, ASK_MS));
  }
}

async function look() {
  try {
    if (get().view === "door") return set({ wait: Math.max(0, get().wait - ASK_MS / 1000) });
    if (get().view === "opening") {
      const { open } = await ask("/api/technician");
      if (!open) return toDoor();
    }
    heard(await ask("/api/calibration"));
    set({ lost: false });
  } catch (problem) {
    if (problem.code === "technician.locked") await toDoor();
    else if (problem.code === "link.cut") set({ lost: true });
    else throw problem;
  }
  return undefined;
}

function heard(cal) {
  const before = get().cal;
  const inside = cal.state === "asking" || cal.state === "measuring";
  const view = inside ? "wizard" : cal.made && cal.made.id !== dismissed ? "done" : "overview";
  if (view !== get().view || cal.state !== before?.state || cal.stand !== before?.stand) lock();
  if (cal.stand !== before?.stand || cal.state === "measuring") set({ error: null });
  set({ cal: Object.freeze(cal), view });
}

async function doorNow() {
  const { has_pin: hasPin, wait_s: wait } = await ask("/api/technician");
  return { hasPin, wait, pin: "" };
}

async function toDoor() {
  try {
    set({ view: "door", ...(await doorNow()), error: null, lost: false, busy: false });
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    set({ lost: true });
  }
}

// One tap, one request; what the instrument refuses is shown in its own words.
async function tapped(path, body, then = heard) {
  if (get().busy || performance.now() < lockedUntil) return;
  set({ busy: true, error: null });
  try {
    then(await ask(path, body));
  } catch (problem) {
    if (!(problem instanceof Refusal)) throw problem;
    if (problem.code === "technician.locked" && get().view !== "door") await toDoor();
    else {
      const wait = get().view === "door" ? await doorNow().catch(() => null) : null; // before a tap can count again
      set({ ...wait, error: { code: problem.code, message: problem.message, remedy: problem.remedy } });
    }
  } finally {
    set({ busy: false });
    lock();
  }
}

function lock() {
  lockedUntil = performance.now() + LOCK_MS;
}

// ---- what a person can do

const act = {
  digit: (digit) => set({ pin: `${get().pin}${digit}`.slice(0, 12) }),
  undigit: () => set({ pin: get().pin.slice(0, -1) }),
  pinTyped: ({ target }) => set({ pin: target.value }),

  async enter(event) {
    event.preventDefault();
    const { pin, hasPin, wait } = get();
    if (wait > 0 || !pin) return;
    if (pin.length < 4) return set({ error: { code: "pin.short", message: t("pin.short"), remedy: "" } }); // the digits stay
    await tapped(hasPin ? "/api/technician/unlock" : "/api/technician/pin", { pin }, () => set({ view: "opening" }));
    if (get().view === "opening") await look();
  },

  lock: () => tapped("/api/technician/lock", {}, toDoor),
  enterRoom: (room) => set({ room }),

  named({ target }) {
    remember("technician", target.value);
    set({ by: target.value });
  },

  start(event) {
    event.preventDefault();
    const { by, cal } = get();
    if (!by.trim() || cal.state === "starting") return;
    const form = event.target.elements;
    const source = Number(form.source.value.replace(",", "."));
    const wish = { by: by.trim() };
    if (form.serial.value.trim()) wish.serial = form.serial.value.trim();
    if (form.source.value.trim()) wish.source_deg = Number.isFinite(source) ? source : form.source.value;
    tapped("/api/calibration", wish);
  },

  ready() {
    const { cal, mishap } = get();
    if (cal.state !== "asking") return;
    set({ mishap: "" });
    tapped("/api/calibration/ready", { stand: cal.stand, ...(mishap && { mishap }) });
  },

  cancel: () => tapped("/api/calibration/cancel", {}),
  use: (id) => tapped("/api/calibration/use", { id }),
  choose: ({ target }) => set({ mishap: target.value }),
  levels: ({ detail }) => set({ levels: detail }),

  dismiss() {
    dismissed = get().cal.made?.id ?? "";
    keep("dismissed", dismissed);
    heard(get().cal);
  },

  setTheme(theme) {
    remember("theme", theme);
    set({ theme });
  },
};

// Looking on does not keep the door open; touching the page does.
function here() {
  const { view } = get();
  if (view === "door" || view === "opening" || performance.now() - hereAt < HERE_MS) return;
  hereAt = performance.now();
  ask("/api/technician/here", {}).catch(() => {}); // the next look says what is the matter
}
addEventListener("pointerdown", here);
addEventListener("keydown", here);

// ---- what this tablet remembers: the theme and the technician's name; until it is closed: which end was read

function remember(key, value) {
  keep(key, value, localStorage);
}

function remembered(key, otherwise) {
  return kept(key, localStorage) ?? otherwise;
}

function keep(key, value, where = sessionStorage) {
  try {
    where.setItem(`diffuscope.${key}`, value);
  } catch {
    // A browser that keeps nothing still works; it only forgets.
  }
}

function kept(key, where = sessionStorage) {
  try {
    return where.getItem(`diffuscope.${key}`);
  } catch {
    return null;
  }
}

// ---- draw

function draw(state) {
  document.documentElement.dataset.theme = state.theme;
  render(place(state, act), document.querySelector("#app"));
}

store.subscribe(draw);
draw(get());
watch();
