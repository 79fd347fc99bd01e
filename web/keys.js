// Keys, for a keyboard, a Bluetooth shutter or a code reader that types. Single letters can be switched off (WCAG 2.1.4).

import { get, shotOf } from "./memory.js";

const SHUTTERS = new Set([" ", "Enter", "AudioVolumeUp"]);

const typing = (target) => target.closest("input, select, textarea");

export function listenToKeys(act) {
  addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    if (document.querySelector("dialog[open]") || typing(event.target)) return;
    const { route } = get();
    if (route.screen === "find" && onFind(event, act)) return event.preventDefault(); // a code reader's Enter is no tap
    if (SHUTTERS.has(event.key)) {
      if (route.screen !== "aim" || event.target.closest("button, a, summary, eye-pic")) return;
      event.preventDefault();
      act.take();
      return;
    }
    if (get().letters && !event.target.closest("eye-pic")) onLetter(event, act);
  });
}

function onFind({ key, target }, act) {
  if (/^[0-9A-Za-z-]$/.test(key)) act.typeNumber(key.toUpperCase());
  else if (key === "Backspace") act.typeNumber("erase");
  else if (key === "Enter" && get().typed && !target.closest(".find")) act.enterNumber();
  else return false;
  return true;
}

function onLetter({ key }, act) {
  const { route, redfree, loupe, protocol } = get();
  const shot = shotOf(get());
  const told = route.screen === "picture" && shot && (shot.over || shot.verdict);
  const keys = {
    ArrowLeft: () => route.screen !== "home" && act.back(),
    "?": act.openMenu,
    ...(told ? { r: act.again, n: act.next, ArrowRight: act.next, ...looking(act, redfree, loupe) } : {}),
  };
  const exam = route.screen === "aim" || route.screen === "picture";
  if (exam && /^[1-9]$/.test(key) && protocol?.slots[key - 1]) act.chooseTile(protocol.slots[key - 1].id);
  else keys[key.length === 1 ? key.toLowerCase() : key]?.();
}

const looking = (act, redfree, loupe) => ({
  g: () => act.setRedfree(!redfree),
  l: () => act.setLoupe(!loupe),
  b: () => act.brightnessBy(1),
  d: () => act.brightnessBy(-1),
  z: act.zoomIn,
  "+": () => act.contrastBy(1),
  "=": () => act.contrastBy(1),
  "-": () => act.contrastBy(-1),
  0: act.reset,
});
