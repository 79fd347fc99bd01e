// Everything that a person can do, by tap or key: one object that the templates and the keys share.

import { fileOf, getFolders, askForControls } from "./api.js";
import { clamp, homeBox } from "./field.js";
import { get, remember, set, shotOf } from "./memory.js";
import { numberWords, typedBy } from "./parts.js";
import { cue, freshPicture, take, unlocked } from "./press.js";
import { codeOf } from "./qr.js";
import { go } from "./routes.js";
import { codeText } from "./screens/outcome.js";
import { dismiss, lower, raise } from "./states.js";
import * as visits from "./visit.js";
import { learn, t, today } from "./words.js";

const $ = (selector) => document.querySelector(selector);
const here = () => get().route;
const PUPIL_REST_MS = 60_000;
const TOOL_STEPS = 5; // of brightness and contrast, up and down

const toAim = (slot) => go({ screen: "aim", visit: here().visit, slot });

const moves = {
  go,
  begin: (number) => unlocked() && visits.begin(number),
  resume: visits.resume,
  trySending: visits.trySending,
  shoot: () => unlocked() && go({ screen: "aim", visit: get().visit.id, slot: get().visit.next_slot ?? visits.nextSlot() }),
  setField: visits.setField,
  typeNumber(key) {
    const typed = typedBy(get().typed, key, 12);
    set({ typed });
    visits.refreshList(typed ? { q: typed, limit: "20" } : { day: today(), limit: "20" });
  },
  /** Whoever has exactly this number; else somebody new. */
  enterNumber() {
    const same = (get().visits ?? []).find(({ number }) => [number, numberWords(number)].includes(get().typed));
    if (same) visits.resume(same);
    else moves.begin(get().typed);
  },
  only: (onlyShow) => set({ onlyShow }),

  /** One step up: from a picture to its person, from there home; else to where one came from. */
  back() {
    const { screen, visit, capture } = here();
    const exam = screen === "aim" || (screen === "picture" && !capture && !get().visit?.finished_at);
    if (get().asking) set({ asking: false });
    else if (exam) go({ screen: "person", visit });
    else if (history.state?.depth && screen !== "person" && screen !== "outcome") history.back();
    else go({ screen: "home" }, { replace: !history.state?.depth });
  },

  /** A tile with a picture shows it; one without is aimed at. */
  chooseTile(slot) {
    const { visit, shots } = get();
    const underway = shots.some((shot) => shot.visit === visit.id && shot.slot === slot && !shot.over);
    lower(({ from }) => from === "press");
    if (underway || visit.finished_at || visit.slots[slot].captures.length) go({ screen: "picture", visit: visit.id, slot });
    else toAim(slot);
  },
};

const exam = {
  take,
  again: () => unlocked() && toAim(here().slot),
  keepOld: () => unlocked() && go({ screen: "picture", visit: here().visit, slot: here().slot }),
  next: () => unlocked() && visits.goOn(here().slot),
  keepThis: () => unlocked() && visits.keepPoor(shotOf(get()).id, here().slot),
  useThis: () => unlocked() && visits.useInSlot(here().slot, here().capture),
  ask: () => unlocked() && set({ asking: true }),
  stopAsking: () => set({ asking: false }),
  couldNot: (slot, reason) => unlocked() && visits.couldNot(slot, reason),
  finish: () => unlocked() && visits.finish(),
  reopen: () => unlocked() && visits.reopen(),
  backToOutcome: () => go({ screen: "outcome", visit: here().visit }),
  otherEyeIs: (slot, capture) => unlocked() && visits.moveToOtherEye(slot, capture),
  print: () => window.print(),

  async showCode() {
    const drawn = await codeOf(codeText(get()));
    set({ code: get().code ? undefined : drawn });
  },

  openFilm: (visit) => {
    set({ visit });
    go({ screen: "film", visit: visit.id });
  },
  openDetails: () => get().later.details?.open(),
  openPicture: (slot, capture) => go({ screen: "picture", visit: here().visit, slot, capture }),
  pick(id) {
    const { picked } = get();
    set({ picked: picked.includes(id) ? picked.filter((one) => one !== id) : [...picked, id].slice(-2) });
  },
  compare: () => go({ screen: "compare", visit: here().visit, capture: get().picked[0], other: get().picked[1] }),
  setBlink: (blink) => set({ blink, front: 0 }),
  swap: () => set({ front: get().front ? 0 : 1 }),
  linkZoom({ target, detail }) {
    for (const pic of document.querySelectorAll(".two eye-pic")) if (pic !== target) pic.view = detail;
  },
  listFolders: async () => set({ folders: (await visits.politely(getFolders)) ?? null, copied: null, zipped: false }),
  zipped: () => set({ folders: null, copied: null, zipped: true }),
  copyTo: visits.copyTo,
};

// One object per capture, so that the same picture is not loaded again at every drawing of the page.
const finals = new Map();

const picture = {
  finalOf(id) {
    if (!finals.has(id)) finals.set(id, { url: fileOf(id, "picture.png"), mark: "final" });
    return finals.get(id);
  },

  // The viewer tells what it has drawn; until then nothing on the page says "final".
  drawn({ detail }) {
    set({ picture: detail.mark, grey: detail.mark === "final" && detail.grey });
  },

  pictureFault({ detail }) {
    if (detail.mark === "quick") return; // the final picture is still to come
    raise({ code: "picture", message: t("fault.picture"), remedy: t("fault.picture.remedy"), from: "press" });
  },

  zoomed: ({ detail }) => set({ zoom: detail }),
  zoomIn: () => $("#picture").zoomIn(),
  zoomOut: () => $("#picture").zoomOut(),
  setRedfree: (redfree) => set({ redfree }),
  contrastBy: (step) => set({ contrast: clamp(get().contrast + step, -TOOL_STEPS, TOOL_STEPS) }),
  brightnessBy: (step) => set({ brightness: clamp(get().brightness + step, -TOOL_STEPS, TOOL_STEPS) }),
  setLoupe: (loupe) => set({ loupe }),
  heardLoupe: ({ detail }) => set({ loupe: detail }),

  reset() {
    set({ brightness: 0, contrast: 0, loupe: false });
    $("#picture").showAll();
  },

  // A thumbnail shows the illuminated disc, not the dark frame around it.
  thumbLoaded({ target }) {
    const { naturalWidth: width, naturalHeight: height } = target;
    const home = homeBox(get().status, width, height);
    target.style.transform = `scale(${Math.min(width, height) / Math.min(home.width, home.height)})`;
  },
};

// ---- buttons of states

const ofState = {
  ok: ({ code }) => lower(code),
  later: dismiss,
  dateIsRight: dismiss,
  retry: () => answers.refreshStatus(),
  useHere: async () => {
    const answer = await visits.politely(() => askForControls(true));
    if (answer) answers.controls(answer);
  },
  otherEye() {
    const { protocol } = get();
    const now = protocol.slots.find(({ id }) => id === here().slot);
    lower(({ code }) => code.startsWith("light."));
    toAim(protocol.slots.find(({ eye, field }) => eye !== now.eye && field === now.field).id);
  },
  finish: () => exam.finish(),
  ask: () => go({ screen: "person", visit: here().visit }),
  how: () => go(here().visit ? { screen: "film", visit: here().visit } : { screen: "history" }),
  takeNow({ visit, slot }) {
    lower("power.lost");
    if (visit && slot) go({ screen: "aim", visit, slot });
  },
  see: () => go({ screen: "send" }),
  why: () => go({ screen: "send" }),
  tryNow({ code }) {
    lower(code);
    visits.trySending();
  },
  next: () => exam.next(),
  again: () => exam.again(),
  couldNot: () => exam.ask(),
  timer: () => set({ timer: Date.now() + PUPIL_REST_MS, now: Date.now() }),
  change({ id, slot }) {
    lower("eye.side");
    visits.moveToOtherEye(slot ?? here().slot, id ?? shotOf(get()).id);
  },
  keepEye({ code, id, slot }) {
    dismiss({ code }); // the instrument asks until it has the answer
    visits.sayEyeIsRight(slot ?? here().slot, id ?? shotOf(get()).id);
  },
  uncross: visits.uncross,
};

const settings = {
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
  setSound({ target }) {
    remember("sound", target.checked ? "on" : "off");
    set({ sound: target.checked });
    cue("good");
  },
  setAuto({ target }) {
    remember("auto", target.checked ? "on" : "off");
    set({ auto: target.checked });
  },
  async setLanguage(language) {
    await learn(language);
    remember("language", language);
    set({ language });
  },
};

/** What the page's story (app.js) answers to two of the buttons. */
export const answers = { refreshStatus: () => {}, controls: () => {} };

export const act = {
  ...moves,
  ...exam,
  ...picture,
  ...settings,
  freshPicture,
  stateDo: (name, state) => ofState[name](state),
};
