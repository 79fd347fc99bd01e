// Going on by itself to aiming, after consent and after a good picture; not with the automatic press, so that each exposure
// follows a press.

import { currentCapture, get, set } from "./state.js";
import { raiseAlert } from "./alerts.js";
import { navigate } from "./router.js";
import { screenChangedByItself } from "./taps.js";
import { nextSlot } from "./visit.js";

const SHOWN_MS = 1500;

let timer = 0;

/** Stay on this screen until a button is pressed. */
export const stay = () => set({ goesOnFrom: null });

/** Aim at a slot without a press of a button that says so. */
export function aimByItself(visit, slot) {
  navigate({ screen: "aim", visit, slot });
  screenChangedByItself();
}

/**
 * Return the slot that the page goes on to; null: it stays at this picture, which is poor or may show the other eye.
 * @param {import("./state.js").State} state
 */
export function followingSlot(state) {
  const capture = currentCapture(state);
  if (!capture?.record || capture.key !== state.goesOnFrom || capture.verdict?.word !== "good") return null;
  const seen = capture.record.report.laterality?.eye ?? capture.eye;
  return seen === capture.eye ? nextSlot(capture.slot) : null;
}

/** Go on when the final picture was shown long enough. */
export function goOnWhenShown() {
  const state = get();
  if (!followingSlot(state) || state.picture !== "final" || state.asking || state.link !== "live") {
    clearTimeout(timer);
    timer = 0;
  } else timer ||= setTimeout(goOn, SHOWN_MS);
}

function goOn() {
  const slot = followingSlot(get());
  const capture = currentCapture(get());
  stay();
  if (!slot || !capture || document.hidden) return;
  aimByItself(capture.visit, slot);
  raiseAlert({ code: "shot.next", eye: capture.eye, slot: capture.slot, from: "press" });
}
