// Double taps: of two taps at the same place within 0.4 s only the first counts, on every button but those that are meant
// to be pressed many times (`data-repeat`). A tap at that place within 0.4 s after the buttons have changed does not count
// either: it was meant for the button that was there before. A tap anywhere else, and the first one of a page, counts.
// After a screen has changed by itself no press counts that began before the change or within 0.6 s.

const DEBOUNCE_MS = 400;
const SAME_PLACE_PX = 48; // size of the smallest button
const UNSEEN_MS = 600; // to see the buttons of a screen that changed by itself

/** @type {Map<string, {x: number, y: number, ms: number}>} the last tap, and the last press of each key */
const last = new Map();
let changedMs = -Infinity;
let changedByItselfMs = -Infinity;
/** @type {Map<number, number>} when each finger came down */
const fingers = new Map();
/** @type {number | null} since when a key is down */
let keyMs = null;

/** The buttons have changed: another screen or another verdict. */
export function buttonsChanged() {
  changedMs = performance.now();
}

/** The page has changed the screen without a press. */
export function screenChangedByItself() {
  changedByItselfMs = performance.now();
}

/** Return whether a press at this time was not meant for this screen. */
export const isUnseen = (ms = performance.now()) => ms - changedByItselfMs < UNSEEN_MS;

/** Return whether a tap or key only repeats the one before it. `mayRepeat`: on a button that is pressed many times. */
function isRepetition(name, { x, y, ms }, mayRepeat = false) {
  const before = last.get(name);
  last.set(name, { x, y, ms });
  if (!before || Math.hypot(x - before.x, y - before.y) > SAME_PLACE_PX) return false;
  const sinceMs = mayRepeat ? (before.ms < changedMs ? changedMs : -Infinity) : Math.max(before.ms, changedMs);
  return ms - sinceMs < DEBOUNCE_MS;
}

/** Return whether a key press may act. */
export const acceptKey = ({ key, timeStamp }) => !isRepetition(`key ${key}`, { x: 0, y: 0, ms: timeStamp }) && !isUnseen(timeStamp);

function begin(event) {
  if (event.isPrimary) fingers.clear();
  if (event.type === "pointerdown") fingers.set(event.pointerId, event.timeStamp);
  else if (!event.repeat) keyMs = event.timeStamp;
}

// Later than the click that Space gives when it is released.
const releaseKey = () => setTimeout(() => (keyMs = null));

for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, begin, { capture: true });
addEventListener("keyup", releaseKey, { capture: true });
addEventListener("blur", releaseKey); // of the window, which then does not hear of the release

// A click without coordinates (`detail` 0) comes from a key or from a screen reader.
addEventListener(
  "click",
  (event) => {
    const button = /** @type {Element} */ (event.target).closest("button, a.button");
    if (!button) return;
    const { detail, clientX: x, clientY: y, timeStamp: ms } = event;
    const mayRepeat = button.closest("[data-repeat]") !== null; // number pad, steps of a tool
    const isRepeated = isRepetition(detail ? "tap" : "click", detail ? { x, y, ms } : { x: 0, y: 0, ms }, mayRepeat);
    const pressedMs = (detail ? fingers.get(/** @type {PointerEvent} */ (event).pointerId) : keyMs) ?? ms;
    if (!isRepeated && !isUnseen(pressedMs)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
  },
  { capture: true },
);
