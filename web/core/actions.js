// User actions by tap or key: one object of handlers that templates and keyboard share.

import { acceptTime, fileErrorCode, getFolders, requestControl } from "./api.js";
import { clamp, homeBox } from "./viewport.js";
import { get, otherEyeSlot, saveSetting, set, currentCapture } from "./state.js";
import { applyKey, isNumber } from "./numbers.js";
import { playCue, resetPictureTools, takePicture } from "./capture.js";
import { navigate } from "./router.js";
import { dismissAlert, lowerAlert, lowerAlerts, raiseAlert } from "./alerts.js";
import { previewActions } from "./aiming.js";
import { changeSecret, lock } from "./login.js";
import { aimByItself } from "./going_on.js";
import { refreshStatus, setControl } from "./status.js";
import * as visits from "./visit.js";
import { loadLanguage, t, today } from "../i18n/translate.js";

const $ = (selector) => document.querySelector(selector);
const currentRoute = () => get().route;
const PUPIL_REST_MS = 60_000;
const THUMB_RETRY_MS = 1000;
const THUMB_RETRY_MAX_MS = 64_000;
const TOOL_STEPS = 5; // largest step of brightness and contrast, in either direction

const firstSlot = () => get().visit?.next_slot ?? get().programme?.slots[0].id;
const goToAim = (slot) => navigate({ screen: "aim", visit: currentRoute().visit, slot });

const navigationActions = {
  go: navigate,
  lock,
  changeSecret,
  begin: (number) => visits.begin(number),
  resume: visits.resume,
  retryUploads: visits.retryUploads,
  startAiming: () => goToAim(firstSlot()),
  setField: visits.setField,
  /** Record the answer to the question for consent; after "agreed" aim at once. */
  answerConsent(value) {
    visits.setField("consent", value);
    if (value === "agreed" && !get().auto) aimByItself(currentRoute().visit, firstSlot());
  },
  typeNumber(key) {
    const typed = applyKey(get().typed, key, 12);
    set({ typed });
    visits.refreshList(typed ? { q: typed, limit: "20" } : { day: today(), limit: "20" });
  },
  /** Resume the visit with exactly this number; otherwise begin a new visit. Nothing, if the visits cannot be listed. */
  async enterNumber() {
    const { typed } = get();
    const listed = await visits.refreshList({ q: typed, limit: "20" });
    if (!listed || get().typed !== typed || currentRoute().screen !== "find") return;
    const same = listed.visits.find((visit) => isNumber(visit, typed));
    if (same) visits.resume(same);
    else visits.begin(typed);
  },
  setListFilter: (listFilter) => set({ listFilter }),

  /** Go up one level: picture -> patient -> Home; on other screens, back in the browser history. */
  back() {
    const { screen, visit, capture } = currentRoute();
    const fromExam = screen === "aim" || (screen === "picture" && !capture && !get().visit?.finished_at);
    if (get().asking) set({ asking: "" });
    else if (fromExam) navigate({ screen: "patient", visit });
    else if (history.state?.depth && screen !== "patient" && screen !== "outcome") history.back();
    else navigate({ screen: "home" }, { replace: !history.state?.depth });
  },

  /** Show the picture of a slot; if the slot is empty, aim at it. */
  chooseTile(slot) {
    const { visit, captures } = get();
    if (!visit) return;
    const pendingCaptures = captures.some((capture) => capture.visit === visit.id && capture.slot === slot && !capture.over);
    lowerAlerts(({ from }) => from === "press");
    if (pendingCaptures || visit.finished_at || visit.slots[slot].captures.length) navigate({ screen: "picture", visit: visit.id, slot });
    else goToAim(slot);
  },
};

const examActions = {
  take: takePicture,
  again: () => goToAim(currentRoute().slot),
  keepPrevious: () => navigate({ screen: "picture", visit: currentRoute().visit, slot: currentRoute().slot }),
  next: () => visits.goToNextSlot(currentRoute().slot),
  keepThis: () => visits.keepPoor(currentCapture(get())?.id, currentRoute().slot),
  useThis: () => visits.useInSlot(currentRoute().slot, currentRoute().capture),
  ask: () => set({ asking: "reason" }),
  stopAsking: () => set({ asking: "" }),
  notPossible: (slot, reason) => visits.notPossible(slot, reason),
  finish: () => visits.finish(),
  finishWithout: () => visits.finish({ isSure: true }),
  takeMissing() {
    const slot = get().visit?.next_slot ?? visits.nextSlot(currentRoute().slot);
    set({ asking: "" });
    if (slot) goToAim(slot);
  },
  reopen: (reason) => visits.reopen(reason),
  loadChanges: () => visits.loadChanges(),
  backToOutcome: () => navigate({ screen: "outcome", visit: currentRoute().visit }),
  moveToOtherEye: (slot, capture) => visits.moveToOtherEye(slot, capture),
  print: () => window.print(),

  toggleQrCode: () => set({ isCodeShown: !get().isCodeShown }),

  openPictures: (visit) => {
    set({ visit });
    navigate({ screen: "pictures", visit: visit.id });
  },
  openDetails: () => get().modules.details?.open(),
  openPicture: (slot, capture) => navigate({ screen: "picture", visit: currentRoute().visit, slot, capture }),
  pick(id) {
    const { picked } = get();
    set({ picked: picked.includes(id) ? picked.filter((pickedId) => pickedId !== id) : [...picked, id].slice(-2) });
  },
  compare: () => navigate({ screen: "compare", visit: currentRoute().visit, capture: get().picked[0], other: get().picked[1] }),
  setBlink: (blink) => set({ blink, front: 0 }),
  swap: () => set({ front: get().front ? 0 : 1 }),
  linkZoom({ target, detail }) {
    for (const pic of get().modules.viewer?.viewersOf(target.closest(".two")) ?? []) if (pic !== target) pic.view = detail;
  },
  listFolders: async () => set({ folders: (await visits.alertOnError(getFolders)) ?? null, copied: null, zipped: false }),
  zipped: () => set({ folders: null, copied: null, zipped: true }),
  copyTo: visits.copyTo,
};


const FILE_FAULTS = { "store.removed": "fault.removed", "store.erased": "fault.erased" };

const pictureActions = {
  // Show the mark "final" only after the viewer has drawn the final picture.
  pictureDrawn({ detail }) {
    set({ picture: detail.mark, grey: detail.mark === "final" && detail.grey });
  },

  async pictureFault({ detail }) {
    // The final picture is still to come.
    if (detail.mark === "quick") return;
    const why = FILE_FAULTS[await fileErrorCode(detail.url)] ?? "fault.picture";
    raiseAlert({ code: "picture", message: t(why), remedy: t(`${why}.remedy`), from: "press" });
  },

  zoomed: ({ detail }) => set({ zoom: detail }),
  zoomIn: () => $("#picture").zoomIn(),
  zoomOut: () => $("#picture").zoomOut(),
  setVersion: (version) => set({ version }),
  setRedfree: (redfree) => set({ redfree }),
  contrastBy: (step) => set({ contrast: clamp(get().contrast + step, -TOOL_STEPS, TOOL_STEPS) }),
  brightnessBy: (step) => set({ brightness: clamp(get().brightness + step, -TOOL_STEPS, TOOL_STEPS) }),
  setLoupe: (loupe) => set({ loupe }),
  loupeChanged: ({ detail }) => set({ loupe: detail }),

  reset() {
    set({ brightness: 0, contrast: 0, loupe: false });
    $("#picture").showAll();
  },

  // Request a thumbnail again, each time after twice the wait.
  thumbFailed({ target }) {
    const waitMs = Number(target.dataset.waitMs ?? THUMB_RETRY_MS);
    if (waitMs > THUMB_RETRY_MAX_MS) return;
    target.dataset.waitMs = 2 * waitMs;
    setTimeout(() => target.setAttribute("src", target.getAttribute("src")), waitMs);
  },

  // Scale a thumbnail to its illuminated disc, without the dark frame around it.
  thumbLoaded({ target }) {
    const { naturalWidth: width, naturalHeight: height } = target;
    const home = homeBox(get().status, width, height);
    target.style.transform = `scale(${Math.max(width, height) / Math.max(home.width, home.height)})`;
  },
};

// ---- buttons of alerts, by the name in the table of alerts.js

const alertButtons = {
  ok: ({ code }) => lowerAlert(code),
  later: dismissAlert,
  dateIsRight: dismissAlert,
  timeIsRight: async (alert) => {
    if (await visits.alertOnError(() => acceptTime())) dismissAlert(alert);
  },
  setClock: async (alert) => {
    if (await visits.alertOnError(() => acceptTime("/back"))) dismissAlert(alert);
  },
  retry: refreshStatus,
  useHere: async () => {
    const answer = await visits.alertOnError(() => requestControl(true));
    if (answer) setControl(answer);
  },
  otherEye() {
    lowerAlerts(({ code }) => code.startsWith("light."));
    const slot = otherEyeSlot(get(), currentRoute().slot);
    if (slot) goToAim(slot.id);
  },
  finish: () => examActions.finish(),
  ask: () => navigate({ screen: "patient", visit: currentRoute().visit }),
  how: () => navigate(currentRoute().visit ? { screen: "pictures", visit: currentRoute().visit } : { screen: "history" }),
  takeNow({ visit, slot }) {
    lowerAlert("power.lost");
    if (visit && slot) navigate({ screen: "aim", visit, slot });
  },
  see: () => navigate({ screen: "send" }),
  why: () => navigate({ screen: "send" }),
  tryNow({ code }) {
    lowerAlert(code);
    visits.retryUploads();
  },
  next: () => examActions.next(),
  again: () => examActions.again(),
  notPossible: () => examActions.ask(),
  timer: () => set({ timer: Date.now() + PUPIL_REST_MS, now: Date.now() }),
  change({ id, slot }) {
    lowerAlert("eye.side");
    visits.moveToOtherEye(slot ?? currentRoute().slot, id ?? currentCapture(get())?.id);
  },
  keepEye({ code, id, slot }) {
    dismissAlert({ code }); // hide the question until the server has the answer
    visits.confirmEye(slot ?? currentRoute().slot, id ?? currentCapture(get())?.id);
  },
  uncross: visits.undoNotPossible,
  showAgain: ({ slot }) => navigate({ screen: "picture", visit: currentRoute().visit, slot }),
};

const settingsActions = {
  openMenu: () => $("#menu").showModal(),
  closeMenu: () => $("#menu").close(),

  setTheme(theme) {
    saveSetting("theme", theme);
    set({ theme });
  },
  setLetters({ target }) {
    saveSetting("letters", target.checked ? "on" : "off");
    set({ letters: target.checked });
  },
  setSound({ target }) {
    saveSetting("sound", target.checked ? "on" : "off");
    set({ sound: target.checked });
    playCue("good");
  },
  setAuto({ target }) {
    saveSetting("auto", target.checked ? "on" : "off");
    set({ auto: target.checked });
  },
  async setLanguage(language) {
    await loadLanguage(language);
    saveSetting("language", language);
    set({ language });
  },
};

export const actions = {
  ...navigationActions,
  ...examActions,
  ...previewActions,
  ...pictureActions,
  ...settingsActions,
  resetPictureTools,
  runAlertButton: (name, state) => alertButtons[name](state),
};
