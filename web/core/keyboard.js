// Keyboard input from a keyboard, a Bluetooth shutter or a barcode reader. Single-letter keys can be disabled (WCAG
// 2.1.4).

import { get, currentCapture } from "./state.js";
import { acceptKey } from "./taps.js";

const SHUTTER_KEYS = new Set([" ", "Enter", "AudioVolumeUp"]);

const isTextField = (target) => target.closest("input, select, textarea");

/** Bind the keys of the page to the user actions. */
export function bindKeys(actions) {
  addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    const target = /** @type {Element} */ (event.target);
    if (document.querySelector("dialog[open]") || isTextField(target)) return;
    const { route } = get();
    if (route.screen === "find" && onFind(event, actions)) return event.preventDefault(); // the Enter of a barcode reader must not press a button
    if (SHUTTER_KEYS.has(event.key)) {
      if (route.screen !== "aim" || target.closest("button, a, summary, eye-pic")) return;
      event.preventDefault();
      if (acceptKey(event)) actions.take();
      return;
    }
    if (get().letters && !target.closest("eye-pic")) onLetter(event, actions);
  });
}

function onFind({ key, target }, actions) {
  if (/^[0-9A-Za-z-]$/.test(key)) actions.typeNumber(key.toUpperCase());
  else if (key === "Backspace") actions.typeNumber("erase");
  else if (key === "Enter" && get().typed && !target.closest(".find")) actions.enterNumber();
  else return false;
  return true;
}

function onLetter(event, actions) {
  const { key } = event;
  const { route, redfree, loupe, programme } = get();
  const capture = currentCapture(get());
  const hasVerdict = route.screen === "picture" && capture && (capture.over || capture.verdict);
  const once = (action) => acceptKey(event) && action();
  const keys = {
    ArrowLeft: () => route.screen !== "home" && once(actions.back),
    "?": actions.openMenu,
    ...(hasVerdict ? { r: () => once(actions.again), n: () => once(actions.next), ArrowRight: () => once(actions.next), ...viewerKeys(actions, redfree, loupe) } : {}),
  };
  const exam = route.screen === "aim" || route.screen === "picture";
  if (exam && /^[1-9]$/.test(key) && programme?.slots[key - 1]) actions.chooseTile(programme.slots[key - 1].id);
  else keys[key.length === 1 ? key.toLowerCase() : key]?.();
}

const viewerKeys = (actions, redfree, loupe) => ({
  g: () => actions.setRedfree(!redfree),
  l: () => actions.setLoupe(!loupe),
  b: () => actions.brightnessBy(1),
  d: () => actions.brightnessBy(-1),
  z: actions.zoomIn,
  "+": () => actions.contrastBy(1),
  "=": () => actions.contrastBy(1),
  "-": () => actions.contrastBy(-1),
  0: actions.reset,
});
